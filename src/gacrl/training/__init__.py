"""The loop that trains every algorithm, its curriculum, checkpoints and records."""
