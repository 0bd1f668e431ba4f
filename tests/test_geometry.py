"""Figures of geometry: toys where each usual mistake gives a wrong number, and an independent implementation."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from corridor import Corridor
from scipy.spatial import cKDTree

from avp_habitat import collect, command
from avp_habitat.geometry import __main__ as geometry
from avp_habitat.geometry.fusion import fuse
from avp_habitat.geometry.placement import misplacement
from avp_habitat.geometry.scores import score
from avp_habitat.geometry.shape import Shape
from avp_habitat.geometry.truth import CAMERA, SceneTruth, observable, scene_truth
from avp_habitat.metrics import GEOMETRY
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.loader import load_scene
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TaskSettings


def plate(width, depth, x=0.0, y=0.0, z=0.0):
    """A level rectangle from a corner, two triangles."""
    corners = np.array([[0, 0, 0], [width, 0, 0], [width, 0, depth], [0, 0, depth]]) + [x, y, z]
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def both(a, b):
    triangles = np.concatenate([a.triangles, b.triangles + len(a.vertices)])
    return Shape(np.concatenate([a.vertices, b.vertices]), triangles)


def truth_of(whole, seen=None, heldout=None):
    """All of a shape is the scene, what is seen of it is all or another one."""
    poses = np.zeros((0, 4, 4)) if heldout is None else heldout
    return SceneTruth("toy", 10.0, whole, (seen or whole).samples(20_000, seed=1), poses, whole.depth(poses, CAMERA))


def test_half_of_a_floor_is_accurate_and_not_complete():
    found = score(plate(1, 1), truth_of(plate(2, 1)))
    assert (found.accuracy_m, found.precision) == (pytest.approx(0, abs=1e-6), 1.0)
    # The other half lies 0.5 m away on average; 0.05 m of it are near enough.
    assert found.completion_m == pytest.approx(0.25, abs=0.005)
    assert found.completion_ratio == pytest.approx(1.05 / 2, abs=0.01)
    assert found.chamfer_m == pytest.approx(0.125, abs=0.003)
    assert found.f_score == pytest.approx(2 * 0.525 / 1.525, abs=0.01)


def test_twice_the_floor_is_complete_and_not_accurate():
    found = score(plate(2, 1), truth_of(plate(1, 1)))
    assert (found.completion_m, found.completion_ratio) == (pytest.approx(0, abs=1e-6), 1.0)
    assert found.accuracy_m == pytest.approx(0.25, abs=0.005)
    assert found.precision == pytest.approx(1.05 / 2, abs=0.01)


def test_floaters_cost_accuracy_and_precision_alone():
    truth = truth_of(plate(2, 1))
    clean, dirty = score(plate(2, 1), truth), score(both(plate(2, 1), plate(0.2, 1, y=1.0)), truth)
    assert dirty.precision == pytest.approx(1 / 1.1, abs=0.01)
    assert dirty.accuracy_m == pytest.approx(0.1 / 1.1, abs=0.01)
    assert (dirty.completion_m, dirty.completion_ratio) == (clean.completion_m, clean.completion_ratio)


def test_what_nobody_can_see_need_not_be_reconstructed_but_is_no_mistake():
    seen, hidden = plate(1, 1), plate(1, 1, y=-1.0)
    truth = truth_of(both(seen, hidden), seen)
    assert score(seen, truth).completion_ratio == 1.0
    assert score(both(seen, hidden), truth).precision == 1.0


def test_depth_counts_whole_where_the_shape_shows_nothing():
    pose = camera_to_world(np.array([[1.0, 2.0, 0.5]]), yaw=np.zeros(1), pitch=np.full(1, -np.pi / 2))
    truth = truth_of(plate(8, 8, x=-3, z=-3), heldout=pose)
    assert score(plate(8, 8, x=-3, z=-3), truth).depth_l1_m == pytest.approx(0, abs=1e-6)
    assert score(plate(8, 8, x=-3, y=0.5, z=-3), truth).depth_l1_m == pytest.approx(0.5, abs=1e-5)
    assert score(plate(0.1, 0.1, x=50), truth).depth_l1_m == pytest.approx(2.0, abs=1e-5)


def test_agrees_with_nearest_neighbours_of_dense_points():
    scene = load_scene("builtin:3").mesh
    rng = np.random.default_rng(0)
    turned = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    box = trimesh.creation.box((2.0, 1.0, 3.0), transform=turned)
    room = Shape(scene.vertices, scene.triangles)
    found = score(Shape(box.vertices, box.faces), truth_of(room))
    theirs, _ = trimesh.sample.sample_surface(trimesh.Trimesh(scene.vertices, scene.triangles), 400_000, seed=2)
    boxes, _ = trimesh.sample.sample_surface(box, 100_000, seed=3)
    to_scene, to_shape = (
        cKDTree(theirs).query(boxes)[0],
        cKDTree(boxes).query(theirs[rng.permutation(400_000)[:50_000]])[0],
    )
    assert found.accuracy_m == pytest.approx(to_scene.mean(), abs=0.005)
    assert found.completion_m == pytest.approx(to_shape.mean(), rel=0.01)
    assert found.completion_ratio == pytest.approx((to_shape <= 0.05).mean(), abs=0.005)


def test_only_what_the_camera_can_see_is_observable():
    settings = TaskSettings()
    floor, behind = plate(4, 4), plate(1, 1, y=0.5)
    room = both(floor, behind)
    below, beside, far = np.array([0.5, 0.0, 0.5]), np.array([3.0, 0.0, 3.0]), np.array([3.0, 0.0, 30.0])
    points = np.stack([below, beside, far])
    # From above its middle, the upper plate hides what lies straight below it.
    eyes = np.array([[0.5, 1.5, 0.5]])
    assert observable(points, room, eyes, settings).tolist() == [False, True, False]
    assert observable(points, room, np.array([[2.0, 0.25, 0.5]]), settings).tolist() == [True, True, False]
    # A camera that cannot look down sees no floor at its feet.
    level = TaskSettings(pitch_limit_deg=10.0)
    at_feet = np.array([[2.0, 0.0, 2.1]])
    assert not observable(at_feet, room, np.array([[2.0, 1.5, 2.0]]), level).any()
    assert observable(at_feet, room, np.array([[2.0, 1.5, 2.0]]), settings).all()


@pytest.mark.parametrize(("width", "height"), [(160, 120), (97, 61)])
def test_fused_depth_lies_where_the_surface_is(width, height):
    simulator, settings = open_simulator(SimulatorChoice(), "builtin:3"), TaskSettings()
    truth, camera = scene_truth(simulator, settings), Intrinsics.from_hfov(width, height, hfov_deg=90.0)
    poses = heldout_poses(simulator, sensor_height_m=1.5)
    depth = simulator.render(poses, camera, rgb=False).depth
    found = score(fuse(zip(depth, poses, strict=True), camera, max_range_m=10.0), truth)
    assert found.precision > 0.98
    assert 0.6 < found.completion_ratio < 1.0
    for shift in ({"cx": camera.cx + 0.5}, {"cx": camera.cx - 0.5}, {"cy": camera.cy + 0.5}, {"cy": camera.cy - 0.5}):
        beside = fuse(zip(depth, poses, strict=True), replace(camera, **shift), max_range_m=10.0)
        assert found.accuracy_m < score(beside, truth).accuracy_m


def test_nothing_is_fused_of_nothing():
    camera = Intrinsics.from_hfov(8, 6, hfov_deg=90.0)
    assert fuse([(np.zeros((6, 8)), np.eye(4))], camera, max_range_m=10.0) is None
    assert fuse([], camera, max_range_m=10.0) is None


def write_room(path, change):
    mesh = load_scene("builtin:3").mesh
    trimesh.Trimesh(change(mesh.vertices.astype(float)), mesh.triangles, process=False).export(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v: v[:, [0, 2, 1]] * [1, -1, 1], "it lies turned (the scene's X is its X, Y is its Z, Z is its -Y): "),
        (lambda v: v * [-1, 1, 1], "it lies mirrored (the scene's X is its -X, Y is its Y, Z is its Z)"),
        (lambda v: v * 1000, "times as large as the scene"),
        (lambda v: (v[:, [0, 2, 1]] * [1, -1, 1] - [1, 2, 3]) * 0.25, "and 0.25 times as large"),
        (lambda v: v + [1.3, 0.5, 0.9], "it lies elsewhere"),
        (lambda v: v * 0.001, "times as large as the scene"),
    ],
)
def test_a_mesh_in_another_frame_is_refused_with_the_frame_named(tmp_path, capsys, change, words):
    path = tmp_path / "mesh.ply"
    write_room(path, change)
    assert command.run(geometry.main, [str(path), "--scene", "builtin:3"]) == 1
    said = capsys.readouterr().err
    assert f"{path}: expected a mesh in the frame of builtin:3, but {words if words[:2] == 'it' else ''}" in said
    assert words in said


@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
def test_a_mesh_made_elsewhere_is_scored(tmp_path, capsys, ending):
    path = tmp_path / f"mesh.{ending}"
    write_room(path, lambda vertices: vertices)
    assert command.run(geometry.main, [str(path), "--scene", "builtin:3", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["scene"] == "builtin:3"
    assert [report[name] for name in GEOMETRY] == pytest.approx([1, 0, 1, 0, 1, 0, 0], abs=1e-5)


def test_a_shape_that_is_bad_but_in_place_is_scored():
    simulator = open_simulator(SimulatorChoice(), "builtin:3")
    truth, mesh = scene_truth(simulator, TaskSettings()), simulator.surface_mesh()
    room = Shape(mesh.vertices, mesh.triangles)
    middle = mesh.vertices.mean(axis=0)
    shell = both(room, Shape((mesh.vertices - middle) * 4 + middle, mesh.triangles))
    low, blob = Shape(mesh.vertices + [0, 0.12, 0], mesh.triangles), plate(0.3, 0.3, *middle)
    assert [misplacement(each, truth) for each in (room, shell, low, blob)] == [None] * 4


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    folder = tmp_path_factory.mktemp("geometry") / "rollout"
    options = ["--scene", "builtin:3", "--policy", "heuristic", "--out", str(folder), "--budget", "12", "--geometry"]
    assert command.run(collect.main, [*options, "--width", "160", "--height", "120"]) == 0
    return folder


def test_a_rollout_says_what_its_depth_is_worth(rollout, capsys):
    kept = json.loads((rollout / "rollout.json").read_text())["metrics"]
    assert command.run(geometry.main, [str(rollout), "--scene", "builtin:3", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)
    # Not to the last digit: Open3D finds vertices with several threads, and sums in any order.
    assert [report[name] for name in GEOMETRY] == pytest.approx([kept[name] for name in GEOMETRY], rel=1e-3)
    assert (report["views"], report["policy"]) == (12, "heuristic")
    assert 0.1 < report["completion_ratio"] < report["precision"]
    assert command.run(geometry.main, [str(rollout), "--scene", "builtin:3"]) == 0
    assert "completion ratio [%]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("shape", "scene", "words"),
    [
        ("ROLLOUT", "builtin:4", "expected a rollout of builtin:4, found one of builtin:3 of another digest"),
        ("missing.ply", "builtin:3", "missing.ply"),
        ("missing", "builtin:3", "missing: expected a rollout folder"),
        ("runs/config.yml", "builtin:3", "is a reconstruction; measure it by `python -m avp_nerfstudio.geometry`"),
    ],
)
def test_what_cannot_be_scored_is_one_line(rollout, capsys, shape, scene, words):
    shape = str(rollout) if shape == "ROLLOUT" else shape
    assert command.run(geometry.main, [shape, "--scene", scene]) == 1
    assert words in capsys.readouterr().err


def test_what_the_task_was_is_read_from_the_rollout_itself(tmp_path, capsys):
    settings = TaskSettings(sensor_height_m=0.5, max_range_m=2.5, budget=6, pitch_limit_deg=20.0)
    folder = tmp_path / "low"
    options = collect.Collect("builtin:3", "nbv", folder, width=64, height=48, geometry=True)
    kept = collect.collect(options, settings=settings)
    assert command.run(geometry.main, [str(folder), "--scene", "builtin:3", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert [report[name] for name in GEOMETRY] == pytest.approx([kept[name] for name in GEOMETRY], rel=1e-3)
    shown = json.loads((folder / "rollout.json").read_text())
    (folder / "rollout.json").write_text(json.dumps(shown | {"scene": "builtin:3"}))
    assert command.run(geometry.main, [str(folder), "--scene", "builtin:3"]) == 1
    assert "rollout.json: " in capsys.readouterr().err


def test_geometry_of_the_first_views_is_that_of_an_episode_of_so_many(tmp_path):
    options = collect.Collect("builtin:3", "heuristic", tmp_path / "long", width=64, height=48, geometry=True, budget=9)
    collect.collect(replace(options, geometry_after=(4, 9, 20)))
    short = collect.collect(replace(options, out=tmp_path / "short", budget=4))
    after = json.loads((tmp_path / "long" / "rollout.json").read_text())["geometry_after"]
    assert list(after) == ["4"]
    assert [after["4"][name] for name in GEOMETRY] == pytest.approx([short[name] for name in GEOMETRY], rel=1e-3)


@pytest.mark.parametrize("words", [("--geometry-after", "4"), ("--geometry", "--geometry-after", "0")])
def test_geometry_after_numbers_of_views_needs_geometry_and_numbers(tmp_path, capsys, words):
    line = ["--scene", "builtin:3", "--policy", "spin", "--out", str(tmp_path / "r"), *words]
    assert command.run(collect.main, line) == 2
    assert "--geometry-after: expected numbers from 1, and --geometry" in capsys.readouterr().err


def test_a_bad_shape_among_good_ones_does_not_lose_them(rollout, capsys):
    assert command.run(geometry.main, [str(rollout), "missing", "--scene", "builtin:3"]) == 1
    said = capsys.readouterr()
    assert "heuristic" in said.out
    assert "missing: expected a rollout folder" in said.err


def test_a_simulator_without_a_mesh_collects_without_geometry(tmp_path, capsys):
    choice = SimulatorChoice(simulator=lambda scene: Corridor())
    options = collect.Collect(
        "a", "spin", tmp_path / "r", simulator=choice, budget=3, width=32, height=24, geometry=True
    )
    assert "accuracy_m" not in collect.collect(options)
    assert "geometry is left out: corridor: the simulator corridor gives no mesh" in capsys.readouterr().err
