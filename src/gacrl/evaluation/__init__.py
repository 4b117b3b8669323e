"""Measuring policies: on fixed episodes, in our environment and in the real MPE2."""
