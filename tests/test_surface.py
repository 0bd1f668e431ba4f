from dataclasses import replace

import numpy as np
import pytest
from corridor import ROOM, WALL, Corridor, reached

from avp_habitat import poses
from avp_habitat.errors import UsageError
from avp_habitat.sight.bits import unpack
from avp_habitat.sight.rules import view_quality
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.surface.map import CELL_M, FULL, GROUPS, SIDE, SurfaceMapper
from avp_habitat.surface.memory import surface_tables
from avp_habitat.surface.points import EDGE_M, scene_surface
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.task import ViewpointTask
from avp_sb3.presets import PRESETS

SIMULATOR = Corridor()
PAIR = np.array([[0, 0]])
SETTINGS = TaskSettings(reward="surface", observation="surface_map", width=32, height=24, hfov_deg=70.0)
WALK = (0, 1, 0, 2, 4, 4, 0, 1, 3, 3, 3, 5, 0, 1, 1, 0, 4, 2, 0, 0)


@pytest.fixture(scope="module")
def room():
    return make_simulator("raycast", "builtin:3")


def test_the_points_lie_on_the_surfaces_and_their_normals_stand_on_them():
    surface = scene_surface(SIMULATOR, SETTINGS)
    off = []
    for box in (ROOM, WALL):
        for axis in range(3):
            for side in range(2):
                flush = np.abs(surface.points[:, axis] - box[side, axis]) < 1e-3
                square = np.abs(np.abs(surface.normals[:, axis]) - 1) < 1e-3
                off.append(flush & square)
    # The rounded normals of a few edges are flat enough to stay.
    assert np.any(off, axis=0).mean() > 0.98
    middle = np.array([1.5, 1.3, 2.5])
    shell = (np.abs(surface.points[:, None] - ROOM).min(axis=1) < 1e-3).any(axis=1)
    inwards = ((middle - surface.points) * surface.normals).sum(axis=1)
    assert (inwards[shell] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1)


def test_there_is_one_point_for_a_cube_and_a_direction_and_hardly_a_cube_without():
    surface = scene_surface(SIMULATOR, SETTINGS)
    cube = np.floor((surface.points + 0.01 * surface.normals) / EDGE_M).astype(int)
    axis = np.abs(surface.normals).argmax(axis=1)
    side = np.sign(surface.normals[np.arange(len(axis)), axis]).astype(int)
    keys = np.column_stack([cube, axis, side])
    assert len(np.unique(keys, axis=0)) == len(keys)
    # 6 m x 3 m: the ceiling has 24 x 12 cubes, less those over the wall.
    ceiling = (axis == 1) & (side < 0)
    assert 0.9 * 24 * 12 <= np.count_nonzero(ceiling) <= 24 * 12


def test_points_weigh_as_their_patches_fill_level_pictures():
    """Against the solid angles of patches of equal size, from other places than those at which pictures were taken."""
    surface, size = scene_surface(SIMULATOR, SETTINGS), 0.0
    for place in SIMULATOR.area.centres[::7]:
        eye = place + [0, SETTINGS.sensor_height_m, 0]
        ray = surface.points - eye
        far, level = np.linalg.norm(ray, axis=1), np.hypot(ray[:, 0], ray[:, 2])
        pairs = np.column_stack([np.zeros(len(ray), int), np.arange(len(ray))])
        seen = reached(eye[None], surface.points, pairs, 0.01) & (np.abs(ray[:, 1]) < 0.8 * level)
        size += seen * np.maximum(-(ray * surface.normals).sum(axis=1), 0) / far**3
    assert surface.shown.mean() == pytest.approx(1)
    assert np.corrcoef(size, surface.shown)[0, 1] > 0.75
    wall, ceiling = np.abs(surface.points[:, 1] - SETTINGS.sensor_height_m) < 0.3, surface.normals[:, 1] < -0.9
    assert surface.shown[wall].mean() > 2 * surface.shown[ceiling].mean()


def test_where_no_level_picture_shows_anything_all_points_count_alike():
    class Platform(Corridor):
        def render(self, camera_to_world, intrinsics, *, rgb):
            frames = super().render(camera_to_world, intrinsics, rgb=rgb)
            level = np.abs(camera_to_world[:, 1, 1]) > 0.999
            return replace(frames, depth=np.where(level[:, None, None], 0, frames.depth))

    assert (scene_surface(Platform(), SETTINGS).shown == 1).all()


def test_the_points_are_the_same_every_time():
    again = scene_surface(Corridor(), SETTINGS)
    np.testing.assert_array_equal(again.points, scene_surface(SIMULATOR, SETTINGS).points)


@pytest.mark.parametrize(
    ("eye", "quality"),
    [
        ((0, 0, 1.0), 1.0),
        ((0, 0, 2.0), 1.0),
        ((0, 0, 8.0), 0.25),
        ((3.0, 0, 3.0), np.sqrt(0.5) * 2 / np.sqrt(18)),
        ((0, 0, -1.0), 0.0),
        ((1.0, 0, 0.0), 0.0),
    ],
)
def test_a_surface_is_seen_well_from_near_and_straight_on(eye, quality):
    assert view_quality(np.array([eye]), np.zeros((1, 3)), np.array([[0.0, 0, 1]])) == pytest.approx(quality)


