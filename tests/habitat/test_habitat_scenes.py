"""Every kind of scene: Habitat-Sim shows what the ray caster shows, and nothing is written beside the user's files."""

import json
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from replica_layout import DATASET, replica_layout, write_quads
from shapes import RAMP, furnished, mesh_of, ramp, roofed, small_dataset, storeys, write_json, write_room

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.rollout.format import read_rollout
from avp_habitat.scenes.builtin.room import generate_room
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.sight.rules import candidates
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.task.env import AVPEnv

pytestmark = pytest.mark.habitat

ROOT = Path(__file__).resolve().parents[2]
CAMERA = Intrinsics.from_hfov(320, 240, hfov_deg=90)


@pytest.fixture(scope="module")
def room() -> TexturedMesh:
    return generate_room(0)


@pytest.fixture(scope="module")
def replica(tmp_path_factory, room) -> Path:
    return replica_layout(tmp_path_factory.mktemp("data") / "replica", room, dataset=True)


def poses_in(area: NavigableArea, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    at = area.random_points(rng, count) + [0, 1.5, 0]
    return camera_to_world(at, yaw=rng.uniform(-np.pi, np.pi, count), pitch=rng.uniform(-0.6, 0.6, count))


def overlap(area: NavigableArea, other: NavigableArea) -> float:
    """Intersection over union of the navigable cells, which lie on one grid."""
    np.testing.assert_allclose(area.origin, other.origin, atol=1e-4)
    masks = np.zeros((2, *np.maximum(area.mask.shape, other.mask.shape)), bool)
    for mask, each in zip(masks, (area, other), strict=True):
        mask[: each.mask.shape[0], : each.mask.shape[1]] = each.mask
    return masks.all(axis=0).sum() / masks.any(axis=0).sum()


def expect_the_same(simulator, spec) -> RaycastSimulator:
    """Picture, depth, navigable area and its heights of both simulators on a scene."""
    reference = RaycastSimulator(load_scene(str(spec)))
    assert (simulator.scene, simulator.scene_digest) == (reference.scene, reference.scene_digest)
    poses = poses_in(reference.area, 12)
    seen, expected = (each.render(poses, CAMERA, rgb=True) for each in (simulator, reference))
    difference = np.abs(seen.depth - expected.depth)
    assert np.median(difference) <= 1e-3
    assert np.quantile(difference, 0.97) <= 1e-2
    # A picture that is all of one colour or depth would show no axis that is turned.
    assert np.ptp(expected.depth) > 1
    assert np.ptp(expected.rgb) > 50
    error = np.square(seen.rgb.astype(float) - expected.rgb).mean()
    assert 10 * np.log10(255**2 / error) >= 30
    assert overlap(simulator.area, reference.area) >= 0.93
    assert simulator.area.area_m2 == pytest.approx(reference.area.area_m2, rel=0.05)
    assert simulator.area.centres[:, 1].mean() == pytest.approx(reference.area.centres[:, 1].mean(), abs=0.01)
    return reference


# --- the same scene ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "part",
    ["", "mesh.ply", "habitat/mesh_semantic.ply", "habitat/replica_stage.stage_config.json", f"../{DATASET}:room_0"],
)
def test_a_scene_of_replica_is_the_same_in_both_however_it_is_named(opened, replica, part):
    expect_the_same(opened(replica / part), replica / part)


def turned(mesh: TexturedMesh, up: int, front: int) -> TexturedMesh:
    """The mesh in axes of which number `up` points up and number `front` to the world's -Z."""
    vertices = np.zeros_like(mesh.vertices)
    vertices[:, up], vertices[:, front] = mesh.vertices[:, 1], -mesh.vertices[:, 2]
    right = np.cross(np.eye(3)[front], np.eye(3)[up]).astype(np.float32)
    return TexturedMesh(
        vertices + mesh.vertices[:, :1] * right, mesh.triangles, mesh.uv, mesh.colours, mesh.texture_index
    )


def write_kind(folder: Path, kind: str) -> Path:
    """The furnished room as a file of some kind, written by what its users would write it with."""
    glb = write_room(folder / "made/hall.glb", furnished())
    path = folder / f"hall.{kind}"
    if kind == "gltf":
        document: Any = pygltflib.GLTF2().load(str(glb))
        (folder / "hall.bin").write_bytes(document.binary_blob())
        document.buffers[0].uri = "hall.bin"
        document.save_json(str(path))
    elif kind == "ply":
        write_quads(path, mesh_of(furnished()), z_up=False)
    elif kind == "obj":
        mesh = mesh_of(furnished())
        trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=mesh.colours, process=False).export(path)
    else:
        shutil.copy(glb, path)
    shutil.rmtree(folder / "made")
    return path


