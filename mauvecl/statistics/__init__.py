"""What is asked of draws: the detection statistics and their distributions for Gaussian noise."""
