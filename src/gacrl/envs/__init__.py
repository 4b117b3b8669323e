"""What every task must be, and what tasks are made of."""
