"""Histograms and moments of whole numbers: what a device counted of a statistic or a pixel."""
