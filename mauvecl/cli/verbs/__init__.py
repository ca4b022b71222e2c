"""Commands with their own functions."""
