"""The settings of a run: what they are, what works, how they load and save. Leaves: nothing here imports jax."""
