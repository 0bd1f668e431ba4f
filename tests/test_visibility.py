import json
import os
import subprocess
import sys

import numpy as np
import pytest
from corridor import Corridor
from hypothesis import given, settings
from hypothesis import strategies as st
from small_rollout import write_small_rollout

from avp_habitat import poses, seen
from avp_habitat.command import run
from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.scenes.loader import load_scene
from avp_habitat.sight.visibility import (
    ALIKE_DEG,
    ALIKE_DISTANCE,
    PARALLAX_DEG,
    HeldoutPoints,
    grid_stride,
    heldout_points,
    points_seen,
    visibility,
)
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.tracking.rollout_run import figures

CAMERA = Intrinsics.from_hfov(64, 48, hfov_deg=90)
CORRIDOR = Corridor()


def pose_at(x, y, z, *, yaw_deg=0.0, pitch_deg=0.0):
    return poses.camera_to_world(np.array([[x, y, z]]), yaw=np.radians([yaw_deg]), pitch=np.radians([pitch_deg]))[0]


def views_of(simulator, camera_to_world, camera=CAMERA):
    """Depth as rollouts keep it, in whole millimetres, with the poses."""
    depth = simulator.render(np.stack(camera_to_world), camera, rgb=False).depth
    return list(zip(np.round(depth, 3), camera_to_world, strict=True))


def random_poses(simulator, seed, count):
    rng = np.random.default_rng(seed)
    position = simulator.area.random_points(rng, count) + [0, 1.5, 0]
    yaw, pitch = rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.6, 0.6, count)
    return list(poses.camera_to_world(position, yaw=yaw, pitch=pitch))


def measured(simulator, heldout, frames, camera=CAMERA, stride=1):
    points = heldout_points(views_of(simulator, heldout, camera), camera, stride=stride)
    return visibility(points, views_of(simulator, frames, camera) if frames else [], camera)


# Against rays


@pytest.fixture(scope="module")
def room():
    return RaycastSimulator(load_scene("builtin:0"))


def reached_by_rays(simulator, points, pose, camera):
    """One point at a time: in the image by the camera's matrix, and its ray's first surface has the point's depth."""
    world_to_camera = np.linalg.inv(poses.habitat_to_opencv(pose))
    reached = np.zeros(len(points), bool)
    for index, point in enumerate(points):
        local = (world_to_camera @ np.append(point, 1.0))[:3]
        if local[2] <= 0:
            continue
        u, v, w = camera.matrix @ local
        if not (0 <= u / w < camera.width and 0 <= v / w < camera.height):
            continue
        offset = point - pose[:3, 3]
        length = np.sqrt(offset @ offset)
        hit = simulator.distance(pose[None, :3, 3], offset[None] / length)[0]
        reached[index] = abs(hit / length - 1) * local[2] <= max(0.01, 0.005 * local[2])
    return reached


def test_what_depth_pictures_say_is_what_rays_say(room):
    camera = Intrinsics.from_hfov(640, 480, hfov_deg=90)
    heldout, frames = random_poses(room, 1, 4), random_poses(room, 2, 5)
    points = heldout_points(views_of(room, heldout, camera), camera, stride=40)
    by_rays = np.stack([reached_by_rays(room, points.xyz, pose, camera) for pose in frames])
    found = visibility(points, views_of(room, frames, camera), camera)
    assert 0.2 < by_rays.any(axis=0).mean() < 0.8, "some must be seen and some not for this test to mean anything"
    assert np.mean((found.count >= 1) == by_rays.any(axis=0)) >= 0.99
    assert np.mean(found.count == by_rays.sum(axis=0)) >= 0.97
    assert found.figures()["visibility"] == pytest.approx(by_rays.any(axis=0).mean(), abs=0.01)


