"""Answers about detection: detect, map, gaussian, and the cost of unknowns."""
