import gc
import io
import warnings
import weakref
from dataclasses import replace

import numpy as np
import pytest
from corridor import Corridor

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.sight import panorama
from avp_habitat.sight.bits import pack, unpack
from avp_habitat.sight.lattice import Lattice, TileFiles, cache_folder
from avp_habitat.sight.newly_seen import new_cells, new_surface
from avp_habitat.sight.rules import camera_numbers, candidates, view_quality
from avp_habitat.sight.tables import scene_tables
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.cast import CastSensor
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.task import ViewpointTask
from avp_habitat.task.views import Views, depth_statistics

make_scene_tables = scene_tables.__wrapped__  # shared with nobody
SETTINGS = TaskSettings(reward="coverage", lookup=True)
CAMERA = SETTINGS.intrinsics


@pytest.fixture(scope="module")
def room():
    return make_simulator("raycast", "builtin:3")


@pytest.fixture
def tables(room, tmp_path, monkeypatch):
    monkeypatch.setenv("AVP_CACHE", str(tmp_path))
    return make_scene_tables(room, SETTINGS)


def views_at(area, count, seed):
    rng = np.random.default_rng(seed)
    feet = area.random_points(rng, count)
    yaw = rng.uniform(-np.pi, np.pi, count)
    pitch = np.radians(rng.integers(-6, 7, count) * 10.0)
    return Views(feet, yaw, pitch, camera_to_world(feet + [0, 1.5, 0], yaw=yaw, pitch=pitch))


def test_whole_episodes_cover_the_same_and_read_depths_within_one_percent_of_the_range(room):
    tasks = [ViewpointTask(room, TaskSettings(reward="coverage", lookup=lookup), agents=4) for lookup in (False, True)]
    rng = np.random.default_rng(0)
    feet, yaw = room.area.random_points(rng, 4), rng.uniform(-np.pi, np.pi, 4)
    difference = [np.abs(np.subtract(*(task.reset(range(4), feet, yaw) for task in tasks)))]
    for _ in range(80):
        actions = rng.choice(6, p=[0.45, 0.25, 0.1, 0.05, 0.1, 0.05], size=4)
        cast, looked_up = (task.step(actions) for task in tasks)
        difference.append(np.abs(cast.observation - looked_up.observation))
    assert np.abs(tasks[0].coverage - tasks[1].coverage).max() < 0.01
    assert tasks[0].coverage.mean() > 0.1
    depth = np.array(difference)[:, :, 7:9]
    assert depth.mean(axis=(0, 1)) == pytest.approx([0, 0], abs=0.002)
    assert np.quantile(depth, 0.95) < 0.01
    np.testing.assert_allclose(np.delete(np.array(difference), (7, 8, 9), axis=2), 0, atol=1e-6)


def test_cells_that_are_looked_up_are_those_that_rays_reach(room):
    task = ViewpointTask(room, SETTINGS, agents=1)
    cast = CastSensor(room, SETTINGS)
    views = views_at(room.area, 30, seed=3)
    cells = len(room.area.centres)
    by_ray, looked_up = np.zeros((2, 30, cells), dtype=np.int16)
    everyone, steps = np.arange(30), np.full(30, 7)
    from_rays = cast.capture(views, by_ray, everyone, steps)
    from_tables = task._rooms[0].sensor.capture(views, looked_up, everyone, steps)
    assert by_ray.sum() > 0
    assert np.count_nonzero(by_ray != looked_up) <= 0.005 * np.count_nonzero(by_ray)
    np.testing.assert_array_equal(from_tables.new_cells, np.count_nonzero(looked_up, axis=1))
    np.testing.assert_array_equal(from_rays.new_cells, np.count_nonzero(by_ray, axis=1))


def test_a_table_holds_what_rays_from_its_place_reach(room, tables):
    feet = room.area.centres[[100, 500]]
    slots, weights = tables.around(feet)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    points, _ = tables.lattice.around(feet)
    eye = tables.lattice.feet(points[0]) + [0, 1.5, 0]
    cells = len(room.area.centres)
    pairs = np.argwhere(np.ones((4, cells), dtype=bool))
    reached = room.reached(eye, room.area.centres, pairs, tolerance_m=0.1).reshape(4, cells)
    np.testing.assert_array_equal(unpack(tables.columns["visible"][slots[0]], cells), reached)


