import base64
import hashlib
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from avp_habitat.command import run
from avp_habitat.errors import AVPError, SceneError, UsageError
from avp_habitat.scenes import export
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.mesh import TexturedMesh

POSITIONS = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 1, 0]], "<f4")
PICTURE = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[10, 20, 30], [40, 50, 60], [70, 80, 90]]], np.uint8)


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def data_uri(content: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(content).decode()


class Gltf:
    """Builds a document entry by entry, so that each test shows only what it is about."""

    def __init__(self, **extra) -> None:
        self.blob = b""
        self.json = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], **extra}

    def view(self, content: bytes, **extra) -> int:
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content), **extra}
        )
        self.blob += content + b"\0" * (-len(content) % 4)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **extra) -> int:
        codes = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        width = 1 if values.ndim == 1 else values.shape[1]
        entry = {
            "bufferView": self.view(values.tobytes()),
            "componentType": codes[values.dtype.str[1:]],
            "count": len(values),
            "type": "SCALAR" if width == 1 else f"VEC{width}",
        }
        self.json["accessors"].append(entry | extra)
        return len(self.json["accessors"]) - 1

    def mesh(self, attributes: dict[str, int], **extra) -> int:
        self.json["meshes"].append({"primitives": [{"attributes": attributes, **extra}]})
        self.json.setdefault("nodes", [{"mesh": 0}])
        return len(self.json["meshes"]) - 1

    def write(self, folder: Path) -> str:
        path = folder / "scene.gltf"
        self.json["buffers"] = [{"uri": data_uri(self.blob), "byteLength": len(self.blob)}]
        path.write_text(json.dumps(self.json))
        return str(path)


def quad(indices=(0, 1, 2, 2, 1, 3), **extra) -> Gltf:
    document = Gltf(**extra)
    position = document.accessor(POSITIONS)
    document.mesh({"POSITION": position}, indices=document.accessor(np.array(indices, "<u2")))
    return document


def primitive(document: Gltf) -> dict:
    return document.json["meshes"][0]["primitives"][0]


