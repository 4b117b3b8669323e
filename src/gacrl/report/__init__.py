"""Pages to read and their figures, from numbers that are there already."""
