"""The spaces of `AVP-v0` as gymnasium describes them."""

import gymnasium
import numpy as np
from numpy.typing import NDArray

from avp_habitat.map_observation import SIZE
from avp_habitat.observation import HIGH, LOW
from avp_habitat.settings import ACTION_NAMES
from avp_habitat.surface_map import SIZE as SURFACE_SIZE


def observation_space(kind: str) -> gymnasium.Space[NDArray[np.float32]]:
    """Observations of a kind.

    Args:
        kind: one of `settings.OBSERVATION_NAMES`.

    Returns:
        float32; `(12,)` for `numbers`, `(13 + map_observation.SIZE,)` (the numbers, whether C ≥ τ, the map) for `map`,
        and `surface_map.SIZE` more for `surface_map`.
    """
    further = {"map": 1 + SIZE, "surface_map": 1 + SIZE + SURFACE_SIZE}.get(kind, 0)
    low = np.concatenate([LOW, np.zeros(further, np.float32)])
    high = np.concatenate([HIGH, np.ones(further, np.float32)])
    return gymnasium.spaces.Box(low, high, dtype=np.float32)  # type: ignore[return-value]


def action_space() -> gymnasium.spaces.Discrete:
    """The six actions, numbered as in `settings.ACTION_NAMES`."""
    return gymnasium.spaces.Discrete(len(ACTION_NAMES))
