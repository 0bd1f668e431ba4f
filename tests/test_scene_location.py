import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from replica_layout import DATASET, quads, replica_layout, vertex_colours, write_quads

from avp_habitat.errors import AVPError, SceneError, UsageError
from avp_habitat.poses import Intrinsics, axes_to_world, camera_to_world
from avp_habitat.scenes.builtin.room import generate_room
from avp_habitat.scenes.export import export_glb
from avp_habitat.scenes.loader import Scene, identify, load_scene
from avp_habitat.scenes.location import locate
from avp_habitat.scenes.mesh import TexturedMesh, warn_once
from avp_habitat.scenes.stage_config import Y_UP, Z_UP
from avp_habitat.simulators.raycast import RaycastSimulator


def boxes() -> TexturedMesh:
    """Two quads and a triangle, nothing symmetric; each vertex has a colour that bytes hold exactly."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 0, -3], [0, 0, -3], [2, 1, 0], [2, 1, -3], [0, 5, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [2, 3, 0], [1, 4, 5], [5, 2, 1], [0, 1, 6]], np.int32)
    colours = (np.arange(21).reshape(7, 3) * 12 / 255).astype(np.float32)
    return TexturedMesh(vertices, triangles, np.zeros((7, 2), np.float32), colours, np.full(5, -1, np.int32))


@pytest.fixture
def room(tmp_path) -> Path:
    return replica_layout(tmp_path / "replica", boxes(), dataset=True)


def surface(spec) -> list:
    """Corners and colours of every triangle that is one, however they are ordered."""
    mesh = load_scene(str(spec)).mesh
    rows = [
        sorted((*mesh.vertices[i].round(5).tolist(), *mesh.colours[i].round(3).tolist()) for i in triangle)
        for triangle in mesh.triangles
        if len(set(triangle.tolist())) == 3
    ]
    return sorted(rows)


def write(path: Path, content) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def stage(folder: Path, **attributes) -> Path:
    """A stage config beside the mesh that it shows."""
    folder.mkdir(parents=True, exist_ok=True)
    write_quads(folder / "mesh.ply", boxes(), z_up=False)
    return write(folder / "hall.stage_config.json", {"render_asset": "mesh.ply", **attributes})


def dataset(folder: Path, **cells) -> Path:
    """A dataset of two stages and one scene instance, whose folders do not tell their roles."""
    stage(folder / "a/stages")
    shutil.copy(folder / "a/stages/mesh.ply", folder / "a/stages/porch.ply")
    write(folder / "a/stages/porch.stage_config.json", {"render_asset": "porch.ply", "up": [0, 0, 1]})
    write(folder / "b/flat.scene_instance.json", {"stage_instance": {"template_name": "stages/hall"}})
    config = {
        "stages": {"default_attributes": {"front": [0, 1, 0], "up": [0, 0, 1]}, "paths": {".json": ["a/*"]}},
        "scene_instances": {"paths": {".json": ["b"]}},
    }
    return write(folder / "all.scene_dataset_config.json", config | cells)


def test_the_layout_under_test_has_the_quads_of_replica(room):
    content = (room / "mesh.ply").read_bytes()
    assert [sorted(quad) for quad in quads(boxes()).tolist()] == [[0, 1, 2, 3], [1, 2, 4, 5], [0, 1, 6, 6]]
    assert b"element face 3\nproperty list uchar int vertex_indices\nend_header" in content
    assert b"object_id" in (room / "habitat/mesh_semantic.ply").read_bytes()
    stored: Any = trimesh.load(room / "mesh.ply", process=False)
    # x stays, what was up is now the third coordinate.
    np.testing.assert_allclose(stored.vertices[5], [2, 3, 1])
    np.testing.assert_array_equal(stored.visual.vertex_colors[5][:3], [180, 192, 204])


@pytest.mark.parametrize(
    ("part", "asset"),
    [
        ("", "mesh.ply"),
        ("mesh.ply", "mesh.ply"),
        ("habitat/mesh_semantic.ply", "habitat/mesh_semantic.ply"),
        ("habitat/replica_stage.stage_config.json", "mesh.ply"),
    ],
)
def test_every_way_to_name_a_scene_of_replica_shows_it_upright(room, part, asset):
    location = locate(str(room / part))
    assert (location.name, location.up, location.front, location.objects) == ("room_0", (0, 0, 1), (0, 1, 0), 0)
    assert location.asset is not None
    assert location.asset.samefile(room / asset)
    plain = room.parent / "plain.ply"
    write_quads(plain, boxes(), z_up=False)
    assert surface(room / part) == surface(plain)
    np.testing.assert_array_equal(load_scene(str(room)).mesh.vertices, boxes().vertices)


def test_a_scene_of_replica_is_found_from_within_its_folder(room, monkeypatch):
    for folder, spec in ((room, "."), (room, "mesh.ply"), (room / "habitat", "mesh_semantic.ply")):
        monkeypatch.chdir(folder)
        assert (locate(spec).name, locate(spec).up) == ("room_0", (0, 0, 1))


def test_a_mesh_ply_without_the_signs_of_replica_is_y_up(room):
    shutil.rmtree(room / "habitat")
    location = locate(str(room / "mesh.ply"))
    assert (location.name, (location.up, location.front)) == ("mesh.ply", Y_UP)
    with pytest.raises(SceneError, match="room_0: expected a scene file, found a folder that is no scene of Replica"):
        locate(str(room))


def test_the_folder_of_all_scenes_brings_one_of_them(room):
    with pytest.raises(SceneError, match=rf"no scene of Replica; name one of its 1 scenes, {room} say"):
        locate(str(room.parent))


def test_a_misspelt_folder_of_replica_brings_the_nearest_one(room):
    with pytest.raises(SceneError, match=r"/rom_0: no such folder; did you mean 'room_0'\?$"):
        locate(str(room.with_name("rom_0")))
    with pytest.raises(UsageError, match=r"/kitchen: expected a scene file, got the suffix ''; a scene is a mesh"):
        locate(str(room.with_name("kitchen")))


def test_a_scene_of_replica_without_its_mesh_is_named(room):
    (room / "mesh.ply").unlink()
    with pytest.raises(SceneError, match=r"room_0/mesh.ply: no such scene file"):
        locate(str(room))
    assert locate(str(room / "habitat/mesh_semantic.ply")).name == "room_0"


def test_a_room_in_replica_layout_looks_the_same_to_the_byte(tmp_path):
    mesh = generate_room(0)
    folder = replica_layout(tmp_path / "replica", mesh)
    plain = tmp_path / "plain.ply"
    write_quads(plain, mesh, z_up=False)
    middle = mesh.bounds.mean(axis=0)
    poses = camera_to_world(np.array([middle] * 3), yaw=np.array([0.3, 2.0, -1.5]), pitch=np.array([-0.4, 0.0, 0.3]))
    camera = Intrinsics.from_hfov(80, 60, hfov_deg=90)
    seen, expected = (
        RaycastSimulator(load_scene(str(path))).render(poses, camera, rgb=True) for path in (folder, plain)
    )
    np.testing.assert_array_equal(seen.depth, expected.depth)
    assert seen.rgb is not None
    np.testing.assert_array_equal(seen.rgb, expected.rgb)
    assert np.ptp(seen.depth) > 0.5
    assert np.ptp(seen.rgb) > 50
    # The geometry is that of the room itself, too: joining triangles to quads has lost none.
    itself = RaycastSimulator(Scene("builtin:0", "", mesh)).render(poses, camera, rgb=False)
    np.testing.assert_allclose(seen.depth, itself.depth, atol=1e-5)


def test_the_colour_of_a_vertex_is_seen_where_the_vertex_is(room):
    simulator = RaycastSimulator(load_scene(str(room)))
    # Straight down on the corner (2, 0, -3) of the floor, from inside of it.
    pose = camera_to_world(np.array([[1.999, 0.5, -2.999]]), yaw=np.zeros(1), pitch=np.array([-np.pi / 2]))
    frame = simulator.render(pose, Intrinsics.from_hfov(3, 3, hfov_deg=0.01), rgb=True)
    assert frame.rgb is not None
    assert np.abs(frame.rgb[0, 1, 1].astype(float) - 255 * vertex_colours(boxes())[2]).max() <= 1
    assert frame.depth[0, 1, 1] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize(
    "axes", [Z_UP, ((1, 0, 0), (0, 0, 1)), ((0.6, 0, 0.8), (0.8, 0, -0.6)), ((0, -1, 0), (1, 0, 0))]
)
def test_a_stage_config_turns_the_mesh_by_its_axes(tmp_path, axes):
    up, front = (np.array(axis, float) for axis in axes)
    # Twice as long: only the direction counts.
    path = stage(tmp_path, up=(2 * up).tolist(), front=(2 * front).tolist())
    location = locate(str(path))
    assert location.name == "hall"
    np.testing.assert_allclose(location.up, up, atol=1e-12)
    loaded = load_scene(str(path)).mesh.vertices.astype(float)
    # The parts of each position along up, front and their cross product are the world's y, -z and x.
    read: Any = trimesh.load(tmp_path / "mesh.ply", process=False)
    stored = np.asarray(read.vertices)
    expected = np.stack([stored @ np.cross(front, up), stored @ up, -(stored @ front)], axis=1)
    np.testing.assert_allclose(loaded, expected, atol=1e-6)
    assert np.linalg.det(axes_to_world(location.up, location.front)) == pytest.approx(1)


def test_a_stage_config_without_axes_is_y_up_even_for_a_glb(tmp_path):
    export_glb(boxes(), tmp_path / "a.glb")
    location = locate(str(write(tmp_path / "a.stage_config.json", {"render_asset": "a.glb"})))
    assert (location.up, location.front) == Y_UP


@pytest.mark.parametrize(
    ("config", "axes"),
    [
        ({}, Z_UP),
        ({"render_asset_type": "unknown"}, Y_UP),
        # Turned twice: the well-known upside-down Replica, of which Habitat-Sim 0.3.4 shows the same depth images.
        ({"up": [0, 0, 1], "front": [0, 1, 0]}, ((0, -1, 0), (0, 0, 1))),
        ({"up": [1, 0, 0], "front": [0, 0, 1]}, ((0, 0, -1), (1, 0, 0))),
    ],
)
def test_a_semantic_mesh_is_turned_once_more_as_habitat_does(tmp_path, config, axes):
    write_quads(tmp_path / "x_semantic.ply", boxes(), z_up=False)
    location = locate(str(write(tmp_path / "x.stage_config.json", {"render_asset": "x_semantic.ply", **config})))
    assert (location.up, location.front) == axes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"render_asset": None}, r"render_asset: expected the path of a mesh \(.glb, .gltf, .ply, .obj\), got null"),
        ({"render_asset": 7}, "render_asset: expected the path of a mesh .*, got 7"),
        ({"render_asset": "gone.ply"}, r"render_asset: there is no file .*gone.ply"),
        ({"render_asset": "mesh.fbx"}, r'render_asset: expected the path of a mesh \(.*\), got "mesh.fbx"'),
        ({"render_asset": "../../x.ply"}, "render_asset: '../../x.ply' lies outside of"),
        ({"render_asset": "/etc/x.ply"}, "render_asset: '/etc/x.ply' lies outside of"),
        ({"render_asset": "a\0.ply"}, "render_asset: .* lies outside of"),
        ({"up": [0, 1]}, r"up: expected a direction of three numbers, got \[0, 1\]"),
        ({"up": "Z"}, 'up: expected a direction of three numbers, got "Z"'),
        ({"up": [0, 0, 0], "front": [0, 1, 0]}, r"up: expected a direction of three numbers, got \[0, 0, 0\]"),
        ({"front": [0, float("nan"), 0]}, r"front: expected a direction of three numbers, got \[0, NaN, 0\]"),
        ({"up": [0, 0, 1]}, "up and front: got .*; expected two directions at right angles; name both"),
        ({"up": [0, 1, 0], "front": [0, 0, 1]}, r"upside down; expected another front, \[0.0, 0.0, -1.0\] say"),
        ({"origin": [0, 0, 1]}, r"origin: expected \[0, 0, 0\] or nothing, got \[0, 0, 1\]; stages that are moved"),
        ({"scale": [2, 2, 2]}, r"scale: expected \[1, 1, 1\] or nothing, got \[2, 2, 2\]"),
        ({"units_to_meters": 0.01}, "units_to_meters: expected 1 or nothing, got 0.01"),
    ],
)
def test_a_stage_config_that_cannot_be_right_is_one_line_with_file_and_key(tmp_path, change, message):
    path = stage(tmp_path / "a/b", **change)
    with pytest.raises(SceneError, match=rf"hall.stage_config.json: .*{message}") as caught:
        locate(str(path))
    assert "\n" not in str(caught.value)


def test_attributes_that_change_nothing_are_accepted(tmp_path):
    path = stage(tmp_path, origin=[0, 0, 0], scale=[1.0, 1, 1], units_to_meters=1.0, gravity=[0, -9.8, 0], margin=0.03)
    assert load_scene(str(path)).mesh.vertices.tolist() == boxes().vertices.tolist()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"render_asset": ', "expected JSON, but it is damaged: .*line 1 column"),
        (b"[1]", r"expected a JSON object, got \[1\]"),
        (b"\xff\xfe{}", "expected JSON, but it is damaged"),
        (b"[" * 100000, "expected JSON, but it is damaged"),
        (b"", "expected JSON, but it is damaged"),
    ],
)
@pytest.mark.parametrize("name", ["x.stage_config.json", "x.scene_dataset_config.json:a"])
def test_damaged_json_is_a_scene_error(tmp_path, name, content, message):
    (tmp_path / name.removesuffix(":a")).write_bytes(content)
    with pytest.raises(SceneError, match=rf"x\.[a-z_]+\.json: {message}"):
        locate(str(tmp_path / name))


def test_of_a_stage_the_path_counts_as_it_is_written_not_where_a_link_leads(tmp_path):
    path = stage(tmp_path / "a/b")
    shutil.move(tmp_path / "a/b/mesh.ply", tmp_path / "blob")
    os.symlink(tmp_path / "blob", tmp_path / "a/b/mesh.ply")
    assert locate(str(path)).asset == tmp_path / "a/b/mesh.ply"
    (tmp_path / "blob").unlink()
    with pytest.raises(SceneError, match=r"render_asset: is a link to .*blob, where there is no file; fetch it"):
        locate(str(path))


def test_no_link_helps_a_stage_out_of_its_data(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(stage(tmp_path / "x").with_name("mesh.ply"), tmp_path / "mesh.ply")
    path = stage(tmp_path / "a/b", render_asset="link/../../../mesh.ply")
    os.symlink(tmp_path / "elsewhere", tmp_path / "a/b/link")
    with pytest.raises(SceneError, match=r"mesh.ply' lies outside of"):
        locate(str(path))


def test_a_misspelt_config_brings_the_nearest_name(tmp_path):
    path = stage(tmp_path)
    with pytest.raises(SceneError, match=r"halls.stage_config.json: no such scene file; did you mean 'hall.stage_conf"):
        locate(str(path.with_name("halls.stage_config.json")))
    with pytest.raises(SceneError, match=r"al.scene_dataset_config.json: no such scene file; did you mean 'all.scene_"):
        locate(str(dataset(tmp_path).with_name("al.scene_dataset_config.json")) + ":x")


def test_replica_by_its_dataset_config(room):
    config = room.parent / DATASET
    replica_layout(room.parent, boxes(), "frl_apartment_0")
    replica_layout(room.parent, boxes(), "apartment_0")
    location = locate(f"{config}:room_0")
    assert (location.name, location.dataset) == ("room_0", config)
    assert location.scene_id == "room_0/habitat/replica_stage.stage_config.json"
    assert location.files == (config, room / "habitat/replica_stage.stage_config.json")
    assert (location.up, location.front) == Z_UP
    assert surface(f"{config}:room_0") == surface(room)
    # As a part of a text it would fit the other one as well.
    assert locate(f"{config}:apartment_0").name == "apartment_0"


def test_the_axes_of_replica_are_known_without_the_defaults_of_its_dataset_config(room):
    config = room.parent / DATASET
    content = json.loads(config.read_text())
    del content["stages"]["default_attributes"]
    assert (locate(f"{write(config, content)}:room_0").up) == (0, 0, 1)


@pytest.mark.parametrize(
    ("scene_id", "name", "file"),
    [
        ("flat", "flat", "b/flat.scene_instance.json"),
        ("b/flat.scene_instance.json", "flat", "b/flat.scene_instance.json"),
        ("hall", "hall", "a/stages/hall.stage_config.json"),
        ("stages/hall", "hall", "a/stages/hall.stage_config.json"),
        ("hal", "hall", "a/stages/hall.stage_config.json"),
    ],
)
def test_a_scene_is_found_by_handle_or_a_part_of_it(tmp_path, scene_id, name, file):
    location = locate(f"{dataset(tmp_path)}:{scene_id}")
    assert (location.name, location.scene_id) == (name, file)
    assert location.asset is not None
    assert location.asset.samefile(tmp_path / "a/stages/mesh.ply")
    # From the defaults of the dataset, since neither config names any.
    assert (location.up, location.front) == Z_UP


def test_a_stage_overrides_the_defaults_of_its_dataset(tmp_path):
    path = dataset(tmp_path)
    write(tmp_path / "a/stages/porch.stage_config.json", {"render_asset": "porch.ply", "up": [1, 0, 0]})
    location = locate(f"{path}:porch")
    assert (location.up, location.front) == ((1, 0, 0), (0, 1, 0))


def test_an_asset_without_config_is_judged_as_habitat_does(tmp_path):
    export_glb(boxes(), tmp_path / "x.basis.glb")
    write_quads(tmp_path / "y.ply", boxes(), z_up=False)
    stages = {"paths": {".glb": ["*.glb"], ".ply": ["."]}}
    path = write(tmp_path / "d.scene_dataset_config.json", {"stages": stages})
    assert locate(f"{path}:x.basis.glb").up == (0, 0, 1)
    assert locate(f"{path}:x").scene_id == "x.basis.glb"
    assert locate(f"{path}:y.ply").up == (0, 1, 0)
    write(path, {"stages": {**stages, "default_attributes": {"margin": 0.1}}})
    assert locate(f"{path}:x").up == (0, 1, 0)
    write(tmp_path / "x.stage_config.json", {"render_asset": "x.basis.glb", "up": [1, 0, 0]})
    assert locate(f"{path}:x").up == (1, 0, 0)


def test_a_default_can_name_the_mesh_after_the_config(tmp_path):
    default = {"render_asset": "%%CONFIG_NAME_AS_ASSET_FILENAME%%.ply"}
    path = dataset(tmp_path, stages={"default_attributes": default, "paths": {".json": ["a/stages"]}})
    write(tmp_path / "a/stages/porch.stage_config.json", {})
    assert locate(f"{path}:porch").asset == tmp_path / "a/stages/porch.ply"


def test_objects_are_counted_and_left_to_habitat(tmp_path):
    path = dataset(tmp_path)
    content = {
        "stage_instance": {"template_name": "hall", "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]},
        "object_instances": [{"template_name": "chair"}] * 2,
        "articulated_object_instances": [{"template_name": "door"}],
    }
    write(tmp_path / "b/flat.scene_instance.json", content)
    location = locate(f"{path}:flat")
    assert location.objects == 3
    assert len(identify(location)[0]) == 64
    with pytest.raises(SceneError, match=r"flat.scene_instance.json: has 3 objects .*; use --simulator habitat$"):
        load_scene(f"{path}:flat")


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({"translation": [1, 0, 0]}, r"translation: expected \[0, 0, 0\] or nothing, got \[1, 0, 0\]"),
        ({"rotation": [0, 1, 0, 0]}, r"rotation: expected \[1, 0, 0, 0\] or nothing"),
        ({"uniform_scale": 2}, "uniform_scale: expected 1 or nothing, got 2"),
        ({"non_uniform_scale": [1, 2, 1]}, r"non_uniform_scale: expected \[1, 1, 1\]"),
        ({"template_name": 3}, "template_name: expected a text, got 3"),
        ({"template_name": None}, "template_name: all.scene_dataset_config.json has no stage ''"),
        ({"template_name": "hill"}, "template_name: all.scene_dataset_config.json has no stage 'hill'"),
    ],
)
def test_a_stage_instance_that_is_not_supported_is_named(tmp_path, place, message):
    path = dataset(tmp_path)
    write(tmp_path / "b/flat.scene_instance.json", {"stage_instance": {"template_name": "hall", **place}})
    with pytest.raises(SceneError, match=rf"flat.scene_instance.json: stage_instance.{message}"):
        locate(f"{path}:flat")


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ({"stages": []}, r"stages: expected an object, got \[\]"),
        ({"stages": {"paths": ["a"]}}, r'stages.paths: expected an object, got \["a"\]'),
        ({"stages": {"paths": {".json": "a"}}}, r'stages.paths..json: expected a list, got "a"'),
        ({"stages": {"paths": {".json": [1]}}}, r"stages.paths..json: expected a path, got 1"),
        ({"stages": {"paths": {".json": ["../*"]}}}, r"stages.paths..json: '../.*' lies outside of"),
        ({"stages": {"paths": {".json": ["a/*/../../../*"]}}}, "lies outside of"),
        ({"stages": {"paths": {".json": ["/etc"]}}}, "'/etc' lies outside of"),
        (
            {"stages": {"configs": [{}]}},
            "stages.configs: stages that a dataset config describes itself are not supported",
        ),
        ({"scene_instances": {"default_attributes": 1}}, "scene_instances.default_attributes: expected an object"),
    ],
)
def test_a_damaged_dataset_config_is_named_with_its_key(tmp_path, cells, message):
    with pytest.raises(SceneError, match=rf"all.scene_dataset_config.json: .*{message}"):
        locate(
            f"{dataset(tmp_path, **cells)}:flat" if "scene_instances" not in cells else _with_scenes(tmp_path, cells)
        )


def _with_scenes(folder: Path, cells: dict) -> str:
    cells["scene_instances"]["paths"] = {".json": ["b"]}
    return f"{dataset(folder, **cells)}:flat"


def test_a_search_path_follows_a_link(tmp_path):
    path = dataset(tmp_path / "data")
    shutil.move(tmp_path / "data/a/stages", tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", tmp_path / "data/a/stages")
    assert locate(f"{path}:hall").asset == tmp_path / "data/a/stages/mesh.ply"


def test_a_missing_id_brings_the_names(tmp_path):
    path = dataset(tmp_path)
    for spec in (str(path), f"{path}:"):
        with pytest.raises(
            UsageError, match=r"expected all.scene_dataset_config.json:ID .*; it has 3 scenes, such as flat, hall"
        ):
            locate(spec)


def test_an_unknown_id_brings_the_nearest_names(room):
    for index in range(1, 8):
        shutil.copytree(room, room.with_name(f"office_{index}"))
    config = room.parent / DATASET
    with pytest.raises(
        SceneError, match=r"no scene 'rom_0'; it has 8 scenes, such as office_1, .*; did you mean 'room_0'\?"
    ):
        locate(f"{config}:rom_0")
    with pytest.raises(SceneError, match=r"'office' stands for 7 scenes, such as office_1/habitat/"):
        locate(f"{config}:office")


def test_a_dataset_without_scenes_says_so(tmp_path):
    path = write(tmp_path / "d.scene_dataset_config.json", {})
    with pytest.raises(SceneError, match=r"has no scene 'a'; it has 0 scenes$"):
        locate(f"{path}:a")


def test_the_digest_tells_axes_and_configs_apart(tmp_path):
    digests = set()
    for axes in ({}, {"up": [0, 0, 1], "front": [0, 1, 0]}, {"up": [1, 0, 0], "front": [0, 1, 0]}, {"margin": 0.5}):
        path = str(stage(tmp_path, **axes))
        assert load_scene(path).digest == identify(locate(path))[0]
        digests.add(load_scene(path).digest)
    plain = load_scene(str(tmp_path / "mesh.ply"))
    assert len(digests | {plain.digest}) == 5
    assert plain.digest == hashlib.sha256((tmp_path / "mesh.ply").read_bytes()).hexdigest()
    assert load_scene("builtin:3").digest == identify(locate("builtin:3"))[0]


def test_a_mesh_that_only_habitat_reads_has_a_digest_all_the_same(tmp_path):
    path = write(tmp_path / "a.gltf", {"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_texture_basisu"]})
    assert identify(locate(str(path)))[0] == hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(SceneError, match="requires the glTF extension KHR_texture_basisu"):
        load_scene(str(path))
    write(path, {"asset": {"version": "2.0"}, "extensionsRequired": ["EXT_other"]})
    with pytest.raises(SceneError, match="requires the glTF extension EXT_other"):
        identify(locate(str(path)))


def test_the_digest_of_a_scene_does_not_depend_on_where_it_lies(room, tmp_path):
    shutil.copytree(room.parent, tmp_path / "copy")
    for part in ("room_0", f"{DATASET}:room_0"):
        digests = {load_scene(f"{folder}/{part}").digest for folder in (room.parent, tmp_path / "copy")}
        assert len(digests) == 1
    assert load_scene(str(room)).digest == load_scene(str(room / "mesh.ply")).digest


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers(-2, 2)
    | st.sampled_from(["a", "*", "..", "mesh.ply", "\0", "/"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["paths", ".json", "configs"]), inner),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(
    values=st.dictionaries(
        st.sampled_from(["render_asset", "up", "front", "origin", "scale", "render_asset_type", "paths", "configs"]),
        JSON,
    )
)
def test_whatever_a_config_holds_brings_a_scene_or_an_error_of_ours(tmp_path_factory, values):
    folder = tmp_path_factory.mktemp("any")
    specs = [str(stage(folder / "s", **values))]
    specs.append(f"{write(folder / 'd.scene_dataset_config.json', {'stages': values, 'scene_instances': values})}:a")
    for spec in specs:
        try:
            asset = locate(spec).asset
        except AVPError:
            continue
        assert asset is not None
        assert asset.resolve().is_relative_to(folder.resolve())


def test_what_is_said_of_a_scene_is_said_once(caplog):
    for text in ("first", "second", "first"):
        warn_once("room.glb", text)
    assert caplog.messages == ["room.glb: first", "room.glb: second"]
