"""Fits of flares to spectra and their sums, by profile likelihoods."""
