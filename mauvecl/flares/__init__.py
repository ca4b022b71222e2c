"""Flares in time: shapes, energies, rates and stares."""