@pytest.mark.parametrize(("width", "height", "least"), [(64, 48, 0.98), (160, 120, 0.99), (320, 200, 0.995)])
def test_in_the_corridor_they_agree_at_any_resolution(width, height, least):
    camera = Intrinsics.from_hfov(width, height, hfov_deg=90)
    heldout, frames = random_poses(CORRIDOR, 3, 6), random_poses(CORRIDOR, 4, 4)
    points = heldout_points(views_of(CORRIDOR, heldout, camera), camera, stride=grid_stride(camera, 200))
    depth = views_of(CORRIDOR, frames, camera)
    pixel, planar = poses.project(points.xyz, np.stack(frames), camera)
    inside = (planar > 0) & (pixel >= 0).all(axis=-1) & (pixel < [width, height]).all(axis=-1)
    pairs = np.argwhere(inside)
    by_rays = CORRIDOR.visible(np.stack(frames), camera, points.xyz, pairs, tolerance_m=0.01)
    found = np.zeros_like(inside)
    for index, (picture, pose) in enumerate(depth):
        found[index, points_seen(picture, pose, camera, points.xyz)] = True
    assert 0.3 < by_rays.mean() < 0.97
    assert not found[~inside].any()
    assert np.mean(found[pairs[:, 0], pairs[:, 1]] == by_rays) >= least


# By hand: the corridor's dividing wall stands at x = 2.9 ... 3.1 m from z = 0 to z = 1.8 m


def test_a_wall_is_seen_from_its_own_side_only():
    looks_at_wall = pose_at(1.5, 1.5, 0.9, yaw_deg=-90)
    other_side = pose_at(4.5, 1.5, 0.9, yaw_deg=90)
    middle = np.array([[2.9, 1.5, 0.9], [3.1, 1.5, 0.9]])
    for pose, expected in ((looks_at_wall, [0]), (other_side, [1])):
        ((depth, _),) = views_of(CORRIDOR, [pose])
        assert points_seen(depth, pose, CAMERA, middle).tolist() == expected


def test_what_stands_behind_another_wall_or_behind_the_camera_is_not_seen():
    points = np.array([[6.0, 1.5, 0.9], [6.0, 1.5, 2.9], [0.0, 1.5, 2.4]])
    pose = pose_at(1.0, 1.5, 2.4, yaw_deg=-90)
    ((depth, _),) = views_of(CORRIDOR, [pose])
    assert points_seen(depth, pose, CAMERA, points).tolist() == [1]


def test_a_frame_that_looks_away_sees_nothing_of_a_view():
    found = measured(CORRIDOR, [pose_at(1.5, 1.5, 1.5, yaw_deg=90)], [pose_at(1.5, 1.5, 1.5, yaw_deg=-90)])
    assert found.figures()["visibility"] == 0
    assert found.first.tolist() == [1] * (64 * 48)
    assert found.per_view().tolist() == [0.0]


def test_a_turned_frame_shares_the_pixels_that_both_pictures_hold():
    # 90 degrees wide, turned by 45: the half of the first view that lies towards the second, cut by the top and bottom.
    camera = Intrinsics.from_hfov(320, 240, hfov_deg=90)
    found = measured(CORRIDOR, [pose_at(1.5, 1.5, 1.5)], [pose_at(1.5, 1.5, 1.5, yaw_deg=45)], camera)
    share = found.figures()["visibility"]
    u, v = np.meshgrid((np.arange(320) - 159.5) / 160, (np.arange(240) - 119.5) / 160)
    x, z = (u + 1) / np.sqrt(2), (1 - u) / np.sqrt(2)
    expected = np.mean((x >= -z) & (x < z) & (np.abs(v) < 0.75 * z))
    assert share == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("slope_deg", [0.0, 60.0, 80.0])
