"""OpenCL devices: programs, kernel cache, launches, engine and self-test.

Only this package imports pyopencl.
"""
