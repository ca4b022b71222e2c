"""Stores of raw spectra: layout, writing, verification and export."""
