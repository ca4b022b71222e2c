"""Detection statistics and their distributions for Gaussian noise."""
