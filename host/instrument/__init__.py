"""Instruments: their files, curves and pixel maps."""
