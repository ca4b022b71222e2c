"""Forecasts and simulations of the measurement of flares."""
