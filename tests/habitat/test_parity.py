"""Habitat-Sim and the ray caster show the same, and the same walk through them counts the same.

The three rooms: a generated one, and the two scanned-like ones that lie beside some checkouts. The measuring is that of
`benchmarks/simulators.py`, which prints the figures.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.sight.rules import candidates
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings

pytestmark = pytest.mark.habitat

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
ACTIONS = 200
SEEDS = (0, 1)


@pytest.fixture(scope="module")
def measure():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import simulators
    finally:
        sys.path.remove(str(BENCHMARKS))
    return simulators


REAL = [pytest.param(name, marks=pytest.mark.slow) for name in ("white_room.glb", "grey_white_room.glb")]


@pytest.fixture(scope="module", params=["builtin:0", *REAL])
def both(request):
    """The two simulators of one scene."""
    scene = request.param
    if scene.endswith(".glb"):
        scene = str(request.getfixturevalue("shared") / "scenes" / scene)
    habitat = make_simulator("habitat", scene, gpu=-1)
    yield make_simulator("raycast", scene), habitat, scene
    habitat.close()


@pytest.fixture(scope="module")
def same(both, measure):
    """`raycast` with the NavMesh of `habitat`."""
    return measure.with_navmesh_of(both[1], both[2])


def test_pictures_from_the_same_poses_are_the_same(both, measure):
    raycast, habitat, _ = both
    seen = measure.compare_pictures(raycast, habitat, measure.scattered_poses(raycast, 50, seed=0))
    assert seen.kept > 0.8
    assert np.median(seen.depth_m) <= 0.005
    assert np.quantile(seen.depth_m, 0.99) <= 0.05
    assert seen.psnr_db.min() >= 30


def test_pictures_from_a_centimetre_beside_are_not_the_same(both, measure):
    raycast, habitat, _ = both
    poses = measure.scattered_poses(raycast, 5, seed=0)

    class Beside:
        def render(self, camera_to_world, intrinsics, *, rgb):
            moved = camera_to_world.copy()
            moved[:, :3, 3] += 0.01 / np.sqrt(3)
            return habitat.render(moved, intrinsics, rgb=rgb)

    seen = measure.compare_pictures(raycast, Beside(), poses)
    assert np.median(seen.depth_m) > 0.003
    assert seen.psnr_db.min() < 30


def test_navigable_masks_overlap(both, measure):
    raycast, habitat, _ = both
    overlap, ratio = measure.mask_overlap(raycast, habitat)
    assert overlap >= 0.93
    assert ratio == pytest.approx(1, abs=0.05)
    assert habitat.area.area_m2 == pytest.approx(raycast.area.area_m2, rel=0.05)


def test_with_one_navmesh_the_masks_are_equal(both, same, measure):
    overlap, ratio = measure.mask_overlap(same, both[1])
    assert overlap > 0.999
    assert ratio == pytest.approx(1, abs=0.001)


def test_floors_are_equally_high(both):
    raycast, habitat, _ = both
    common = habitat.area.centres[raycast.area.contains(habitat.area.centres)]
    apart = np.abs(raycast.area.floor_height(common) - common[:, 1])
    assert np.median(apart) < 0.002
    assert (apart < 0.02).mean() > 0.98


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["frontier", "random"])
def test_the_same_actions_lead_to_the_same_places_until_the_first_contact(both, measure, kind, seed):
    raycast, habitat, _ = both
    start = measure.common_start(raycast, habitat, seed)
    walk = measure.compare_walks(raycast, habitat, _actions(measure, raycast, kind, start, seed), start)
    free = slice(0, walk.contact)
    assert walk.apart_m[free].max(initial=0.0) <= 0.01
    assert walk.observation[free].max(initial=0.0) <= 0.02


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["frontier", "random"])
def test_with_one_navmesh_the_same_actions_count_the_same_to_the_end(both, same, measure, kind, seed):
    raycast, habitat, _ = both
    start = measure.common_start(raycast, habitat, seed)
    actions = _actions(measure, raycast, kind, start, seed)
    walk = measure.compare_walks(same, habitat, actions, start)
    assert walk.apart_m.max() <= 0.01
    assert abs(walk.coverage[-1, 0] - walk.coverage[-1, 1]) <= 0.02
    assert walk.observation.max() <= 0.02


def _actions(measure, simulator, kind, start, seed):
    if kind == "random":
        return measure.random_actions(ACTIONS, seed)
    return measure.frontier_actions(simulator, ACTIONS, start, seed)


def test_visible_cells_are_those_that_rays_reach(both, measure):
    raycast, habitat, _ = both
    poses = measure.scattered_poses(raycast, 20, seed=3)
    settings = TaskSettings()
    points = habitat.area.centres
    everything = np.ones((len(poses), len(points)), bool)
    pairs = candidates(poses, settings.intrinsics, points, everything, max_range_m=settings.max_range_m)
    answers = [
        simulator.visible(poses, settings.intrinsics, points, pairs, tolerance_m=settings.tolerance_m)
        for simulator in (raycast, habitat)
    ]
    assert 0.02 < answers[0].mean() < 0.98
    assert (answers[0] == answers[1]).mean() >= 0.99


def test_steps_are_free_of_the_pictures_taken_between_them(both):
    """Held-out views and rollout pictures have no effect on an episode."""
    _, habitat, _ = both
    ways = []
    for pictures in (False, True):
        env = AVPEnv(simulator=habitat, settings=TaskSettings(budget=12))
        observations = [env.reset(seed=5)[0]]
        for action in (0, 1, 0, 3, 0, 2, 4, 0, 0, 1, 1, 0):
            if pictures:
                heldout_poses(habitat, sensor_height_m=1.5, views=1)
            observations.append(env.step(action)[0])
        ways.append(np.array(observations))
    np.testing.assert_array_equal(ways[0], ways[1])


def test_habitats_own_agent_stands_where_ours_does(both, measure):
    """Without contact Habitat-Sim's own filter lets an agent arrive where ours arrives."""
    row = measure._sliding(both[1], 500, seed=0)
    assert row["contacts"] < 300
    assert row["free_apart_mm"] < 1
    assert row["contacts_apart_percent"] < 20
