"""Rooms made from a seed: `builtin:SEED`."""
