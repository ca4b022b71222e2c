"""Flares in time: shapes and energies, stares at a star, and searches for flares in stares."""