def seen_by_hand(settings, simulator, surface, pose):
    """Quality of every point in one view, in plain Python from the definition; 0 for what it does not show."""
    k, world_to_camera = settings.intrinsics.matrix, np.linalg.inv(poses.habitat_to_opencv(pose))
    found = np.zeros(len(surface.points))
    for j, (point, normal) in enumerate(zip(surface.points, surface.normals, strict=True)):
        u, v, w = k @ (world_to_camera @ np.append(point, 1))[:3]
        ray = pose[:3, 3] - point
        far = np.sqrt(ray @ ray)
        if w <= 0 or not (0 <= u / w < settings.width and 0 <= v / w < settings.height) or far > settings.max_range_m:
            continue
        if simulator.visible(pose[None], settings.intrinsics, point[None], PAIR, tolerance_m=settings.tolerance_m)[0]:
            found[j] = max(0.0, ray @ normal / far) * min(1.0, 2.0 / far)
    return found


def test_new_surface_is_by_how_much_the_best_views_of_the_points_grow():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=2)
    feet, yaw = SIMULATOR.area.centres[[100, 900]], np.array([0.3, -2.0])
    task.reset(range(2), feet, yaw)
    surface = scene_surface(SIMULATOR, SETTINGS)
    best = np.zeros((2, len(surface.points)))
    for t, action in enumerate(WALK):
        outcome = task.step(np.array([action, WALK[-1 - t]]))
        for i in range(2):
            shown = seen_by_hand(SETTINGS, SIMULATOR, surface, task.camera_to_world[i])
            grown = np.maximum(best[i], shown)
            assert outcome.facts.new_surface[i] == pytest.approx((grown - best[i]).sum(), abs=1e-3)
            best[i] = grown
            assert task.surface_share(i) == pytest.approx(grown.mean(), abs=1e-5)
    assert best.mean() > 0.02
    assert task.trajectory(1).surface == task.surface_share(1)


def test_a_start_forgets_what_was_seen_by_its_agent_alone():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=2)
    task.reset(range(2), SIMULATOR.area.centres[[100, 900]], np.zeros(2))
    task.step(np.array([1, 1]))
    before = task.surface_share(0)
    task.reset([1], SIMULATOR.area.centres[[5]], np.zeros(1))
    assert (task.surface_share(0), task.surface_share(1)) == (before, 0.0)
    assert before > 0


@pytest.mark.parametrize("other", ["builtin:1", None])
def test_tables_and_rays_agree_over_whole_episodes(room, other):
    rooms = [room] if other is None else [room, make_simulator("raycast", other)]
    agents = 4
    tasks = [
        ViewpointTask(rooms, TaskSettings(reward="surface", observation="surface_map", lookup=lookup), agents=agents)
        for lookup in (False, True)
    ]
    rng = np.random.default_rng(0)
    feet = np.concatenate([rooms[i % len(rooms)].area.random_points(rng, 1) for i in range(agents)])
    yaw = rng.uniform(-np.pi, np.pi, agents)
    for task in tasks:
        task.reset(range(agents), feet, yaw)
    gains = []
    for _ in range(80):
        actions = rng.choice(6, p=[0.4, 0.25, 0.1, 0.1, 0.1, 0.05], size=agents)
        outcomes = [task.step(actions) for task in tasks]
        gains.append([outcome.facts.new_surface for outcome in outcomes])
    shares = np.array([[task.surface_share(i) for i in range(agents)] for task in tasks])
    assert np.abs(shares[0] - shares[1]).max() < 0.005
    assert shares[0].min() > 0.05
    cast, looked_up = np.array(gains).transpose(1, 0, 2)
    assert np.abs(cast - looked_up).mean() < 0.01 * cast.mean()


def test_a_surface_table_holds_what_rays_from_its_place_reach(room, tmp_path, monkeypatch):
    monkeypatch.setenv("AVP_CACHE", str(tmp_path))
    settings = TaskSettings(reward="surface", lookup=True)
    tables, points = surface_tables.__wrapped__(room, settings), scene_surface(room, settings).points
    feet = room.area.centres[[100]]
    slots, _ = tables.around(feet)
    eye = tables.lattice.feet(tables.lattice.around(feet)[0][0]) + [0, 1.5, 0]
    pairs = np.argwhere(np.ones((4, len(points)), dtype=bool))
    reached = room.reached(eye, points, pairs, tolerance_m=0.1).reshape(4, -1)
    np.testing.assert_array_equal(unpack(tables.columns["visible"][slots[0]], len(points)), reached)
    again = surface_tables.__wrapped__(room, settings)
    again._compute = None
    again.around(feet)
    np.testing.assert_array_equal(again.columns["visible"], tables.columns["visible"])


