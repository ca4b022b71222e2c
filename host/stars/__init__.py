"""Spectra of stars, magnitudes, flares, the embedded library and the user's own stars."""
