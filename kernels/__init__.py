"""OpenCL C sources (Mako): what the device runs. They know pixels, not stars."""
