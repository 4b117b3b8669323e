"""Readers of a training that write it down elsewhere."""
