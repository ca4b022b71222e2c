"""Flares: shapes in time, energies and rates."""
