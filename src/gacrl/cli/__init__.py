"""The command line: what each command understands, what it does, and what the terminal shows."""
