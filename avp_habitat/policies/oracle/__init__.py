"""Planners that know the whole scene: the references `oracle` and `survey`."""
