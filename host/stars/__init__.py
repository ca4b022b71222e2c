"""Spectra of stars and their files, magnitudes, flares, the embedded library and the user's own stars."""
