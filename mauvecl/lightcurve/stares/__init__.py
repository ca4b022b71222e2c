"""Stares, continuous observations of one star: conditions of frames, simulated sums, and measurements."""