def test_tasks_on_one_simulator_share_tables_and_a_lower_camera_has_its_own(room):
    settings = TaskSettings(reward="surface", lookup=True)
    assert surface_tables(room, settings) is surface_tables(room, TaskSettings(observation="surface_map", width=20))
    assert surface_tables(room, settings) is not surface_tables(room, TaskSettings(sensor_height_m=1.2))


@pytest.mark.parametrize(("reward", "observation"), [("proposed", "map"), ("coverage", "numbers")])
def test_nothing_is_computed_that_neither_reward_nor_observation_needs(reward, observation):
    simulator = Corridor()
    task = ViewpointTask(simulator, TaskSettings(reward=reward, observation=observation), agents=1)
    task.reset([0], simulator.area.centres[:1], np.zeros(1))
    assert task.step(np.array([0])).facts.new_surface == 0
    assert task.surface_share(0) is None
    assert task._rooms[0].surface is None


def test_the_figures_of_an_episode_say_how_much_surface_was_seen():
    for reward, known in (("surface", True), ("proposed", False)):
        env = AVPEnv(simulator=Corridor(), reward=reward, width=16, height=12, budget=2)
        env.reset(seed=0)
        env.step(1)
        info = env.step(1)[4]
        assert ("surface" in info["avp_episode"]) == known
        assert (info["reward_parts"].get("surface", 0) > 0) == known


def test_a_scene_without_surfaces_is_a_plain_error():
    empty = Corridor()
    empty.render = lambda poses, camera, rgb: type("F", (), {"depth": np.zeros((len(poses), 72, 96), np.float32)})
    with pytest.raises(UsageError, match="corridor shows none; expected walls or furniture"):
        ViewpointTask(empty, SETTINGS, agents=1)


def maps_by_hand(surface, quality, eye, yaw):
    """The maps in plain Python from the channels' description."""
    counts, sums = np.zeros((2, len(GROUPS), SIDE, SIDE))
    for point, normal, q in zip(surface.points, surface.normals, quality, strict=True):
        x, z = point[0] - eye[0], point[2] - eye[2]
        row = int(np.floor(SIDE / 2 - (-np.sin(yaw) * x - np.cos(yaw) * z) / CELL_M))
        column = int(np.floor(SIDE / 2 + (np.cos(yaw) * x - np.sin(yaw) * z) / CELL_M))
        if q == 0 or not (0 <= row < SIDE and 0 <= column < SIDE):
            continue
        side = "low" if point[1] < eye[1] else "high"
        group = "up" if normal[1] > np.sqrt(0.5) else "down" if normal[1] < -np.sqrt(0.5) else side
        counts[GROUPS.index(group), row, column] += 1
        sums[GROUPS.index(group), row, column] += q
    mean = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0)
    return np.stack([np.minimum(counts / FULL, 1), mean], axis=1).ravel()


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.5])
def test_the_surface_map_is_that_of_its_description(yaw):
    surface, rng = scene_surface(SIMULATOR, SETTINGS), np.random.default_rng(1)
    quality = np.zeros((3, len(surface.points)), dtype=np.float32)
    quality[1] = rng.random(len(surface.points)) * (rng.random(len(surface.points)) < 0.5)
    position = np.array([[1.03, 0.02, 1.27]])
    drawn = SurfaceMapper(surface, 1.5).observe(quality, np.array([1]), position, np.array([yaw]))
    expected = maps_by_hand(surface, quality[1], position[0] + [0, 1.5, 0], yaw)
    assert expected.reshape(len(GROUPS), 2, -1).sum(axis=-1).min() > 0
    np.testing.assert_allclose(drawn[0], expected, atol=1e-5)


def test_points_that_were_not_seen_do_not_enter_the_map():
    surface = scene_surface(SIMULATOR, SETTINGS)
    seen = surface.points[:, 0] < 2.0
    quality = np.where(seen, 0.5, 0.0).astype(np.float32)[None]
    part = replace(surface, **{name: values[seen] for name, values in vars(surface).items()})
    here = (np.array([0]), np.array([[1.5, 0.0, 1.5]]), np.array([0.3]))
    drawn = SurfaceMapper(surface, 1.5).observe(quality, *here)
    assert drawn.sum() > 0
    np.testing.assert_array_equal(drawn, SurfaceMapper(part, 1.5).observe(quality[:, seen], *here))


def test_the_observation_is_that_of_the_map_followed_by_the_surface():
    tasks = [ViewpointTask(SIMULATOR, TaskSettings(observation=kind), agents=2) for kind in ("map", "surface_map")]
    for task in tasks:
        task.reset(range(2), SIMULATOR.area.centres[[5, 300]], np.array([np.pi, 0.0]))
    floor, both = (task.step(np.array([1, 1])).observation for task in tasks)
    np.testing.assert_array_equal(both[:, : floor.shape[1]], floor)
    task = tasks[1]
    drawn = task._rooms[0].surface.observe(np.arange(2), task.position, task.yaw)
    np.testing.assert_array_equal(both[:, floor.shape[1] :], drawn)
    space = AVPEnv(simulator=SIMULATOR, observation="surface_map").observation_space
    assert all(space.contains(row) for row in both)
    assert PRESETS["surface_map"] is PRESETS["map"]
