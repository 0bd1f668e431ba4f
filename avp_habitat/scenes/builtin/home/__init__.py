"""Homes made from a seed: `builtin-home:SEED`."""
