"""Answers from observed frames: flares, calibrated instruments, and changes between visits."""
