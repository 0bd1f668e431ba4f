"""Policies that learn nothing, with Stable-Baselines3's `predict` interface.

`avp_habitat.policies` makes all of them by name. Those that need Numba (`frontier`, `greedy`) are not imported here.
"""

from avp_habitat.baselines.reactive import CLEARANCE_M, HeuristicPolicy, RandomPolicy
from avp_habitat.baselines.spin import SpinPolicy

__all__ = ["CLEARANCE_M", "HeuristicPolicy", "RandomPolicy", "SpinPolicy"]
