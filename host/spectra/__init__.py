"""Readers of spectra of users and archives, checks of spectra, and continuation of their ends."""