def test_slopes_and_millimetres_do_not_matter_on_a_plane(slope_deg):
    """The plane y = 0 seen under any slope, from a picture of 16x12 pixels."""
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=60)
    pose = pose_at(0, 1.5, 0, pitch_deg=slope_deg - 90)
    rays = poses.pixel_directions(camera) @ pose[:3, :3].T
    depth = np.where(rays[..., 1] < -0.02, 1.5 / np.maximum(-rays[..., 1], 1e-6), 0)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(1, 15, 400), rng.uniform(6, 11, 400)
    local = np.stack([(u - 8) / camera.fx, -(v - 6) / camera.fy, -np.ones(400)], axis=1) @ pose[:3, :3].T
    on_plane = pose[:3, 3] + local * (1.5 / -local[:, 1:2])
    assert len(points_seen(np.round(depth, 3), pose, camera, on_plane)) == 400
    nearer = pose[:3, 3] + (on_plane - pose[:3, 3]) * 0.7
    assert len(points_seen(np.round(depth, 3), pose, camera, nearer)) == 0


def test_the_tolerance_is_one_centimetre_or_half_a_percent():
    pose, depth = pose_at(0, 0, 0), np.full((48, 64), 1.0)
    for true_m, off_m, expected in ((1.0, 0.0095, 1), (1.0, 0.0105, 0), (8.0, 0.039, 1), (8.0, 0.041, 0)):
        for sign in (-1, 1):
            point = np.array([[0.01, 0.01, -(true_m + sign * off_m)]])
            assert len(points_seen(depth * true_m, pose, CAMERA, point)) == expected


# Counting


def test_frames_rays_and_distances_are_counted():
    """One surface point 2 m ahead of the held-out camera, in front of a wall of its own for every frame."""
    points = HeldoutPoints(np.array([[0.0, 0.0, -2.0]]), np.array([0]), np.zeros((1, 3)))

    def facing(x, z, yaw_deg, distance_m):
        return np.full((48, 64), distance_m), pose_at(x, 0, z, yaw_deg=yaw_deg)

    def answer(*frames):
        found = visibility(points, frames, CAMERA)
        return int(found.count[0]), bool(found.alike[0]), bool(found.parallax[0]), round(float(found.likeness[0]), 3)

    ahead, closer, far = facing(0, 0, 0, 2.0), facing(0, -1, 0, 1.0), facing(0, 2.5, 0, 4.5)
    aside = facing(2, -2, 90, 2.0)
    turned = facing(2 * np.sin(np.radians(9)), -2 + 2 * np.cos(np.radians(9)), 9, 2.0)
    more = facing(2 * np.sin(np.radians(11)), -2 + 2 * np.cos(np.radians(11)), 11, 2.0)
    assert (ALIKE_DEG, ALIKE_DISTANCE, PARALLAX_DEG) == (60, 2, 10)
    assert answer() == (0, False, False, 0.0)
    assert answer(ahead) == (1, True, False, 1.0)
    assert answer(ahead, ahead, closer) == (3, True, False, 1.0)
    assert visibility(points, [ahead, ahead, more, more], CAMERA).curve(parallax=True).tolist() == [0, 0, 1, 1]
    assert answer(closer) == (1, True, False, 1.0)
    assert answer(far) == (1, False, False, 0.444)
    assert answer(aside) == (1, False, False, 0.0)
    assert answer(ahead, turned) == (2, True, False, 1.0)
    assert answer(ahead, more) == (2, True, True, 1.0)
    assert answer(aside, ahead) == (2, True, True, 1.0)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), few=st.integers(0, 3), more=st.integers(0, 3))
def test_more_frames_never_lower_a_figure_and_the_curve_is_that_of_the_first_frames(seed, few, more):
    frames, heldout = random_poses(CORRIDOR, seed, few + more), random_poses(CORRIDOR, seed + 1, 2)
    small, large = (measured(CORRIDOR, heldout, part, stride=4) for part in (frames[:few], frames))
    for name, value in small.figures().items():
        assert 0 <= value <= large.figures()[name] <= 1
    assert (small.count <= large.count).all()
    assert len(large.curve()) == few + more
    if few:
        assert large.curve()[few - 1] == pytest.approx(small.figures()["visibility"])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_held_out_views_that_were_captured_themselves_are_seen_whole(seed):
    heldout = random_poses(CORRIDOR, seed, 3)
    found = measured(CORRIDOR, heldout, random_poses(CORRIDOR, seed + 1, 1) + heldout)
    assert found.figures()["visibility"] == found.figures()["visibility_alike"] == 1.0
    assert found.figures()["visibility_weighted"] == pytest.approx(1.0)
    assert found.per_view().tolist() == [1.0] * 3


