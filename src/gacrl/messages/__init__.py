"""What agents say, and how much."""
