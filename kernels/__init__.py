"""OpenCL C sources (Mako templates) for pixels; stars are unknown here."""
