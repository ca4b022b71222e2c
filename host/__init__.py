"""Deterministic chain from a stellar spectrum to mean electrons per pixel, without OpenCL."""
