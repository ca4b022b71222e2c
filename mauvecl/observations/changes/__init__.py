"""Changes between visits to a star: indices, the smallest detectable change, and periods."""
