"""Spectra as users and archives have them: read by what they hold, checked, continued, binned."""
