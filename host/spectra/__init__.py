"""Readers of spectra of users and archives, on the tables of files."""
