"""Other people's environments."""
