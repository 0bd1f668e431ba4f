"""The next-best-view planner: its grid against brute force, what it may know, and that it sees a room."""

from dataclasses import replace

import numpy as np
import pytest
from corridor import Corridor

from avp_habitat.geometry.shape import Shape
from avp_habitat.policies.nbv.grid import FREE, OCCUPIED, UNKNOWN, VOXEL_M, OccupancyGrid
from avp_habitat.policies.registry import make_policy, make_policy_env, steps_of
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.sight.visibility import heldout_points, visibility
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.agent_view import agent_views
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings

SETTINGS = TaskSettings(reward="coverage", budget=40)
CAMERA = Intrinsics.from_hfov(160, 120, hfov_deg=90.0)


@pytest.fixture(scope="module")
def room():
    return open_simulator(SimulatorChoice(), "builtin:3")


def marched(state, eye, direction, reach, rear_side, step=0.002):
    """A ray's gain by small steps instead of from border to border."""
    clear, gain, before, last = 1.0, 0.0, FREE, None
    for length in np.arange(step / 2, reach, step):
        voxel = tuple(np.floor(eye + length * direction).astype(int))
        if voxel == last:
            continue
        last = voxel
        if not all(0 <= v < size for v, size in zip(voxel, state.shape, strict=True)):
            break
        if state[voxel] == OCCUPIED:
            return gain + (clear * rear_side if before == UNKNOWN else 0.0)
        if state[voxel] == UNKNOWN:
            gain, clear = gain + clear, clear / 2
        before = state[voxel]
        if clear <= 0.01:
            break
    return gain


def test_gains_are_those_of_rays_that_march_in_small_steps():
    rng = np.random.default_rng(0)
    grid = OccupancyGrid(np.zeros(3), 10.0)
    grid.state[:] = rng.choice([UNKNOWN, FREE, FREE, FREE, OCCUPIED], grid.state.shape, p=[0.1, 0.3, 0.3, 0.2, 0.1])
    eyes = rng.uniform(-1, 1, (5, 3)) + [0, 1.5, 0]
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = grid.gains(eyes, directions, 3.0, 2.0)
    start = (eyes - grid.corner) / VOXEL_M
    expected = [[marched(grid.state, eye, way, 3.0 / VOXEL_M, 2.0) for way in directions] for eye in start]
    # Marching may step over the corner of a voxel.
    assert (np.abs(found - expected) < 1e-9).mean() > 0.97
    assert found.max() > 1


def test_the_grid_grows_around_who_walks_on_and_keeps_what_it_knew():
    grid = OccupancyGrid(np.array([3.0, 0.0, 4.0]), 10.0)
    known = np.array([5.05, 1.05, -2.95])
    grid.state[tuple(((known - grid.corner) / VOXEL_M).astype(int))] = OCCUPIED
    for feet in ([30.0, 0.0, 4.0], [3.0, 6.5, -40.0], [3.0, -3.0, 4.0]):
        grid.cover(np.array(feet), 10.0)
        least, most = grid.corner, grid.corner + np.array(grid.state.shape) * VOXEL_M
        assert (least <= np.array(feet) - [10, 1, 10]).all()
        assert (most >= np.array(feet) + [10, 4, 10]).all()
    assert grid.state[tuple(((known - grid.corner) / VOXEL_M).astype(int))] == OCCUPIED
    assert (grid.state == OCCUPIED).sum() == 1
    size = grid.state.shape
    grid.cover(np.array([3.0, 0.0, 4.0]), 1000.0)
    assert grid.state.size < 4 * np.prod(size)


def test_depth_frees_the_way_and_occupies_what_it_hits(room):
    poses = heldout_poses(room, sensor_height_m=1.5)
    depth = room.render(poses, CAMERA, rgb=False).depth
    grid = OccupancyGrid(poses[0, :3, 3] - [0, 1.5, 0], 10.0)
    for image, pose in zip(depth, poses, strict=True):
        grid.integrate(image, pose, CAMERA, 10.0)
    occupied = np.argwhere(grid.state == OCCUPIED) * VOXEL_M + grid.corner + VOXEL_M / 2
    mesh = room.surface_mesh()
    assert Shape(mesh.vertices, mesh.triangles).distance(occupied).max() < VOXEL_M
    # From each eye, the voxels on the way to what it sees are known.
    for pose, image in zip(poses, depth, strict=True):
        ahead = pose[:3, 3] - pose[:3, 2] * 0.9 * image[60, 80]
        assert grid.state[tuple(((ahead - grid.corner) / VOXEL_M).astype(int))] != UNKNOWN
    assert (grid.state == UNKNOWN).mean() > 0.5


def test_a_picture_leaves_nothing_to_gain_where_it_looked(room):
    pose = heldout_poses(room, sensor_height_m=1.5)[:1]
    grid = OccupancyGrid(pose[0, :3, 3] - [0, 1.5, 0], 10.0)
    ahead = -pose[0, :3, 2]
    assert grid.gains(pose[:, :3, 3], ahead[None], 10.0, 2.0)[0, 0] == pytest.approx(2.0, abs=0.02)
    grid.integrate(room.render(pose, CAMERA, rgb=False).depth[0], pose[0], CAMERA, 10.0)
    assert grid.gains(pose[:, :3, 3], ahead[None], 10.0, 2.0)[0, 0] < 0.5
    assert grid.gains(pose[:, :3, 3], -ahead[None], 10.0, 2.0)[0, 0] == pytest.approx(2.0, abs=0.02)


