"""Division of work into shards, workers that count them, and checkpoints."""
