"""Instruments with their files, curves and pixel maps."""
