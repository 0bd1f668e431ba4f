from collections.abc import Callable, Iterator

import pytest

from avp_habitat.simulators.habitat import HabitatSimulator


@pytest.fixture
def opened() -> Iterator[Callable[..., HabitatSimulator]]:
    """Opens a simulator, after it has closed the one before: a process can hold only one."""
    simulators: list[HabitatSimulator] = []

    def open_one(scene: object, **options: object) -> HabitatSimulator:
        for simulator in simulators:
            simulator.close()
        simulators[:] = [HabitatSimulator(str(scene), **options)]  # type: ignore[arg-type]
        return simulators[0]

    yield open_one
    for simulator in simulators:
        simulator.close()