@pytest.mark.parametrize("kind", ["glb", "gltf", "ply", "obj"])
def test_a_mesh_of_every_kind_is_the_same_in_both(opened, tmp_path, kind):
    spec = write_kind(tmp_path, kind)
    expect_the_same(opened(spec), spec)


def test_a_generated_room_is_the_same_in_both(opened):
    expect_the_same(opened("builtin:1"), "builtin:1")


@pytest.mark.parametrize(("up", "front"), [(2, 1), (0, 2)])
def test_a_stage_config_turns_the_scene_alike_in_both(opened, tmp_path, up, front):
    from avp_habitat.scenes.export import export_glb

    export_glb(turned(mesh_of(furnished()), up, front), tmp_path / "hall.glb")
    axes = {"up": np.eye(3)[up].tolist(), "front": np.eye(3)[front].tolist()}
    spec = write_json(tmp_path / "hall.stage_config.json", {"render_asset": "hall.glb", **axes})
    reference = expect_the_same(opened(spec), spec)
    upright = RaycastSimulator(load_scene(str(write_room(tmp_path / "upright.glb", furnished()))))
    assert overlap(reference.area, upright.area) == 1


# --- objects ----------------------------------------------------------------------------------------------------------

AT_THE_OBJECT = np.array([[-1.5, 0, 0]])


@pytest.mark.parametrize("motion", [{}, {"motion_type": "STATIC"}, {"motion_type": "DYNAMIC"}])
def test_the_objects_of_a_scene_are_seen_and_stand_in_the_way(opened, tmp_path, motion):
    dataset = small_dataset(tmp_path, **motion)
    pose = camera_to_world(np.array([[1.5, 0.6, 0]]), yaw=np.array([np.pi / 2]), pitch=np.zeros(1))
    narrow = Intrinsics.from_hfov(9, 9, hfov_deg=5)
    for scene, depth, stands in (("without", 4.5, True), ("with", 2.6, False)):
        simulator = opened(f"{dataset}:{scene}")
        frame = simulator.render(pose, narrow, rgb=True)
        assert frame.depth[0, 4, 4] == pytest.approx(depth, abs=1e-3)
        assert simulator.area.contains(AT_THE_OBJECT)[0] == stands
    # Its side that faces +X, the fourth of the block, in its own colour though there is no light.
    np.testing.assert_allclose(frame.rgb[0, 4, 4], np.array([0.9, 0.1, 0.1]) * 0.7 * 255, atol=2)


def test_a_scene_with_objects_is_left_to_habitat_by_name(opened, tmp_path):
    dataset = small_dataset(tmp_path)
    with pytest.raises(SceneError, match=r"with.scene_instance.json: has 1 objects .*; use --simulator habitat$"):
        load_scene(f"{dataset}:with")
    expect_the_same(opened(f"{dataset}:without"), f"{dataset}:without")


def test_an_object_that_cannot_be_shown_is_no_silence(opened, tmp_path):
    dataset = small_dataset(tmp_path)
    (tmp_path / "door.urdf").write_text('<robot name="door"><link name="leaf"/></robot>')
    config = json.loads(dataset.read_text())
    write_json(dataset, config | {"articulated_objects": {"paths": {".urdf": ["."]}}})
    path = tmp_path / "scenes/with.scene_instance.json"
    content = json.loads(path.read_text())
    write_json(path, content | {"articulated_object_instances": [{"template_name": "door", "translation": [0, 0, 0]}]})
    with pytest.raises(SceneError, match="with: has 2 objects, but Habitat-Sim shows 1 of them without its physics"):
        opened(f"{dataset}:with")
    write_json(path, content | {"object_instances": [{"template_name": "bux", "translation": [0, 0, 0]}]})
    with pytest.raises(SceneError, match=r"with.scene_instance.json: Habitat-Sim cannot read it: .*'bux'"):
        opened(f"{dataset}:with")
    assert opened(f"{dataset}:without").area.area_m2 > 10


# --- which floor, and how high above it -------------------------------------------------------------------------------


@pytest.mark.parametrize("quads", [roofed, storeys])
def test_neither_simulator_walks_on_the_roof(opened, tmp_path, quads):
    spec = write_room(tmp_path / "house.glb", quads())
    simulator = opened(spec)
    islands = simulator._engine.islands()
    assert max(island[..., 1].mean() for island in islands) > 2.8, "expected a NavMesh on the roof too"
    reference = RaycastSimulator(load_scene(str(spec)))
    assert overlap(simulator.area, reference.area) >= 0.93
    np.testing.assert_allclose(simulator.area.centres[:, 1], 0, atol=1e-4)