def with_picture(document: Gltf, image: dict, **info) -> Gltf:
    uv = document.accessor(np.array([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4"))
    primitive(document)["attributes"]["TEXCOORD_1"] = uv
    primitive(document)["material"] = 0
    texture = {"baseColorTexture": {"index": 0, "texCoord": 1, **info}, "baseColorFactor": [0.5, 1, 0.25, 1]}
    document.json |= {"images": [image], "textures": [{"source": 0}], "materials": [{"pbrMetallicRoughness": texture}]}
    return document


def test_a_gltf_quad_is_read_as_it_is_stored(tmp_path):
    mesh = load_scene(quad().write(tmp_path)).mesh
    assert np.array_equal(mesh.vertices, POSITIONS)
    assert mesh.triangles.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert mesh.texture_index.tolist() == [-1, -1]
    assert (mesh.colours == 1).all()


@pytest.mark.parametrize(
    ("mode", "expected"), [(4, [[0, 1, 2]]), (5, [[0, 1, 2], [2, 1, 3]]), (6, [[0, 1, 2], [0, 2, 3]])]
)
def test_lists_strips_and_fans_without_indices_become_triangles(tmp_path, mode, expected):
    document = Gltf()
    document.mesh({"POSITION": document.accessor(POSITIONS if mode > 4 else POSITIONS[:3])}, mode=mode)
    assert load_scene(document.write(tmp_path)).mesh.triangles.tolist() == expected


def test_nested_nodes_apply_scale_then_rotation_then_translation_then_the_parents_matrix(tmp_path):
    half = np.sqrt(0.5)
    matrix = [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 10, 20, 30, 1]  # by columns: x -> -z, z -> x, then a shift
    document = quad(
        nodes=[
            {"matrix": matrix, "children": [1]},
            {"mesh": 0, "translation": [1, 2, 3], "rotation": [0, 0, half, half], "scale": [2, 3, 4]},
        ]
    )
    # (2, 1, 0) is scaled to (4, 3, 0), turned by 90 degrees about z to (-3, 4, 0), shifted to (-2, 6, 3).
    expected = np.array([3, 6, 2]) + [10, 20, 30]
    np.testing.assert_allclose(load_scene(document.write(tmp_path)).mesh.vertices[3], expected, atol=1e-5)


@pytest.mark.parametrize(
    "nodes",
    [
        [{"mesh": 0, "scale": [-1, 1, 1]}],
        [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -2, 0, 3, 4, 5, 1]}],
        [{"scale": [1, -1, 1], "children": [1]}, {"mesh": 0, "rotation": [0, 0.6, 0, 0.8]}],
    ],
    ids=["scale", "matrix", "parent"],
)
def test_a_mirroring_node_turns_the_winding_over(tmp_path, nodes):
    """What was counter-clockwise seen from the front stays so (glTF 2.0, section 3.7.4)."""
    mesh = load_scene(quad(nodes=nodes, scenes=[{"nodes": [0]}]).write(tmp_path)).mesh
    assert mesh.triangles.tolist() == [[2, 1, 0], [3, 1, 2]]


def test_two_mirrors_leave_the_winding(tmp_path):
    nodes = [{"scale": [-1, 1, 1], "children": [1]}, {"mesh": 0, "scale": [1, 1, -3]}]
    mesh = load_scene(quad(nodes=nodes, scenes=[{"nodes": [0]}]).write(tmp_path)).mesh
    assert mesh.triangles.tolist() == [[0, 1, 2], [2, 1, 3]]


def test_only_the_default_scene_is_read_and_a_mesh_may_be_used_twice(tmp_path):
    nodes = [{"mesh": 0, "translation": [9, 9, 9]}, {"mesh": 0}, {"mesh": 0, "translation": [0, 0, 5]}]
    document = quad(nodes=nodes, scenes=[{"nodes": [0]}, {"nodes": [1, 2]}], scene=1)
    mesh = load_scene(document.write(tmp_path)).mesh
    assert np.array_equal(mesh.vertices, np.concatenate([POSITIONS, POSITIONS + np.float32([0, 0, 5])]))
    assert mesh.triangles.max() == 7


@pytest.mark.parametrize(
    ("stored", "normalised", "expected"),
    [
        (np.array([[0, 65535, 13107, 7]] * 4, "<u2"), True, [0, 1, 0.2]),
        (np.array([[0, 255, 51]] * 4, "u1"), True, [0, 1, 0.2]),
        (np.array([[0, 2, 0.2]] * 4, "<f4"), False, [0, 1, 0.2]),
    ],
)
def test_vertex_colours_times_factor_are_multiplied_as_stored(tmp_path, stored, normalised, expected):
    document = with_picture(quad(), {"uri": data_uri(png(PICTURE))})
    if stored.dtype == "u1":
        stored = np.pad(stored, ((0, 0), (0, 1)))
    primitive(document)["attributes"]["COLOR_0"] = document.accessor(stored, normalized=normalised)
    mesh = load_scene(document.write(tmp_path)).mesh
    np.testing.assert_allclose(mesh.colours, np.tile(np.array(expected) * [0.5, 1, 0.25], (4, 1)), atol=1e-6)
    assert np.array_equal(mesh.textures[0], PICTURE)
    assert mesh.texture_index.tolist() == [0, 0]
    assert mesh.uv[1].tolist() == [1, 0]


def test_colours_above_one_are_cut_off(tmp_path):
    document = quad()
    primitive(document)["attributes"]["COLOR_0"] = document.accessor(np.full((4, 3), 3, "<f4"))
    assert (load_scene(document.write(tmp_path)).mesh.colours == 1).all()


def test_byte_strides_and_sparse_values_are_followed(tmp_path):
    document = Gltf()
    interleaved = np.concatenate([POSITIONS, np.full((4, 1), 7, "<f4")], axis=1)
    view = document.view(interleaved.astype("<f4").tobytes(), byteStride=16)
    rows, values = document.view(np.array([1], "u1").tobytes()), document.view(np.array([5, 6, 7], "<f4").tobytes())
    sparse = {"count": 1, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}}
    entry = {"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    document.json["accessors"].append(entry)
    document.mesh({"POSITION": 0}, mode=5)
    vertices = load_scene(document.write(tmp_path)).mesh.vertices
    assert vertices[1].tolist() == [5, 6, 7]
    assert np.array_equal(vertices[[0, 2, 3]], POSITIONS[[0, 2, 3]])


def test_a_texture_transform_scales_then_turns_counter_clockwise_then_shifts(tmp_path):
    moved = {"scale": [2, 3], "rotation": np.pi / 2, "offset": [0.5, 0.25]}
    document = with_picture(quad(), {"uri": data_uri(png(PICTURE))}, extensions={"KHR_texture_transform": moved})
    mesh = load_scene(document.write(tmp_path)).mesh
    # v points down, so a counter-clockwise quarter turn takes +u to -v and +v to +u.
    np.testing.assert_allclose(mesh.uv[1], [0.5, 0.25 - 2], atol=1e-6)
    np.testing.assert_allclose(mesh.uv[2], [0.5 + 3, 0.25], atol=1e-6)


def test_pictures_may_lie_beside_the_file_and_belong_to_the_digest(tmp_path):
    (tmp_path / "a b.png").write_bytes(png(PICTURE))
    spec = with_picture(quad(), {"uri": "a%20b.png"}).write(tmp_path)
    first = load_scene(spec)
    assert np.array_equal(first.mesh.textures[0], PICTURE)
    (tmp_path / "a b.png").write_bytes(png(PICTURE[::-1]))
    assert load_scene(spec).digest != first.digest


def test_a_picture_outside_the_folder_is_refused(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.png").write_bytes(png(PICTURE))
    spec = with_picture(quad(), {"uri": "../secret.png"}).write(inside)
    with pytest.raises(SceneError, match=r"'../secret.png', which lies outside the folder"):
        load_scene(spec)


def in_store(folder: Path, layout: str) -> Path:
    """The scene's two files as links into a store: beside the folder, as absolute paths, or the folder itself."""
    scene, store = folder / "snapshots/x", folder / "blobs"
    scene.mkdir(parents=True)
    document = with_picture(quad(), {"uri": "red.png"})
    document.write(scene)
    (scene / "red.png").write_bytes(png(PICTURE))
    store.mkdir()
    for number, name in enumerate(("scene.gltf", "red.png")):
        (scene / name).rename(store / f"{number}")
        base = store if layout == "absolute" else Path("../../blobs")
        (scene / name).symlink_to(base / f"{number}")
    if layout == "folder":
        (folder / "room").symlink_to(scene)
        return folder / "room/scene.gltf"
    return scene / "scene.gltf"


@pytest.mark.parametrize("layout", ["relative", "absolute", "folder"])
def test_a_scene_of_links_into_a_store_opens(tmp_path, layout):
    path = in_store(tmp_path, layout)
    assert np.array_equal(load_scene(str(path)).mesh.textures[0], PICTURE)


def test_a_scene_is_found_from_within_a_folder_that_is_a_link(tmp_path, monkeypatch):
    monkeypatch.chdir(in_store(tmp_path, "folder").parent)
    assert load_scene("scene.gltf").name == "scene.gltf"


@pytest.mark.parametrize("uri", ["../red.png", "link/../../red.png", "/red.png"])
def test_no_link_helps_a_picture_out_of_the_folder(tmp_path, uri):
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/link").symlink_to(tmp_path)
    (tmp_path / "a/red.png").write_bytes(png(PICTURE))
    path = with_picture(quad(), {"uri": uri}).write(tmp_path / "a/b")
    with pytest.raises(SceneError, match=rf"refers to '{uri}', which lies outside the folder of the scene"):
        load_scene(path)


@pytest.mark.parametrize("name", ["scene.gltf", "red.png"])
def test_a_link_whose_content_was_not_fetched_says_so(tmp_path, name):
    path = in_store(tmp_path, "relative")
    (path.parent / name).resolve().unlink()
    with pytest.raises(
        SceneError, match=rf"{name}.*: is a link to \.\./\.\./blobs/\d, where there is no file; fetch it"
    ):
        load_scene(str(path))


def test_two_links_to_one_file_are_two_scenes(tmp_path):
    from avp_habitat.simulators.registry import make_simulator

    path = export_room(tmp_path / "store.glb")
    for name in ("a.glb", "b.glb"):
        (tmp_path / name).symlink_to(path)
    first, second = (make_simulator("raycast", str(tmp_path / name)) for name in ("a.glb", "b.glb"))
    assert (first.scene, second.scene) == ("a.glb", "b.glb")


def export_room(path: Path) -> Path:
    export.export_glb(wedge(), path)
    return path


def test_a_picture_that_cannot_be_decoded_is_named(tmp_path):
    spec = with_picture(quad(), {"uri": data_uri(png(PICTURE)[:50])}).write(tmp_path)
    with pytest.raises(SceneError, match=r"scene.gltf: image 0: the picture cannot be decoded"):
        load_scene(spec)


def test_a_missing_picture_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"gone.png \(referred to by scene.gltf\): cannot be read: No such file"):
        load_scene(with_picture(quad(), {"uri": "gone.png"}).write(tmp_path))


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"])
def test_a_required_extension_that_is_not_supported_is_named(tmp_path, name):
    with pytest.raises(SceneError, match=f"requires the glTF extension {name}, which is not supported"):
        load_scene(quad(extensionsRequired=[name]).write(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda j: j["accessors"][0].update(count=400), "damaged: strides is incompatible with shape"),
        (lambda j: j["bufferViews"][1].update(byteLength=4000), "truncated: buffer view 1 ends at byte"),
        (lambda j: j["accessors"][0].update(componentType=1), "damaged: 1"),
        (lambda j: j["nodes"].append({"children": [0]}) or j["nodes"][0].update(children=[0]), "recursion depth"),
        (lambda j: j["nodes"][0].update(mesh=3), "damaged: list index out of range"),
        (lambda j: j["nodes"][0].update(rotation=[0, 0, 0, 0]), "zero norm quaternion"),
        (lambda j: j["meshes"][0]["primitives"][0].update(mode=1), "expected a mesh with triangles, found none"),
        (lambda j: j["scenes"][0].update(nodes=[]), "expected a mesh with triangles, found none"),
        (lambda j: j["asset"].update(version="1.0"), "expected glTF 2.0, got version 1.0"),
        (lambda j: j["meshes"][0]["primitives"][0]["attributes"].update(COLOR_0=1), "expected 4 values of COLOR_0"),
    ],
)
def test_a_damaged_gltf_is_a_scene_error(tmp_path, change, message):
    document = quad(scenes=[{"nodes": [0]}])
    change(document.json)
    with pytest.raises(SceneError, match=message):
        load_scene(document.write(tmp_path))


