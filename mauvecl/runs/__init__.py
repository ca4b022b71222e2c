"""Work cut into shares: who counts them, and what is kept for a resume."""
