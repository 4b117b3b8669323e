"""Algorithms as records of pure functions; `algorithm.make` builds one from its configuration."""