def down(positions: np.ndarray) -> np.ndarray:
    return camera_to_world(positions, yaw=np.zeros(len(positions)), pitch=np.full(len(positions), -np.pi / 2))


@pytest.mark.parametrize(("quads", "tolerance"), [(furnished, 1e-3), (ramp, 1e-2)])
def test_cameras_are_1_5_m_above_the_floor_although_the_navmesh_is_not_on_it(opened, tmp_path, quads, tolerance):
    simulator = opened(write_room(tmp_path / "room.glb", quads()))
    corners = np.concatenate(simulator._engine.islands()).reshape(-1, 3)
    true_height = np.interp(corners[:, 0], *RAMP) if quads is ramp else np.zeros(len(corners))
    assert (corners[:, 1] - true_height).min() > 0.1
    env = AVPEnv(simulator=simulator, budget=30, width=32, height=24)
    env.reset(seed=3)
    visited = [env.camera_to_world[:3, 3]]
    for action in [0, 0, 0, 1, 0, 0] * 4:
        env.step(action)
        visited.append(env.camera_to_world[:3, 3])
    everywhere = simulator.area.random_points(np.random.default_rng(0), 200) + [0, 1.5, 0]
    below = simulator.render(
        down(np.concatenate([visited, everywhere])), Intrinsics.from_hfov(3, 3, hfov_deg=1), rgb=False
    )
    np.testing.assert_allclose(below.depth[:, 1, 1], 1.5, atol=tolerance)


# --- nothing is left behind -------------------------------------------------------------------------------------------


def listing(folder: Path) -> dict[Path, tuple[int, int]]:
    """Times and sizes; a file that was written and removed again shows in the time of its folder."""
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in [folder, *folder.rglob("*")]}


def test_nothing_is_written_beside_the_users_files_and_no_temporary_folder_stays(
    opened, tmp_path, replica, room, monkeypatch
):
    data, current, temporary = (tmp_path / name for name in ("data", "current", "temporary"))
    for folder in (current, temporary):
        folder.mkdir()
    dataset = small_dataset(data / "small")
    specs = [f"{dataset}:with", dataset.parent / "stages/room.glb", write_kind(data, "ply"), "builtin:0", replica]
    monkeypatch.chdir(current)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    for folder in sorted(data.rglob("*")):
        folder.chmod(0o555 if folder.is_dir() else 0o444)
    before = [listing(folder) for folder in (data, replica.parent, current)]
    for spec in specs:
        simulator = opened(spec)
        simulator.render(poses_in(simulator.area, 2), CAMERA, rgb=True)
        assert list(temporary.iterdir()) == []
        simulator.close()
    assert list(temporary.iterdir()) == []
    assert [listing(folder) for folder in (data, replica.parent, current)] == before
    assert Path.cwd() == current


# --- NavMesh files ----------------------------------------------------------------------------------------------------


def save_navmesh(simulator, path: Path, **agent: float) -> Path:
    """The simulator's NavMesh, made anew for another agent where one is given."""
    engine = simulator._engine
    if agent:
        settings = engine._habitat.NavMeshSettings()
        settings.set_defaults()
        settings.agent_height = 1.5
        for name, value in agent.items():
            setattr(settings, name, value)
        assert engine._sim.recompute_navmesh(engine._sim.pathfinder, settings)
    assert engine._sim.pathfinder.save_nav_mesh(str(path))
    return path


