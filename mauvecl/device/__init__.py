"""Where it is computed: devices, programs, kernel cache, launches, engine, self-test.

Only this room imports pyopencl.
"""