def sparse() -> Gltf:
    """A quad whose accessor of positions has no data but four sparse values."""
    document = Gltf()
    view = document.view
    entry = {"indices": {"bufferView": view(np.arange(4, dtype="<u2").tobytes()), "componentType": 5123}, "count": 4}
    entry["values"] = {"bufferView": view(POSITIONS.tobytes())}
    document.json["accessors"].append({"componentType": 5126, "type": "VEC3", "count": 4, "sparse": entry})
    document.mesh({"POSITION": 0}, indices=document.accessor(np.array([0, 1, 2], "<u2")))
    return document


def test_a_sparse_accessor_without_base_is_read(tmp_path):
    assert np.array_equal(load_scene(sparse().write(tmp_path)).mesh.vertices, POSITIONS)


def test_a_triangle_of_a_vertex_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(SceneError, match="a triangle names vertex 4 of 4"):
        load_scene(quad(indices=(0, 1, 4)).write(tmp_path))


def test_a_mesh_without_any_triangle_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"scene.gltf: expected a mesh with triangles, found none"):
        load_scene(quad(indices=(0, 1)).write(tmp_path))


def test_nan_positions_are_refused(tmp_path):
    document = Gltf()
    positions = POSITIONS.copy()
    positions[2, 1] = np.nan
    document.mesh({"POSITION": document.accessor(positions)}, mode=5)
    with pytest.raises(SceneError, match=r"1 of 4 vertices have a position that is NaN or infinite .* vertex 2"):
        load_scene(document.write(tmp_path))


