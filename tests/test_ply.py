"""PLY files as editors and scanners write them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from avp_habitat.errors import SceneError
from avp_habitat.scenes.loader import load_scene

POSITIONS = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 2, 0], [4, 0.5, 0]], float)
COLOURS = np.array([[255, 0, 51], [0, 255, 51], [0, 0, 255], [255, 255, 255], [51, 51, 51], [102, 0, 0]])
POLYGONS = [[0, 1, 2], [0, 1, 2, 3], [0, 1, 2, 4, 3], [1, 5, 2], [0, 1, 2, 3]]
TRIANGLES = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3], [1, 5, 2], [0, 1, 2], [0, 2, 3]]
OF_POLYGON = [0, 1, 1, 2, 2, 2, 3, 4, 4]
XYZ = [(name, "float") for name in "xyz"]
RGB = [(name, "uchar") for name in ("red", "green", "blue")]
CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8"}


def ply(path, vertex, rows, face=(), extra=None, order="<", polygons=POLYGONS, comment=""):
    """Write a PLY; `order` is `<` or `>` for binary, else text with that between its lines."""
    named = {"<": "binary_little_endian", ">": "binary_big_endian"}.get(order, "ascii")
    lines = ["ply", f"format {named} 1.0", *([comment] if comment else []), f"element vertex {len(rows)}"]
    lines += [f"property {kind} {name}" for name, kind in vertex]
    lines += [f"element face {len(polygons)}", "property list uchar int vertex_indices"]
    lines += [f"property {kind} {name}" for name, kind in face] + ["end_header"]
    extra = extra if extra is not None else [[] for _ in polygons]
    if named == "ascii":
        body = [" ".join(f"{value:.17g}" for value in row) for row in rows]
        body += [" ".join(map(str, [len(p), *p, *more])) for p, more in zip(polygons, extra, strict=True)]
        path.write_bytes((order.join([*lines, *body]) + order).encode())
        return str(path)

    def packed(values, kinds):
        return b"".join(np.array(v).astype(order + CODES[k]).tobytes() for v, k in zip(values, kinds, strict=True))

    body = b"".join(packed(row, [kind for _, kind in vertex]) for row in rows)
    for polygon, more in zip(polygons, extra, strict=True):
        body += bytes([len(polygon)]) + np.array(polygon, f"{order}i4").tobytes()
        body += packed(more, [kind for _, kind in face])
    path.write_bytes("\n".join(lines).encode() + b"\n" + body)
    return str(path)


def coloured(path, names=("red", "green", "blue"), kind="uchar", colours=COLOURS, **more):
    vertex = [*XYZ, *((name, kind) for name in names)]
    return ply(path, vertex, np.hstack([POSITIONS, colours]).tolist(), **more)


@pytest.mark.parametrize("order", ["<", ">", "\n", "\r\n"])
def test_triangles_quads_and_polygons_mixed_are_read_alike_as_text_and_binary(tmp_path, order):
    mesh = load_scene(coloured(tmp_path / "a.ply", order=order)).mesh
    assert np.array_equal(mesh.vertices, POSITIONS.astype(np.float32))
    assert mesh.triangles.tolist() == TRIANGLES
    np.testing.assert_allclose(mesh.colours, COLOURS / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "kind", "stored"),
    [
        (("diffuse_red", "diffuse_green", "diffuse_blue"), "uchar", COLOURS),
        (("r", "g", "b"), "uchar", COLOURS),
        (("red", "green", "blue"), "float", COLOURS / 255),
        (("r", "g", "b"), "double", COLOURS / 255),
        (("red", "green", "blue"), "float", COLOURS),
        (("red", "green", "blue"), "ushort", COLOURS * 257),
        (("red", "green", "blue"), "int", COLOURS),
        (("red", "green", "blue"), "char", COLOURS.astype("u1").astype("i1")),
    ],
)
@pytest.mark.parametrize("order", ["<", "\n"])
def test_colours_are_read_under_other_names_and_types(tmp_path, names, kind, stored, order):
    mesh = load_scene(coloured(tmp_path / "a.ply", names, kind, stored, order=order)).mesh
    np.testing.assert_allclose(mesh.colours, COLOURS / 255, atol=1e-6)


@pytest.mark.parametrize("order", ["<", ">", "\n"])
@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")])
def test_the_colours_of_faces_are_those_of_all_their_triangles(tmp_path, order, names):
    colours = COLOURS[:5]
    face = [(name, "uchar") for name in names]
    path = ply(tmp_path / "a.ply", XYZ, POSITIONS.tolist(), face, colours.tolist(), order)
    mesh = load_scene(path).mesh
    np.testing.assert_allclose(mesh.vertices[mesh.triangles], POSITIONS[np.array(TRIANGLES)], atol=1e-6)
    np.testing.assert_allclose(mesh.colours[mesh.triangles[:, 0]], colours[OF_POLYGON] / 255, atol=1e-6)
    np.testing.assert_allclose(mesh.colours[mesh.triangles[:, 2]], colours[OF_POLYGON] / 255, atol=1e-6)


def test_the_texture_coordinates_of_faces_and_their_texture_numbers_are_followed(tmp_path):
    for number, name in enumerate(("one.png", "two name.png")):
        Image.new("RGB", (2, 2), (40 * number, 0, 0)).save(tmp_path / name)
    header = "ply\nformat ascii 1.0\ncomment TextureFile one.png\ncomment TextureFile two name.png\nelement vertex 3\n"
    header += "property float x\nproperty float y\nproperty float z\nelement face 2\n"
    header += "property list uchar int vertex_index\nproperty list uchar float texcoord\nproperty int texnumber\n"
    body = "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 0 1 1\n3 2 1 0 6 0.5 0.5 0 0 1 0.25 0\n"
    (tmp_path / "a.ply").write_text(header + body)
    mesh = load_scene(tmp_path / "a.ply").mesh
    assert [int(mesh.textures[index][0, 0, 0]) for index in mesh.texture_index] == [40, 0]
    assert mesh.uv[mesh.triangles[1]].tolist() == [[0.5, 0.5], [0, 1], [1, 0.75]]


def test_colours_that_are_not_followed_are_named_once(tmp_path, caplog):
    path = coloured(tmp_path / "a.ply", ("f_dc_0", "f_dc_1", "f_dc_2"), "float")
    for _ in range(2):
        assert (load_scene(path).mesh.colours == 1).all()
    assert len(caplog.messages) == 1
    assert "a.ply: is shown white: its f_dc_0, f_dc_1, f_dc_2 are not followed" in caplog.text


def test_a_texture_without_coordinates_is_named(tmp_path, caplog):
    Image.new("RGB", (2, 2)).save(tmp_path / "map.png")
    path = ply(tmp_path / "a.ply", XYZ, POSITIONS.tolist(), comment="comment TextureFile map.png")
    assert load_scene(path).mesh.texture_index.tolist() == [-1] * len(TRIANGLES)
    assert "it names map.png, but has no texture coordinates" in caplog.text


def test_a_mesh_with_colours_that_are_read_says_nothing(tmp_path, caplog):
    load_scene(coloured(tmp_path / "a.ply"))
    assert not caplog.messages


@pytest.mark.parametrize("order", ["<", "\n"])
@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("vertex 6", "vertex 4000000000", "buffer is smaller than requested size"),
        ("face 5", "face 999999999999", "truncated: the rows of face do not end where the file does"),
        ("face 5", "face 6", "truncated: the "),
        ("face 5", "face -5", "element face has -5 rows"),
        ("face 5", "face many", "invalid literal"),
        ("uchar red", "colour red", "expected a property of a known type"),
        ("end_header", "nothing", "truncated: expected a header that ends with end_header"),
    ],
)
def test_a_damaged_header_is_one_line_and_allocates_nothing(tmp_path, order, before, after, message):
    path = tmp_path / "a.ply"
    coloured(path, order=order)
    path.write_bytes(path.read_bytes().replace(before.encode(), after.encode()))
    with pytest.raises(SceneError, match=rf"a.ply: expected a valid .ply file, but it is damaged: .*{message}"):
        load_scene(path)


def test_a_list_that_claims_more_values_than_there_are_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    coloured(path)
    content = bytearray(path.read_bytes().replace(b"list uchar int", b"list uint int"))
    content[-17:-13] = b"\xff\xff\xff\x7f"
    path.write_bytes(bytes(content))
    with pytest.raises(SceneError, match="damaged: truncated"):
        load_scene(path)


def test_a_point_cloud_is_told_from_a_mesh(tmp_path):
    path = tmp_path / "a.ply"
    ply(path, XYZ, POSITIONS.tolist(), polygons=[])
    path.write_bytes(path.read_bytes().replace(b"element face 0\nproperty list uchar int vertex_indices\n", b""))
    with pytest.raises(SceneError, match=r"found none, but vertex \(x, y, z\); is it a point cloud"):
        load_scene(path)


def test_a_text_with_other_things_than_numbers_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    coloured(path, order="\n")
    path.write_bytes(path.read_bytes().replace(b"\n2 1 0", b"\n2 one 0"))
    with pytest.raises(SceneError, match="expected numbers after the header"):
        load_scene(path)


@pytest.mark.parametrize(("line", "row"), [(3, "2 1"), (3, "2 1 0 0"), (8, "4 0 1 2 3 4")])
def test_a_text_with_a_number_too_few_or_too_many_is_refused(tmp_path, line, row):
    path = tmp_path / "a.ply"
    lines = Path(ply(path, XYZ, POSITIONS.tolist(), order="\n")).read_text().splitlines()
    lines[lines.index("end_header") + line] = row
    path.write_text("\n".join(lines))
    with pytest.raises(SceneError, match=r"a\.ply: expected a valid .ply file, but it is damaged: "):
        load_scene(path)


def test_a_text_in_lines_of_any_length_is_read(tmp_path):
    path = tmp_path / "a.ply"
    head, body = Path(ply(path, XYZ, POSITIONS.tolist(), order="\n")).read_text().split("end_header")
    path.write_text(f"{head}end_header\n{' '.join(body.split())}\n")
    assert load_scene(path).mesh.triangles.tolist() == TRIANGLES
