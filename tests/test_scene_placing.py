"""Scenes that lie far away or on their sides, and scenes named by a `pathlib.Path`."""

import itertools
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from avp_habitat import command
from avp_habitat.collect import main as collect
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.builtin.room import generate_room
from avp_habitat.scenes.export import export_glb
from avp_habitat.scenes.export import main as export
from avp_habitat.scenes.loader import identify, load_scene, looks_z_up
from avp_habitat.scenes.location import Frame, locate
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv
from avp_nerfstudio.check.__main__ import main as check
from avp_sb3 import AVPVecEnv, EvaluationCallback

UTM = np.array([448000.123, 120.5, -5411000.377])


def box(low, high, *, inward=False):
    """`(6, 4, 3)` quads of a box, seen from outside or from within."""
    (x, y, z), (a, b, c) = low, high
    quads = [
        [(x, b, c), (a, b, c), (a, b, z), (x, b, z)],
        [(x, y, z), (a, y, z), (a, y, c), (x, y, c)],
        [(a, y, c), (a, y, z), (a, b, z), (a, b, c)],
        [(x, y, z), (x, y, c), (x, b, c), (x, b, z)],
        [(x, y, c), (a, y, c), (a, b, c), (x, b, c)],
        [(a, y, z), (x, y, z), (x, b, z), (a, b, z)],
    ]
    return np.array(quads, float)[:, :: -1 if inward else 1]


def room(width=5.0, height=2.7, depth=4.0):
    """Quads of a room with a table and two cupboards."""
    things = [((2, 0, 1.5), (3, 0.8, 2.3)), ((4.3, 0, 0.2), (4.8, 1.9, 1.2)), ((0.2, 0, 2.9), (1.4, 0.9, 3.8))]
    parts = [box((0, 0, 0), (width, height, depth), inward=True), *(box(*thing) for thing in things)]
    return np.concatenate(parts)


def mesh_of(quads):
    vertices = np.asarray(quads, float).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 4)
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]).astype(np.int32)
    count = len(vertices)
    return TexturedMesh(
        vertices.astype(np.float32),
        triangles,
        np.zeros((count, 2), np.float32),
        np.ones((count, 3), np.float32),
        np.full(len(triangles), -1, np.int32),
    )


def z_up(vertices):
    return np.asarray(vertices)[..., [0, 2, 1]] * [1, -1, 1]