def test_panoramas_give_the_statistics_of_depth_images(room):
    rng = np.random.default_rng(1)
    eye = room.area.random_points(rng, 20) + [0, 1.5, 0]
    pitches = tuple(np.radians([-40.0, -10.0, 0.0, 20.0]))
    found = panorama.view_statistics(panorama.look_around(room, eye), panorama.view_samples(CAMERA, pitches), 10.0)
    yaw, pitch = rng.integers(panorama.YAWS, size=20), rng.integers(len(pitches), size=20)
    pose = camera_to_world(eye, yaw=2 * np.pi / panorama.YAWS * yaw, pitch=np.array(pitches)[pitch])
    truth = depth_statistics(room.render(pose, CAMERA, rgb=False).depth, 10.0)
    error = np.abs(found[np.arange(20), yaw, pitch] / 65535 - np.stack(truth, axis=1))
    assert error.mean(axis=0) == pytest.approx([0, 0], abs=0.003)


def test_every_place_lies_between_its_four_lattice_points(room):
    lattice = Lattice(room.area, 0.1)
    feet = room.area.random_points(np.random.default_rng(2), 200)
    points, weights = lattice.around(feet)
    plane = room.area.origin + 0.1 * points
    np.testing.assert_allclose((plane * weights[..., None]).sum(axis=1), feet[:, [0, 2]], atol=1e-9)


def test_lattice_points_beyond_a_wall_are_drawn_back_before_it(room):
    lattice = Lattice(room.area, 0.1)
    grid = np.argwhere(np.ones(lattice.shape, dtype=bool))
    feet = lattice.feet(grid)
    away = np.linalg.norm((feet - room.area.nearest(feet))[:, [0, 2]], axis=1)
    assert away.max() <= 0.08 + 1e-9
    inside = room.area.contains(feet)
    np.testing.assert_allclose(feet[inside][:, [0, 2]], (room.area.origin + 0.1 * grid)[inside], atol=0.1)


def test_tables_are_read_from_disk_and_not_made_again(room, tables):
    feet = room.area.centres[:1]
    tables.around(feet)

    class NoRays:
        name, area, scene_digest = room.name, room.area, room.scene_digest

    again = make_scene_tables(NoRays(), SETTINGS)
    again.around(feet)
    assert_same_columns(again, tables)


def assert_same_columns(found, expected):
    for name in ("visible", "statistics"):
        np.testing.assert_array_equal(found.columns[name], expected.columns[name])