class Counting:
    """A simulator that remembers the poses from which it was asked to look."""

    def __init__(self, simulator):
        self._simulator, self.asked = simulator, []

    def __getattr__(self, name):
        return getattr(self._simulator, name)

    def render(self, camera_to_world, intrinsics, *, rgb):
        self.asked += [*np.asarray(camera_to_world)]
        return self._simulator.render(camera_to_world, intrinsics, rgb=rgb)


@pytest.mark.parametrize("name", ["heuristic", "random", "spin", "frontier", "greedy", "nbv", "pretrained"])
def test_no_policy_without_full_knowledge_looks_from_where_it_has_not_been(room, name):
    counting = Counting(room)
    settings = replace(SETTINGS, budget=25)
    if name == "pretrained":
        settings = replace(settings, reward="multiview", observation="onboard")
    env = AVPEnv(simulator=counting, settings=settings)
    policy = make_policy(name, env, 0)
    observation, _ = env.reset(seed=4)
    visited, done = [env.camera_to_world], False
    while not done:
        # Finding the surface for reward and observation looks all over the scene; a policy may not.
        counting.asked.clear()
        action, _ = policy.predict(observation)
        assert all(any(np.allclose(pose, been) for been in visited) for pose in counting.asked), name
        observation, _, terminated, truncated, _ = env.step(int(action))
        visited.append(env.camera_to_world)
        done = terminated or truncated


def seen_by(simulator, name, seed):
    settings = replace(SETTINGS, reward="coverage")
    env, policy = make_policy_env(name, simulator, settings, seed=seed)
    poses = np.array([env.camera_to_world for _ in steps_of(env, policy, seed=seed)])
    heldout = heldout_poses(simulator, sensor_height_m=1.5)
    depth = simulator.render(np.concatenate([heldout, poses]), CAMERA, rgb=False).depth
    points = heldout_points(zip(depth[: len(heldout)], heldout, strict=True), CAMERA, stride=4)
    return visibility(points, zip(depth[len(heldout) :], poses, strict=True), CAMERA).curve()[-1]


@pytest.mark.parametrize("scene", ["builtin:3", "builtin:203"])
def test_it_sees_more_of_a_room_than_planners_of_the_floor(scene):
    simulator = open_simulator(SimulatorChoice(), scene)
    names = ("nbv", "frontier", "greedy")
    seen = {name: np.mean([seen_by(simulator, name, seed) for seed in (0, 1)]) for name in names}
    assert seen["nbv"] > 0.6
    assert seen["nbv"] > seen["greedy"] + 0.15
    assert seen["nbv"] > seen["frontier"] + 0.15


@pytest.mark.parametrize(
    "changes",
    [{"pitch_limit_deg": 15.0}, {"pitch_limit_deg": 0.0}, {"turn_deg": 20.0, "tilt_deg": 20.0}, {"tilt_deg": 12.0},
     {"turn_deg": 120.0}, {"tilt_deg": 60.0}, {"turn_deg": 7.0, "tilt_deg": 3.0}, {"width": 100, "height": 20}],
    ids=str,
)  # fmt: skip
def test_it_never_turns_to_and_fro_whatever_turns_and_tilts_are(room, changes):
    settings = replace(SETTINGS, budget=60, **changes)
    for seed in (0, 1):
        env, policy = make_policy_env("nbv", room, settings, seed=seed)
        poses = np.array([env.camera_to_world for _ in steps_of(env, policy, seed=seed)]).round(4)
        # A view that was taken is not gone for again, though it may lie on the way to others.
        times = np.unique(poses.reshape(len(poses), -1), axis=0, return_counts=True)[1]
        assert times.max() <= 6, (changes, seed)
        assert len(times) >= 12, (changes, seed)


def test_the_same_episode_twice_is_the_same(room):
    runs = []
    for _ in range(2):
        env, policy = make_policy_env("nbv", room, SETTINGS, seed=1)
        runs.append([step.action for step in steps_of(env, policy, seed=1)])
    assert runs[0] == runs[1]


def test_it_leaves_a_corner_in_which_its_body_touches_both_walls():
    env = AVPEnv(simulator=Corridor(), settings=replace(SETTINGS, width=32, height=24, budget=80))
    policy = make_policy("nbv", env, 0)
    observation, _ = env.reset(seed=0)
    start = env.agent_pose[0].copy()
    assert start[[0, 2]] == pytest.approx([0.15, 2.55])
    for _ in range(79):
        action, _ = policy.predict(observation)
        observation, *_ = env.step(int(action))
    assert np.linalg.norm(env.agent_pose[0] - start) > 1.0


def test_the_pose_of_the_newest_view_is_the_cameras(room):
    env = AVPEnv(simulator=room, settings=SETTINGS)
    env.reset(seed=0)
    env.step(1)
    env.step(3)
    (view,) = agent_views(env)
    assert np.allclose(view.camera_to_world, env.camera_to_world)
    angles = {"yaw": np.array([view.yaw]), "pitch": np.array([view.pitch])}
    expected = camera_to_world(view.position[None] + [0, 1.5, 0], **angles)
    assert np.allclose(view.camera_to_world, expected[0])