def write_obj(path, quads):
    vertices = np.asarray(quads).reshape(-1, 3)
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices]
    lines += [f"f {4 * i + 1} {4 * i + 2} {4 * i + 3} {4 * i + 4}" for i in range(len(vertices) // 4)]
    path.write_text("\n".join(lines))
    return path


def write_ply(path, quads):
    vertices = np.asarray(quads).reshape(-1, 3)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property double {name}\n" for name in "xyz")
    header += f"element face {len(vertices) // 4}\nproperty list uchar int vertex_indices\nend_header\n"
    faces = np.zeros(len(vertices) // 4, [("n", "u1"), ("i", "<i4", 4)])
    faces["n"], faces["i"] = 4, np.arange(len(vertices)).reshape(-1, 4)
    path.write_bytes(header.encode() + vertices.astype("<f8").tobytes() + faces.tobytes())
    return path


def write_gltf(path, quads, translation):
    """A document whose node moves a mesh that lies near its own origin."""
    export_glb(mesh_of(quads), path)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    document["nodes"][0]["translation"] = translation.tolist()
    changed = json.dumps(document).encode()
    changed += b" " * (-len(changed) % 4)
    rest = content[20 + length :]
    total = 20 + len(changed) + len(rest)
    path.write_bytes(
        content[:8] + total.to_bytes(4, "little") + len(changed).to_bytes(4, "little") + b"JSON" + changed + rest
    )
    return path


@pytest.mark.parametrize("kind", ["obj", "ply", "glb"])
def test_a_scene_far_from_its_origin_keeps_its_millimetres(tmp_path, caplog, kind):
    path = tmp_path / f"far.{kind}"
    if kind == "glb":
        write_gltf(path, room(), UTM)
    else:
        (write_obj if kind == "obj" else write_ply)(path, room() + UTM)
    scene = load_scene(path)
    assert scene.frame == Frame((448003.0, 0.0, -5410998.0))
    expected = room().reshape(-1, 3) + UTM - scene.frame.origin
    placed = np.unique(scene.mesh.vertices[scene.mesh.triangles].reshape(-1, 3).round(3), axis=0)
    np.testing.assert_allclose(placed, np.unique(expected.round(3), axis=0), atol=1.1e-3)
    assert caplog.messages == [f"{path}: lies 5410998 m from its origin: (448003, 0, -5410998) m are taken off"]
    assert identify(locate(path)) == (scene.digest, scene.frame)


def test_what_float32_has_lost_already_is_said(tmp_path, caplog):
    export_glb(mesh_of(room() + [448000, 0, 0]), tmp_path / "far.glb")
    assert load_scene(tmp_path / "far.glb").frame.origin == (448002.0, 0.0, 0.0)
    assert "taken off; as float32, its coordinates are rounded to 31 mm" in caplog.text


def test_what_float32_cannot_hold_is_refused_with_its_size(tmp_path):
    export_glb(mesh_of(room() + [448000, 0, -5411000]), tmp_path / "far.glb")
    with pytest.raises(SceneError, match=r"coordinates of 5410998 m in float32, which has steps of 500 mm there"):
        load_scene(tmp_path / "far.glb")


@pytest.mark.parametrize("scale", [1e38, 1e7])
def test_coordinates_near_the_largest_float_are_refused(tmp_path, scale):
    quads = room() * scale
    for path in (write_obj(tmp_path / "a.obj", quads), write_ply(tmp_path / "a.ply", quads)):
        with pytest.raises(SceneError, match=r"has coordinates of [0-9.e+]+ m, where float32 cannot hold"):
            make_simulator("raycast", path)


def test_vertices_that_no_triangle_uses_move_nothing(tmp_path):
    text = write_obj(tmp_path / "a.obj", room()).read_text()
    (tmp_path / "a.obj").write_text(f"{text}\nv 1e300 -1e300 9e6")
    assert load_scene(tmp_path / "a.obj").frame == Frame()
    assert make_simulator("raycast", tmp_path / "a.obj").area.area_m2 == pytest.approx(13.95, abs=0.02)


def test_a_large_scene_about_its_origin_stays_where_it_is(tmp_path, caplog):
    write_obj(tmp_path / "a.obj", room() * [1000, 1, 1000] - [3000, 0, 100])
    assert load_scene(tmp_path / "a.obj").frame == Frame()
    assert not caplog.messages


def test_a_given_origin_is_taken_instead(tmp_path):
    scene = load_scene(write_obj(tmp_path / "a.obj", room() + UTM), origin=(448000, 100, -5411000))
    assert scene.frame.origin == (448000, 100, -5411000)
    np.testing.assert_allclose(scene.mesh.bounds[0], [0.123, 20.5, -0.377], atol=1e-3)


def test_a_rollout_keeps_origin_and_axis_and_its_poses_are_checked_there(tmp_path, monkeypatch, capsys):
    """The rollout of a Z-up mesh in UTM; --mesh is given the file alone."""
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "far.obj", z_up(room() + UTM))
    line = ["--scene", "far.obj", "--up", "z", "--policy", "frontier", "--out", "r", "--budget", "4"]
    line += ["--mlflow", "off", "--width", "64", "--height", "48"]
    assert command.run(collect, line) == 0
    told = json.loads((tmp_path / "r/rollout.json").read_text())["scene"]
    assert (told["origin"], told["up"]) == ([448003.0, 0.0, -5410998.0], "z")
    command.run(check, ["r", "--mesh", "far.obj", "--no-pictures"])
    verdict = next(line for line in capsys.readouterr().out.splitlines() if "mesh distance" in line)
    assert verdict.startswith("PASS  mesh distance: 100.00 %")


def upright_and_lying(mesh, yaw_deg):
    """The mesh turned about Y, and the same as a Z-up file."""
    c, s = np.round(np.cos(np.radians(yaw_deg)), 12), np.round(np.sin(np.radians(yaw_deg)), 12)
    turned = mesh.vertices.astype(float) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    return replace(mesh, vertices=turned), replace(mesh, vertices=z_up(turned))


@cache
def generated(seed):
    return generate_room(seed)


@pytest.mark.parametrize("yaw_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("seed", [None, 0, 4])
def test_a_room_on_its_side_is_recognised_and_one_that_stands_is_not(seed, yaw_deg):
    upright, lying = upright_and_lying(mesh_of(room()) if seed is None else generated(seed), yaw_deg)
    assert looks_z_up(lying)
    assert not looks_z_up(upright)


@pytest.mark.slow
def test_of_all_generated_rooms_none_that_stands_is_taken_for_one_on_its_side():
    named = 0
    for seed in range(31):
        mesh = generate_room(seed)
        for yaw_deg in (0, 90):
            upright, lying = upright_and_lying(mesh, yaw_deg)
            assert not looks_z_up(upright), (seed, yaw_deg)
            named += looks_z_up(lying)
    assert named >= 54


def test_the_scanned_rooms_stand(shared):
    for name in ("white_room.glb", "grey_white_room.glb"):
        upright, lying = upright_and_lying(load_scene(shared / "scenes" / name).mesh, 0)
        assert not looks_z_up(upright)
        assert looks_z_up(lying)


def steps(width, height, depth):
    """Two flights side by side, up and up."""
    rises = [box((0, 0, 0), (width, height, depth), inward=True)]
    for index in range(int(height / 0.17)):
        flight, step = index // 12 % 2, index % 12
        x = 0.6 + (step if flight == 0 else 11 - step) * (width - 1.2) / 12
        z = flight * depth / 2
        rises.append(box((x, 0.17 * index, z), (x + 0.3, 0.17 * index + 0.17, z + depth / 2 - 0.05)))
    return np.concatenate(rises)


def attic(width, ridge, depth, knee):
    """A roof over a floor: two slopes, two low walls."""
    slopes = [
        [(0, 0, depth), (width, 0, depth), (width, 0, 0), (0, 0, 0)],
        [(0, knee, 0), (width, knee, 0), (width, ridge, depth / 2), (0, ridge, depth / 2)],
        [(0, knee, depth), (0, ridge, depth / 2), (width, ridge, depth / 2), (width, knee, depth)],
        [(0, 0, 0), (width, 0, 0), (width, knee, 0), (0, knee, 0)],
        [(0, 0, depth), (0, knee, depth), (width, knee, depth), (width, 0, depth)],
    ]
    return np.concatenate([np.array(slopes), box((1, 0, 0.4), (2, 0.9, 1)), box((2.5, 0, 1), (3.3, 0.7, 1.8))])


def lined(width, height, depth):
    """A corridor or loft with cupboards along one wall."""
    cupboards = [box((0.5 + 1.2 * i, 0, 0), (1.3 + 1.2 * i, 1 + 0.2 * i, 0.4)) for i in range(4)]
    return np.concatenate([box((0, 0, 0), (width, height, depth), inward=True), *cupboards])


STANDING = {
    "stairwells": [steps(*size) for size in itertools.product((2.5, 4, 6), (5, 10, 15), (2, 2.5, 4))],
    "corridors and lofts": [lined(*size) for size in itertools.product((6, 12, 20), (2.4, 3, 4, 6), (1.2, 2, 3, 4))],
    "attics": [attic(*size) for size in itertools.product((4, 8), (2.5, 3.5, 4.5), (3, 4.5, 7), (0.3, 1))],
    "empty rooms": [box((0, 0, 0), size, inward=True) for size in itertools.product((3, 6), (2.5, 4, 8), (2.5, 4))],
}


@pytest.mark.parametrize("kind", STANDING)
def test_what_is_high_and_narrow_stands(kind):
    for quads in STANDING[kind]:
        for turn in (quads, quads[..., [2, 1, 0]]):
            assert not looks_z_up(mesh_of(turn)), turn.reshape(-1, 3).max(axis=0)


def test_a_z_up_mesh_is_named_once_and_turned_on_request(tmp_path, caplog):
    path = write_ply(tmp_path / "a.ply", z_up(room()))
    area = {up: make_simulator("raycast", path, up=up).area.area_m2 for up in (None, "y", "z")}
    assert caplog.messages == [
        f"{path}: is taken as Y-up, but looks like a Z-up room on its side; if it is one, say --up z"
    ]
    assert area["z"] == pytest.approx(13.95, abs=0.02)
    assert area["y"] == area[None] < 10
    digests = {load_scene(path, up=up).digest for up in (None, "y", "z")}
    assert len(digests) == 2


def test_a_stage_config_that_forgets_the_axes_is_named_with_what_to_write(tmp_path, caplog):
    write_ply(tmp_path / "a.ply", z_up(room()))
    (tmp_path / "a.stage_config.json").write_text(json.dumps({"render_asset": "a.ply"}))
    load_scene(tmp_path / "a.stage_config.json")
    assert 'if it is one, say "up": [0, 0, 1], "front": [0, 1, 0] in a.stage_config.json' in caplog.text
    with pytest.raises(UsageError, match=r"^up: .*a.stage_config.json says itself which axis of its mesh points up"):
        load_scene(tmp_path / "a.stage_config.json", up="z")


def test_generated_rooms_are_y_up_whatever_is_said():
    assert identify(locate("builtin:0", up="z")) == identify(locate("builtin:0"))


@pytest.mark.parametrize(
    "make",
    [
        lambda **options: make_simulator("raycast", "builtin:0", **options),
        lambda **options: AVPEnv("builtin:0", **options),
        lambda **options: AVPVecEnv("builtin:0", **options),
        lambda **options: EvaluationCallback("builtin:0", **options),
    ],
)
def test_an_axis_that_is_none_is_refused_everywhere(make):
    with pytest.raises(UsageError, match=r"^up: expected y or z, got 'x'"):
        make(up="x")


def test_the_export_turns_a_mesh_too(tmp_path):
    write_ply(tmp_path / "a.ply", z_up(room()))
    assert command.run(export, [str(tmp_path / "a.ply"), str(tmp_path / "a.glb"), "--up", "z"]) == 0
    np.testing.assert_allclose(load_scene(tmp_path / "a.glb").mesh.bounds, [[0, 0, 0], [5, 2.7, 4]], atol=1e-6)


@pytest.mark.parametrize("make", [AVPEnv, AVPVecEnv])
def test_environments_take_paths_and_the_axis(tmp_path, make):
    path = write_ply(tmp_path / "a.ply", z_up(room()))
    env = make(path, up="z")
    area = env.get_attr("area")[0] if make is AVPVecEnv else env.area
    assert area.area_m2 == pytest.approx(13.95, abs=0.02)


def test_whatever_takes_scenes_takes_paths(tmp_path):
    """Lists of paths and strings mixed, and a change of scene."""
    path = write_obj(tmp_path / "a.obj", room())
    assert AVPVecEnv([path, "builtin:0"], agents=2).get_attr("scene_name") == ["a.obj", "builtin:0"]
    env = AVPEnv("builtin:0")
    env.change_scene(path)
    assert (env.scene_name, env.scene) == ("a.obj", str(path))
    for scenes in (path, [path, "builtin:1"]):
        EvaluationCallback(scenes)