def test_a_given_navmesh_counts_and_one_for_another_agent_warns(opened, tmp_path):
    spec = write_room(tmp_path / "room.glb", furnished())
    simulator = opened(spec)
    own = save_navmesh(simulator, tmp_path / "own.navmesh")
    wide = save_navmesh(simulator, tmp_path / "wide.navmesh", agent_radius=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given = opened(spec, navmesh=own)
    np.testing.assert_array_equal(given.area.mask, simulator.area.mask)
    assert given.area.area_m2 == pytest.approx(simulator.area.area_m2)
    with pytest.warns(UserWarning, match=r"wide.navmesh: made for another agent, .*: agent_radius 0.3 \(ours: 0.1\)$"):
        narrow = opened(spec, navmesh=str(wide))
    assert narrow.area.area_m2 < 0.9 * simulator.area.area_m2
    assert simulator.area.contains(narrow.area.centres).all()


@pytest.mark.parametrize(
    ("shift", "message"),
    [
        (
            (2.5, 0, 1.5),
            r"another scene\? Only \d+ % of its area .* holds \d+ % of that one's; expected 85 % of either",
        ),
        ((20, 0, 0), r"another scene\? no ray meets the floor"),
    ],
)
def test_the_navmesh_of_another_scene_is_refused_with_figures(opened, tmp_path, shift, message):
    moved = [([np.add(corner, shift) for corner in corners], colour) for corners, colour in furnished()]
    other = save_navmesh(opened(write_room(tmp_path / "other.glb", moved)), tmp_path / "other.navmesh")
    spec = write_room(tmp_path / "room.glb", furnished())
    with pytest.raises(SceneError, match=rf"^\S*other.navmesh: is this the NavMesh of {message}"):
        opened(spec, navmesh=other)
    assert opened(spec).area.area_m2 > 10, "expected the place to be free again"


# --- what the task asks -----------------------------------------------------------------------------------------------


def test_visible_cells_are_those_that_rays_reach(opened):
    simulator = opened("builtin:0")
    reference = RaycastSimulator(load_scene("builtin:0"))
    poses, points = poses_in(reference.area, 40), simulator.area.centres
    camera = Intrinsics.from_hfov(640, 480, hfov_deg=90)
    pairs = candidates(poses, camera, points, np.ones((len(poses), len(points)), bool), max_range_m=10)
    seen, expected = (each.visible(poses, camera, points, pairs, tolerance_m=0.1) for each in (simulator, reference))
    assert 0.1 < expected.mean() < 0.95
    assert (seen == expected).mean() >= 0.99
    # In any order of the pairs, and with cameras that none of them asks about.
    order = np.random.default_rng(0).permutation(len(pairs))[:500]
    again = simulator.visible(poses, camera, points, pairs[order], tolerance_m=0.1)
    np.testing.assert_array_equal(again, seen[order])


@pytest.mark.parametrize("size", [(160, 120), (161, 121), (37, 20)])
def test_one_pixel_rendered_alone_is_that_of_the_whole_picture(opened, tmp_path, size):
    simulator = opened(write_room(tmp_path / "room.glb", furnished()))
    whole = Intrinsics.from_hfov(*size, hfov_deg=90)
    poses = poses_in(simulator.area, 5)
    depth = simulator.render(poses, whole, rgb=False).depth
    assert depth.shape == (5, whole.height, whole.width)
    for row, column in ((whole.height // 2, whole.width // 2), (3, 5), (whole.height - 1, 0)):
        pixel = Intrinsics(1, 1, whole.fx, whole.fy, whole.cx - column, whole.cy - row)
        alone = simulator.render(poses, pixel, rgb=True)
        assert alone.rgb.shape == (5, 1, 1, 3)
        np.testing.assert_allclose(alone.depth[:, 0, 0], depth[:, row, column], rtol=2e-4)
    env = AVPEnv(simulator=simulator, budget=5, width=whole.width, height=whole.height)
    env.reset(seed=0)
    seen = simulator.render(env.camera_to_world[None], whole, rgb=False).depth[0]
    assert env.centre_depth == pytest.approx(seen[whole.height // 2, whole.width // 2], rel=2e-4)


def test_collecting_twice_gives_the_same_rollout_of_habitat(tmp_path):
    command = [sys.executable, "-m", "avp_habitat.collect", "--simulator", "habitat", "--scene", "builtin:0"]
    command += ["--policy", "random", "--budget", "5", "--width", "64", "--height", "48", "--seed", "7", "--out"]
    running = [
        subprocess.Popen([*command, name], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for name in ("first", "second")
    ]
    for process in running:
        said, complained = process.communicate(timeout=300)
        assert process.returncode == 0, complained
        assert "5 views, coverage" in said
    rollout, again = (read_rollout(tmp_path / name) for name in ("first", "second"))
    assert rollout.meta["simulator"]["name"] == "habitat"
    assert rollout.meta["simulator"]["version"].startswith("habitat-sim 0.")
    assert (len(rollout.frames), len(rollout.heldout)) == (5, 20)
    assert rollout.meta["scene"]["name"] == "builtin:0"
    for each in (rollout.meta, again.meta):
        each.pop("created")
    assert rollout.meta == again.meta
    files = [{path.relative_to(folder) for path in folder.rglob("*")} for folder in (rollout.folder, again.folder)]
    assert files[0] == files[1]
    for name in files[0] - {Path("rollout.json")}:
        if (rollout.folder / name).is_file():
            assert (rollout.folder / name).read_bytes() == (again.folder / name).read_bytes(), name
