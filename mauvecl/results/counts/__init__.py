"""Histograms and moments in integer arithmetic, from the counts of a device."""
