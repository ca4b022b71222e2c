"""Flares in time: their shapes and energies, stares at a star, what a search finds in them."""
