"""One module for each question that a study asks, and the files that are written of its answer."""