def test_the_order_of_frames_matters_to_no_share_but_the_parallax():
    frames, heldout = random_poses(CORRIDOR, 5, 6), random_poses(CORRIDOR, 6, 3)
    one, other = measured(CORRIDOR, heldout, frames), measured(CORRIDOR, heldout, frames[::-1])
    np.testing.assert_array_equal(one.count, other.count)
    np.testing.assert_allclose(one.likeness, other.likeness)
    assert one.figures()["visibility_parallax"] == pytest.approx(other.figures()["visibility_parallax"], abs=0.05)


def test_pixels_without_depth_are_not_counted():
    depth = np.full((48, 64), 2.0)
    depth[:, :16] = 0
    pose = pose_at(0, 0, 0)
    points = heldout_points([(depth, pose), (np.zeros((48, 64)), pose)], CAMERA, stride=1)
    assert len(points.xyz) == 48 * 48
    found = visibility(points, [(depth, pose)], CAMERA)
    np.testing.assert_array_equal(found.per_view(), [1.0, np.nan])
    assert found.figures()["visibility"] == 1.0
    assert visibility(points, [(np.zeros((48, 64)), pose)], CAMERA).figures()["visibility"] == 0.0


def test_nothing_to_test_gives_no_figure():
    empty = heldout_points([], CAMERA, stride=1)
    found = visibility(empty, [(np.ones((48, 64)), pose_at(0, 0, 0))], CAMERA)
    assert found.figures() == {}
    assert np.isnan(found.curve()).all()
    assert found.per_view().shape == (0,)


# The grid


def test_the_grid_is_every_nth_pixel_and_close_to_all_of_them():
    frames, heldout = random_poses(CORRIDOR, 7, 5), random_poses(CORRIDOR, 8, 20)
    camera = Intrinsics.from_hfov(160, 120, hfov_deg=90)
    every = measured(CORRIDOR, heldout, frames, camera, stride=1)
    grid = measured(CORRIDOR, heldout, frames, camera, stride=grid_stride(camera, 300))
    pictures, grids = (every.count >= 1).reshape(20, 120, 160), (grid.count >= 1).reshape(20, 15, 20)
    starts = {next((r, c) for r in range(8) for c in range(8) if np.array_equal(small, large[r::8, c::8]))
              for small, large in zip(grids, pictures, strict=True)}  # fmt: skip
    assert len(starts) > 5, "the views' grids begin at different pixels"
    assert grid.figures()["visibility"] == pytest.approx(every.figures()["visibility"], abs=0.01)
    with pytest.raises(ValueError, match="a stride of at least 1, got 0"):
        heldout_points([], camera, stride=0)


@pytest.mark.parametrize(("size", "stride"), [((640, 480), 16), ((24, 16), 1), ((1920, 1080), 42)])
def test_by_default_some_1200_pixels_of_a_view_are_tested(size, stride):
    assert grid_stride(Intrinsics.from_hfov(*size, hfov_deg=90)) == stride


# Rollouts


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    """Collected by the command: 12 frames and 20 held-out views of a furnished room."""
    folder = tmp_path_factory.mktemp("visibility") / "r"
    words = ["-m", "avp_habitat.collect", "--scene", "builtin:0", "--policy", "heuristic", "--budget", "12"]
    done = subprocess.run(
        [sys.executable, *words, "--width", "160", "--height", "120", "--out", str(folder), "--mlflow", "off"],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        check=True,
    )
    (folder.parent / "printed.txt").write_text(done.stdout)
    return folder


def test_the_figure_is_written_printed_and_tracked_with_the_others(rollout):
    found = read_rollout(rollout)
    written = found.meta["metrics"]["visibility"]
    assert 0.02 < written < 0.98
    again = visibility_of(found.frames, found.heldout, found.intrinsics)
    assert again.figures()["visibility"] == pytest.approx(written, abs=1e-3)
    assert f"  visibility           {written:.4g}" in (rollout.parent / "printed.txt").read_text()
    assert figures(found.meta)["eval/visibility"] == written
    assert set(figures(found.meta)) > {"eval/coverage", "eval/visibility"}


