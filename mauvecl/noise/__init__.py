"""Noise model: processes, cumulants, tables, memory layout of scenes, and NumPy reference implementation."""
