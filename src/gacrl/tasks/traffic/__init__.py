"""IC3Net's Traffic Junction: cars that cross each other's way, and see next to nothing."""
