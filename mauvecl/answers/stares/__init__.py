"""Hours at one star: a simulated stare, and the completeness of a search for flares in it."""
