"""Measurements of flares: models of their light, forecasts of errors, and fits."""
