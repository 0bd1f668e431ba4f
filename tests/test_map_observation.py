import numpy as np
import pytest
from corridor import Corridor

from avp_habitat.task.floor_map import CELL_M, CHANNELS, SIDE, MapObserver
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.task import ViewpointTask

AREA = Corridor().area
CELLS = len(AREA.centres)


def by_hand(seen, position, yaw):
    """The maps in plain Python from the channels' description."""
    maps = np.zeros((len(CHANNELS), SIDE, SIDE))
    number = {tuple(cell): index for index, cell in enumerate(np.argwhere(AREA.mask).tolist())}
    for (row, column), index in number.items():
        if not seen[index]:
            continue
        x, z = (column + 0.5) * 0.1 - position[0], (row + 0.5) * 0.1 - position[2]
        ahead = -np.sin(yaw) * x - np.cos(yaw) * z
        right = np.cos(yaw) * x - np.sin(yaw) * z
        up, across = int(np.floor(SIDE / 2 - ahead / CELL_M)), int(np.floor(SIDE / 2 + right / CELL_M))
        beside = [number.get((row + i, column + j)) for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0))]
        on_map = 0 <= up < SIDE and 0 <= across < SIDE
        if on_map:
            maps[0, up, across] += 1 / 16
            maps[2, up, across] += any(other is None for other in beside) / 4
        if any(other is not None and not seen[other] for other in beside):
            maps[1, np.clip(up, 0, SIDE - 1), np.clip(across, 0, SIDE - 1)] += 1 / 4
    return np.minimum(maps, 1).ravel()


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 2, -2.5])
def test_the_map_is_that_of_its_description(yaw):
    rng = np.random.default_rng(0)
    first_seen = np.zeros((3, CELLS), dtype=np.int16)
    first_seen[1] = rng.random(CELLS) < 0.3
    first_seen[1, AREA.centres[:, 0] < 2.5] = 4
    position = np.array([[1.03, 0.0, 1.27]])
    drawn = MapObserver(AREA).observe(first_seen, np.array([1]), position, np.array([yaw]))
    np.testing.assert_allclose(drawn[0], by_hand(first_seen[1] > 0, position[0], yaw), atol=1e-6)


def test_frontiers_beyond_the_map_are_drawn_on_its_border():
    seen = np.zeros((1, CELLS), dtype=np.int16)
    seen[0, AREA.centres[:, 0] > 5.5] = 1
    # At the other end of the room, looking along +X: the seen end lies 4.5 m ahead, the map reaches 4 m.
    drawn = MapObserver(AREA).observe(seen, np.array([0]), np.array([[1.0, 0, 2.0]]), np.array([-np.pi / 2]))
    observed, frontier, _ = drawn.reshape(len(CHANNELS), SIDE, SIDE)
    assert observed.sum() == 0
    assert frontier[0].sum() > 0
    assert frontier[1:].sum() == 0


def test_nothing_that_was_not_seen_enters_the_map():
    # Two rooms that differ only where nothing was seen: the wall of the corridor and what lies behind it.
    other = Corridor().area
    other.__dict__["mask"] = AREA.mask.copy()
    other.mask[:, 45:] = False
    seen, seen_there = np.zeros((1, CELLS), np.int16), np.zeros((1, CELLS), np.int16)
    places = np.argwhere(AREA.mask)
    near = {tuple(cell) for cell in places.tolist() if cell[1] < 20}
    for index, cell in enumerate(places.tolist()):
        seen[0, index] = tuple(cell) in near
    for index, cell in enumerate(np.argwhere(other.mask).tolist()):
        seen_there[0, index] = tuple(cell) in near
    here = (np.array([0]), np.array([[1.5, 0, 1.5]]), np.array([0.3]))
    drawn = MapObserver(AREA).observe(seen, *here)
    assert drawn.sum() > 0
    np.testing.assert_array_equal(drawn, MapObserver(other).observe(seen_there, *here))


def test_the_observation_is_the_twelve_numbers_whether_stop_would_do_and_the_map():
    constants = RewardConstants(stop_coverage=0.1)
    settings = [TaskSettings(observation=kind, constants=constants) for kind in ("numbers", "map")]
    tasks = [ViewpointTask(Corridor(), each, agents=2) for each in settings]
    for task in tasks:
        task.reset(range(2), AREA.centres[[5, 300]], np.array([np.pi, 0.0]))
    numbers, with_map = (task.step(np.array([1, 1])).observation for task in tasks)
    np.testing.assert_array_equal(with_map[:, :12], numbers)
    drawn = MapObserver(AREA).observe(tasks[1]._first_seen, np.arange(2), tasks[1].position, tasks[1].yaw)
    np.testing.assert_array_equal(with_map[:, 13:], drawn)
    reached = tasks[1].coverage >= 0.1
    assert set(reached) == {True, False}
    np.testing.assert_array_equal(with_map[:, 12], reached)