def wedge() -> TexturedMesh:
    """Three triangles: one plain, two with different textures; nothing in it is symmetric."""
    rng = np.random.default_rng(3)
    vertices, uv, colours = rng.normal(size=(7, 3)), rng.normal(size=(7, 2)), rng.random((7, 3))
    triangles = np.array([[0, 1, 2], [2, 3, 4], [6, 5, 4]], np.int32)
    index = np.array([1, -1, 0], np.int32)
    textures = [PICTURE, np.ascontiguousarray(PICTURE[:1] // 2)]
    arrays = [a.astype(np.float32) for a in (vertices, uv, colours)]
    return TexturedMesh(arrays[0], triangles, arrays[1], arrays[2], index, textures)


def corners(mesh: TexturedMesh) -> list:
    """Everything about each triangle, in an order that does not depend on how the mesh is stored."""
    rows = []
    for triangle, texture in zip(mesh.triangles, mesh.texture_index, strict=True):
        picture = mesh.textures[texture].tolist() if texture >= 0 else None
        uv = mesh.uv[triangle].tolist() if texture >= 0 else None
        rows.append((mesh.vertices[triangle].tolist(), mesh.colours[triangle].tolist(), uv, picture))
    return sorted(rows, key=repr)


def test_an_exported_scene_loads_as_the_same_triangles(tmp_path):
    export.export_glb(wedge(), tmp_path / "out.glb")
    assert corners(load_scene(str(tmp_path / "out.glb")).mesh) == corners(wedge())
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.glb"]


@settings(max_examples=20, deadline=None)
@given(
    vertices=hnp.arrays(np.float32, (5, 3), elements=st.floats(-100, 100, width=32)),
    triangles=hnp.arrays(np.int32, (4, 3), elements=st.integers(0, 4)),
)
def test_any_mesh_survives_the_export(tmp_path_factory, vertices, triangles):
    path = tmp_path_factory.mktemp("export") / "mesh.glb"
    colours, uv = np.ones((5, 3), np.float32), np.zeros((5, 2), np.float32)
    mesh = TexturedMesh(vertices, triangles, uv, colours, np.full(4, -1, np.int32))
    export.export_glb(mesh, path)
    again = load_scene(str(path)).mesh
    assert np.array_equal(again.vertices[again.triangles], vertices[triangles])


def test_an_export_does_not_overwrite(tmp_path, capsys):
    (tmp_path / "out.glb").write_text("mine")
    source = quad().write(tmp_path)
    assert run(export.main, [source, str(tmp_path / "out.glb")]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "out.glb").read_text() == "mine"


def test_an_export_into_a_missing_folder_is_one_line(tmp_path, capsys):
    assert run(export.main, [quad().write(tmp_path), str(tmp_path / "no" / "out.glb")]) == 1
    assert "cannot be written: there is no folder" in capsys.readouterr().err


def test_the_export_command_writes_the_scene(tmp_path, capsys):
    assert run(export.main, [quad().write(tmp_path), str(tmp_path / "out.glb")]) == 0
    assert "wrote" in capsys.readouterr().out
    assert len(load_scene(str(tmp_path / "out.glb")).mesh.triangles) == 2


def test_a_truncated_glb_is_a_scene_error(tmp_path):
    whole = tmp_path / "whole.glb"
    export.export_glb(wedge(), whole)
    content = whole.read_bytes()
    for size in (3, 10, 30, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.glb").write_bytes(content[:size])
        with pytest.raises(SceneError, match=r"cut.glb: expected a valid glTF 2.0 file, but it is damaged"):
            load_scene(str(tmp_path / "cut.glb"))


def test_a_glb_whose_header_lies_is_a_scene_error(tmp_path):
    export.export_glb(wedge(), tmp_path / "whole.glb")
    content = bytearray((tmp_path / "whole.glb").read_bytes()[:-400])
    content[8:12] = struct.pack("<I", len(content))
    (tmp_path / "cut.glb").write_bytes(content)
    with pytest.raises(SceneError, match="truncated: buffer view"):
        load_scene(str(tmp_path / "cut.glb"))


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{vertex}element face {faces}
property list uchar int vertex_indices
{face}end_header
"""


def test_a_ply_keeps_vertex_colours_and_splits_quads(tmp_path):
    colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    body = "0 0 0 255 0 51\n2 0 0 0 255 51\n2 1 0 0 0 255\n0 1 0 255 255 255\n4 0 1 2 3\n"
    (tmp_path / "room.ply").write_text(PLY.format(vertex=colours, faces=1, face="") + body)
    mesh = load_scene(str(tmp_path / "room.ply")).mesh
    assert len(mesh.triangles) == 2
    assert set(mesh.triangles.ravel().tolist()) == {0, 1, 2, 3}
    np.testing.assert_allclose(mesh.colours[:2], [[1, 0, 0.2], [0, 1, 0.2]], atol=1e-6)


def test_a_ply_with_face_colours_shows_each_face_in_its_colour(tmp_path):
    colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    body = "0 0 0\n2 0 0\n2 1 0\n0 1 0\n3 0 1 2 255 0 0\n3 0 2 3 0 51 0\n"
    (tmp_path / "room.ply").write_text(PLY.format(vertex="", faces=2, face=colours) + body)
    mesh = load_scene(str(tmp_path / "room.ply")).mesh
    assert mesh.vertices[mesh.triangles[1]].tolist() == [[0, 0, 0], [2, 1, 0], [0, 1, 0]]
    np.testing.assert_allclose(mesh.colours[mesh.triangles[0]], [[1, 0, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(mesh.colours[mesh.triangles[1]], [[0, 0.2, 0]] * 3, atol=1e-6)


def test_a_ply_with_texture_turns_v_downwards(tmp_path):
    (tmp_path / "map.png").write_bytes(png(PICTURE))
    header = PLY.replace("ascii 1.0\n", "ascii 1.0\ncomment TextureFile map.png\n")
    body = "0 0 0 0 0\n2 0 0 1 0\n2 1 0 1 1\n0 1 0 0 0.75\n3 0 1 2\n3 0 2 3\n"
    vertex = "property float s\nproperty float t\n"
    (tmp_path / "room.ply").write_text(header.format(vertex=vertex, faces=2, face="") + body)
    mesh = load_scene(str(tmp_path / "room.ply")).mesh
    corner = int(np.flatnonzero((mesh.vertices == [0, 1, 0]).all(axis=1))[0])
    assert mesh.uv[corner].tolist() == [0, 0.25]
    assert np.array_equal(mesh.textures[0], PICTURE)
    assert mesh.texture_index.tolist() == [0, 0]


OBJ = "mtllib room.mtl\nv 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 0.75\n"
OBJ += "usemtl wood\nf 1/1 2/2 3/3 4/4\nusemtl plain\nf 1/1 2/2 3/3\n"


def obj(folder: Path, library: str) -> str:
    (folder / "room.obj").write_text(OBJ)
    (folder / "room.mtl").write_text(library)
    return str(folder / "room.obj")


def test_an_obj_has_textures_times_diffuse_colours_with_v_downwards(tmp_path):
    (tmp_path / "map.png").write_bytes(png(PICTURE))
    spec = obj(tmp_path, "newmtl wood\nKd 0.5 1 0.25\nmap_Kd map.png\nnewmtl plain\nKd 0.1 0.2 0.3\n")
    mesh = load_scene(spec).mesh
    wooden, plain = mesh.triangles[mesh.texture_index == 0], mesh.triangles[mesh.texture_index == -1]
    assert (len(wooden), len(plain)) == (2, 1)
    np.testing.assert_allclose(mesh.colours[wooden[0]], [[0.5, 1, 0.25]] * 3)
    np.testing.assert_allclose(mesh.colours[plain[0]], [[0.1, 0.2, 0.3]] * 3)
    at = {tuple(mesh.vertices[i].tolist()): mesh.uv[i].tolist() for i in wooden.ravel()}
    assert at[(0, 1, 0)] == [0, 0.25]
    assert at[(2, 0, 0)] == [1, 1]
    assert np.array_equal(mesh.textures[0], PICTURE)


def test_a_third_texture_coordinate_of_an_obj_is_ignored(tmp_path):
    (tmp_path / "map.png").write_bytes(png(PICTURE))
    spec = obj(tmp_path, "newmtl wood\nmap_Kd map.png\nnewmtl plain\n")
    (tmp_path / "room.obj").write_text("\n".join(f"{x} 9" if x.startswith("vt") else x for x in OBJ.split("\n")))
    mesh = load_scene(spec).mesh
    assert 0 in mesh.texture_index
    assert mesh.uv.max() == 1


def test_an_obj_with_flat_vertices_is_refused(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    with pytest.raises(SceneError, match=r"flat.obj: expected three coordinates for every vertex"):
        load_scene(str(tmp_path / "flat.obj"))


def test_the_digest_of_an_obj_covers_its_library_and_pictures(tmp_path):
    digests = set()
    for colour, pixels in (("0.5", PICTURE), ("0.6", PICTURE), ("0.6", PICTURE[::-1])):
        (tmp_path / "map.png").write_bytes(png(pixels))
        spec = obj(tmp_path, f"newmtl wood\nKd {colour} 1 1\nmap_Kd map.png\nnewmtl plain\n")
        digests.add(load_scene(spec).digest)
    assert len(digests) == 3


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("../secret.png", "'../secret.png', which lies outside the folder"),
        ("gone.png", r"gone.png \(referred to by room.obj\): cannot be read"),
        ("broken.png", "room.obj: broken.png: the picture cannot be decoded"),
    ],
)
def test_a_bad_texture_of_an_obj_is_named(tmp_path, reference, message):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.png").write_bytes(png(PICTURE))
    (inside / "broken.png").write_bytes(b"no picture")
    with pytest.raises(SceneError, match=message):
        load_scene(obj(inside, f"newmtl wood\nmap_Kd {reference}\n"))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("a.ply", b"garbage"),
        ("a.ply", PLY.format(vertex="", faces=1, face="").encode() + b"0 0 0\n1 0 0\n"),
        ("a.ply", PLY.format(vertex="", faces=1, face="").encode() + b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 9\n"),
        ("a.obj", b"garbage"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("a.obj", b"\xff\xfe\x00"),
        ("a.glb", b"garbage"),
        ("a.gltf", b"[1, 2]"),
        ("a.gltf", b"{"),
    ],
)
def test_garbage_is_a_scene_error_that_names_the_file(tmp_path, capsys, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=rf"{name}: ") as caught:
        load_scene(str(tmp_path / name))
    assert "\n" not in str(caught.value)
    assert capsys.readouterr().err == ""


def test_an_empty_file_is_a_scene_error(tmp_path):
    (tmp_path / "a.glb").write_bytes(b"")
    with pytest.raises(SceneError, match=r"a.glb: the file is empty"):
        load_scene(str(tmp_path / "a.glb"))


def test_an_unknown_file_brings_the_nearest_name(tmp_path):
    quad().write(tmp_path)
    with pytest.raises(SceneError, match=r"scenes.glb: no such scene file; did you mean 'scene.gltf'\?"):
        load_scene(str(tmp_path / "scenes.glb"))


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(SceneError, match="there is no folder"):
        load_scene(str(tmp_path / "no" / "scene.glb"))


def test_a_folder_is_no_scene(tmp_path):
    (tmp_path / "scene.glb").mkdir()
    with pytest.raises(SceneError, match="expected a scene file, found a folder"):
        load_scene(str(tmp_path / "scene.glb"))


@pytest.mark.parametrize(("spec", "found"), [("room.fbx", r"'\.fbx'"), ("room", "''")])
def test_an_unknown_suffix_brings_the_supported_ones(spec, found):
    with pytest.raises(
        UsageError,
        match=rf"expected a scene file, got the suffix {found}; a scene is a mesh \(\.glb \.gltf \.ply \.obj\)",
    ):
        load_scene(spec)


@pytest.mark.parametrize("seed", ["x", "-1", "1.5", "", "²"])
def test_a_seed_must_be_a_whole_number(seed):
    with pytest.raises(AVPError, match="expected builtin:SEED with an integer SEED >= 0"):
        load_scene(f"builtin:{seed}")


def test_the_white_room_has_its_baked_light(shared):
    scene = load_scene(str(shared / "scenes" / "white_room.glb"))
    assert scene.name == "white_room.glb"
    assert len(scene.mesh.triangles) == 767934
    assert len(scene.mesh.textures) == 13
    assert 0.4 < scene.mesh.colours.mean() < 0.95


def test_a_generated_room_is_named_by_its_seed_and_generator():
    from avp_habitat.scenes.builtin.room import GENERATOR_VERSION

    scene = load_scene("builtin:007")
    assert scene.name == "builtin:7"
    assert scene.digest == hashlib.sha256(f"builtin:7:v{GENERATOR_VERSION}".encode()).hexdigest()
    assert len(scene.mesh.triangles) > 100
