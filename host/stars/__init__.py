"""Stars: spectra, magnitudes, flares, the embedded library and stars of one's own."""
