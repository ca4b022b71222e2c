"""What a draw is made of: shared structs, cumulants, Poisson tables, processes, scenes, the NumPy twin."""
