"""Work cut into shards: who counts them, and what is kept for a resume."""
