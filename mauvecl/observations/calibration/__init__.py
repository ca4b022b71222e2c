"""Calibration of an instrument from frames of standard stars and frames without a star."""
