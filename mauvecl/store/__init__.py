"""Raw spectra in bulk: the form of a store, writing, verifying and exporting it."""
