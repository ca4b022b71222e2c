"""Deterministic chain from a stellar spectrum to mean electrons per pixel, without OpenCL."""

#: Version of the package; `tests/test_release.py` compares what repeats it.
VERSION = "2.0.0"
