"""Scenes of which a training has only some open at a time: who comes next, and what they are called together."""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator

TURNOVER = 100
"""For how many whole episodes of an agent a scene of a pool is held."""
_KINDS = {"builtin": "rooms", "builtin-home": "homes"}
_FEW = 5


class ScenePool:
    """Opens scenes in turn: in every round each of them once, in an order that the seed decides."""

    def __init__(self, scenes: Sequence[str], choice: SimulatorChoice, seed: int | None) -> None:
        """Take at least one scene; none is opened yet."""
        self._scenes, self._choice = list(scenes), choice
        self.name = describe(scenes)
        """What they are called together."""
        self._generator = np.random.default_rng(seed)
        self._order = self._rounds()

    def open_next(self) -> Simulator:
        """The next scene, opened; one that cannot be used costs a warning, and does not come again.

        Raises:
            SceneError: there is none that can be used.
        """
        for scene in self._order:
            try:
                simulator = open_simulator(self._choice, scene)
                _ = simulator.area
            except SceneError as error:
                self._scenes.remove(scene)
                if not self._scenes:
                    raise
                warnings.warn(f"{error}; the training goes on without this scene", stacklevel=2)
            else:
                return simulator
        raise AssertionError("rounds have no end")

    def _rounds(self) -> Iterator[str]:
        while True:
            yield from [self._scenes[index] for index in self._generator.permutation(len(self._scenes))]


def describe(scenes: Sequence[str]) -> str:
    """A few scenes by their names, many by their kinds: `256 rooms, 128 homes`."""
    if len(scenes) <= _FEW:
        return ", ".join(scenes)
    kinds = Counter(_KINDS.get(scene.partition(":")[0], "other scenes") for scene in scenes)
    return ", ".join(f"{count} {kind}" for kind, count in kinds.items())
