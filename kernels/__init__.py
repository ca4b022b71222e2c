"""OpenCL C templates: what the device runs. They know pixels, not stars."""