def same_layout_other_content(content):
    """An archive without a fault of its own: the same arrays, some of their values changed, without a digest."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: np.array(file[name]) for name in file}
    arrays["visible"][::3] ^= np.uint64(1)
    written = io.BytesIO()
    np.savez(written, **arrays)
    return written.getvalue()


DAMAGES = {
    "not an archive": lambda _: b"not an archive",
    "empty": lambda _: b"",
    "cut": lambda content: content[:-1000],
    "one bit": lambda content: content[:5000] + bytes([content[5000] ^ 4]) + content[5001:],
    "another program's arrays": same_layout_other_content,
    "other arrays with the old digest": lambda content: same_layout_other_content(content) + content[-32:],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_tile_is_made_anew(room, tables, tmp_path, damage):
    feet = room.area.centres[:1]
    tables.around(feet)
    file = sorted(tmp_path.rglob("*.npz"))[0]
    sound = file.read_bytes()
    damaged = DAMAGES[damage](sound)
    assert damaged != sound
    file.write_bytes(damaged)
    again = make_scene_tables(room, SETTINGS)
    again.around(feet)
    assert_same_columns(again, tables)
    assert file.read_bytes() == sound


def test_a_tile_of_other_settings_in_its_place_is_made_anew(room, tables, tmp_path):
    """Points, types and shapes are the same: only the digest tells the tile of a camera 0.5 m lower."""
    low = make_scene_tables(room, replace(SETTINGS, sensor_height_m=1.0))
    for each in (low, tables):
        each.around(room.area.centres[:1])
    files = sorted(tmp_path.rglob("*.npz"), key=lambda path: path.stat().st_mtime_ns)
    assert len(files) == 2
    assert files[0].name == files[1].name
    files[1].write_bytes(files[0].read_bytes())
    again = make_scene_tables(room, SETTINGS)
    again.around(room.area.centres[:1])
    assert (low.columns["visible"] != tables.columns["visible"]).any()
    assert_same_columns(again, tables)


def test_a_disk_that_cannot_be_written_costs_a_warning(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("AVP_CACHE", str(tmp_path / "file"))
    points, words, numbers = np.zeros((1, 2), int), np.zeros((1, 1), np.uint64), np.zeros((1, 2, 3, 2), np.uint16)
    with pytest.warns(UserWarning, match="tables are not kept"):
        TileFiles("name").write((0, 0), points, {"visible": words, "statistics": numbers})


def test_an_empty_cache_variable_keeps_nothing_on_disk(monkeypatch):
    monkeypatch.setenv("AVP_CACHE", "")
    assert cache_folder() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TileFiles("name").write((0, 0), np.zeros((1, 2)), {"visible": np.zeros((1, 1))})


def test_tasks_with_equal_cameras_share_tables(room):
    assert scene_tables(room, SETTINGS) is scene_tables(room, TaskSettings(reward="proposed", budget=5))
    assert scene_tables(room, SETTINGS) is not scene_tables(room, TaskSettings(hfov_deg=70.0))


def test_a_simulator_without_rays_is_refused():
    with pytest.raises(
        UsageError, match=r"lookup: needs single rays .* 'corridor' does not cast; leave lookup off, or use"
    ):
        ViewpointTask(Corridor(), TaskSettings(lookup=True), agents=1)


def test_wide_coverage_is_not_in_the_tables(room):
    with pytest.raises(UsageError, match=r"lookup: the tables know coverage_mode 'visible' only, got 'over'"):
        ViewpointTask(room, TaskSettings(lookup=True, coverage_mode="over"), agents=1)


@pytest.mark.parametrize("limit", [0.0, 25.0, 60.0])
def test_any_pitch_limit_is_looked_up(room, limit):
    settings = TaskSettings(reward="coverage", pitch_limit_deg=limit, lookup=True)
    task = ViewpointTask(room, settings, agents=1)
    truth = ViewpointTask(room, TaskSettings(reward="coverage", pitch_limit_deg=limit), agents=1)
    start = room.area.centres[:1]
    for each in (task, truth):
        each.reset([0], start, np.zeros(1))
    for action in (4, 4, 4, 4, 3, 3, 3, 3, 3, 3, 3):
        found, expected = (each.step(np.array([action])).observation for each in (task, truth))
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_what_the_places_differ_on_is_returned_and_what_all_see_is_entered(room):
    camera, count = Intrinsics(40, 90, 50.0, 60.0, 12.0, 70.0), 60
    views, centres = views_at(room.area, count, seed=5), room.area.centres
    pose, normals = views.camera_to_world, np.tile([0.0, 1.0, 0.0], (len(centres), 1))
    shown = np.linspace(0, 2, len(centres))
    inside = candidates(pose, camera, centres, np.ones((count, len(centres)), bool), max_range_m=4.0)
    assert len(inside) > len(centres)  # more than there is room for at first
    quality = view_quality(pose[:, :3, 3], centres, normals)[tuple(inside.T)].astype(np.float32)
    members = np.zeros((2, len(centres)), bool)
    members[1] = True
    numbers, rows, steps = camera_numbers(camera), np.arange(count), np.full(count, 3)
    for slots, sure in ((np.ones((count, 4), np.int32), True), (np.tile(np.int32([0, 1, 0, 0]), (count, 1)), False)):
        seen = np.zeros((count, len(centres)), np.int16)
        found, pairs = new_cells(pack(members), slots, pose, centres, numbers, 4.0, rows, steps, seen)
        assert (found.sum(), len(pairs)) == ((len(inside), 0) if sure else (0, len(inside)))
        np.testing.assert_array_equal(np.argwhere(seen == 3) if sure else pairs, inside)
        best = np.zeros((count, len(centres)), np.float32)
        pairing = np.zeros((count, 0), np.float32), np.zeros((count, 0, 0), np.uint64), np.zeros((count, 1, 3))
        memory, asked = (rows, best, pairing, np.zeros(count, np.int64)), np.full((count, len(centres)), -1, np.int16)
        grown, again, values = new_surface(
            pack(members), slots, pose, centres, normals, shown, numbers, 4.0, *memory, asked
        )
        np.testing.assert_allclose(best[tuple(inside.T)] if sure else values, quality, rtol=1e-6)
        once_more = new_surface(pack(members), slots, pose, centres, normals, shown, numbers, 4.0, *memory, asked)
        assert (len(again), len(once_more[1])) == ((0, 0) if sure else (len(inside), 0))
        assert grown[:, 0].sum() == pytest.approx(quality.sum() if sure else 0, rel=1e-4)
        assert grown[:, 2].sum() == pytest.approx(quality @ shown[inside[:, 1]] if sure else 0, rel=1e-4)


def test_tables_live_as_long_as_their_simulator_and_no_longer():
    simulator = make_simulator("raycast", "builtin:1")
    tables = weakref.ref(scene_tables(simulator, SETTINGS))
    gc.collect()
    assert tables() is scene_tables(simulator, SETTINGS)
    del simulator
    gc.collect()
    assert tables() is None
