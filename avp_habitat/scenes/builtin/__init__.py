"""Rooms made from a seed, `builtin:SEED`; `home/` makes several with doorways between them, `builtin-home:SEED`."""