def test_the_rollout_agrees_with_rays_in_its_room(rollout, room):
    found = read_rollout(rollout)
    poses_of = np.stack([view.camera_to_world for view in found.frames])
    answer = visibility_of(found.frames, found.heldout, found.intrinsics)
    true = room.render(np.stack([v.camera_to_world for v in found.heldout]), found.intrinsics, rgb=False).depth
    views = [(depth, view.camera_to_world) for depth, view in zip(true, found.heldout, strict=True)]
    points = heldout_points(views, found.intrinsics, stride=grid_stride(found.intrinsics)).xyz
    pixel, planar = poses.project(points, poses_of, found.intrinsics)
    pairs = np.argwhere((planar > 0) & (pixel >= 0).all(axis=-1) & (pixel < [160, 120]).all(axis=-1))
    reached = room.visible(poses_of, found.intrinsics, points, pairs, tolerance_m=0.01)
    by_rays = np.zeros(len(points), bool)
    by_rays[pairs[reached, 1]] = True
    assert np.mean((answer.count >= 1) == by_rays) >= 0.98
    assert answer.figures()["visibility"] == pytest.approx(by_rays.mean(), abs=0.01)


def test_the_command_prints_a_line_for_each_rollout(rollout, capfd):
    assert run(seen.main, [str(rollout), str(rollout)]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].split()[:6] == ["rollout", "scene", "policy", "views", "coverage", "visibility"]
    assert lines[1] == lines[2]
    metrics = read_rollout(rollout).meta["metrics"]
    expected = [str(rollout), "builtin:0", "heuristic", "12"]
    expected += [f"{100 * metrics[name]:.1f}" for name in ("coverage", "visibility")]
    assert lines[1].split()[:6] == expected


def test_the_command_gives_programs_the_views_and_the_curve(rollout, capfd):
    assert run(seen.main, [str(rollout), "--json", "--every", "1"]) == 0
    (answer,) = json.loads(capfd.readouterr().out)
    assert answer["pixels"] == 20 * 160 * 120
    assert len(answer["per_view"]) == 20
    assert np.mean(answer["per_view"]) == pytest.approx(answer["visibility"])
    assert len(answer["curve"]) == 12
    assert answer["curve"][-1] == pytest.approx(answer["visibility"])
    assert answer["visibility"] == pytest.approx(read_rollout(rollout).meta["metrics"]["visibility"], abs=0.01)


def test_a_rollout_without_held_out_views_has_no_figure(tmp_path, capfd):
    folder = write_small_rollout(tmp_path / "small")
    assert run(seen.main, [str(folder)]) == 1
    assert "expected held-out views that show a surface, found 0 held-out views" in capfd.readouterr().err
    assert "visibility" not in read_rollout(folder).meta["metrics"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["{r}", "--every", "0"], 2, "--every: expected a whole number from 1, got 0"),
        (["{r}-none"], 1, "expected a rollout folder"),
    ],
)
def test_what_cannot_be_is_one_line(rollout, capfd, words, code, message):
    assert run(seen.main, [word.format(r=rollout) for word in words]) == code
    printed = capfd.readouterr().err.strip().splitlines()
    assert len(printed) == 1
    assert message in printed[0]


def test_a_damaged_depth_picture_is_named(rollout, tmp_path):
    found = read_rollout(rollout)
    path = tmp_path / "frame_00000.png"
    content = bytearray(found.frames[0].depth.read_bytes())
    content[200:260] = bytes(60)
    path.write_bytes(content)
    broken = type(found.frames[0])(found.frames[0].image, path, found.frames[0].camera_to_world)
    with pytest.raises(RolloutError, match=r"frame_00000\.png: expected a readable PNG, could not decode it"):
        visibility_of([broken], found.heldout, found.intrinsics)
