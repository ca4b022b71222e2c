"""The deterministic chain: a stellar spectrum in, mean electrons per pixel out. No OpenCL here."""
