"""Observed frames: reading, quality, noise as measured, and the flares in them."""
