"""OBJ files and their material libraries as modelling programs write them."""

import numpy as np
import pytest
from PIL import Image

from avp_habitat.errors import SceneError
from avp_habitat.scenes.loader import load_scene

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [0, 0, 3], [2, 0, 3], [2, 1, 3], [0, 1, 3]], float)
FACES = [[0, 1, 2, 3], [4, 5, 6, 7]]


def vertices(rows):
    return "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in rows)


def write(folder, text, library=None):
    (folder / "room.obj").write_text(text)
    if library is not None:
        (folder / "room.mtl").write_text(library)
    return str(folder / "room.obj")


def surface(mesh):
    """The triangles' corners, in order."""
    return mesh.vertices[mesh.triangles].tolist()


@pytest.mark.parametrize(
    "text",
    [
        vertices(CORNERS[:4]) + "f -4 -3 -2 -1\n" + vertices(CORNERS[4:]) + "f -4 -3 -2 -1\n",
        vertices(CORNERS[:4]) + "f -4 -3 -2 -1\n" + vertices(CORNERS[4:]) + "f 5 6 7 8\n",
        vertices(CORNERS) + "f -8 -7 -6 -5\no second\ns off\nf -4 -3 -2 -1\n",
        vertices(CORNERS[:4])
        + "vn 0 0 1\nf -4//-1 -3//-1 -2//-1 -1//-1\r\n"
        + vertices(CORNERS[4:])
        + "f -4 -3 -2 8\n",
        "f 1 2 3 4\nf 5 6 \\\n 7 8\n" + vertices(CORNERS),
        vertices(CORNERS).replace("v ", "v\t").replace("\n", " # a corner\n", 0)
        + "g wall\nf 1 2 3 4\nl 1 2\nf 5 6 7 8",
    ],
)
def test_relative_indices_resolve_where_they_stand(tmp_path, text):
    expected = [CORNERS[[f[0], *pair]].tolist() for f in FACES for pair in ((f[1], f[2]), (f[2], f[3]))]
    assert surface(load_scene(write(tmp_path, text)).mesh) == expected


def test_relative_texture_coordinates_resolve_where_they_stand(tmp_path):
    Image.new("RGB", (2, 2)).save(tmp_path / "map.png")
    text = "mtllib room.mtl\nusemtl a\nvt 0 0\nvt 1 0\nvt 1 1\n" + vertices(CORNERS[:3]) + "f -3/-3 -2/-2 -1/-1\n"
    text += "vt 0 0.25\nvt 0.5 0.25\nvt 0.5 0.75\n" + vertices(CORNERS[4:7]) + "f -3/-3/-1 -2/-2/-1 -1/-1/-1\n"
    mesh = load_scene(write(tmp_path, text, "newmtl a\nmap_Kd map.png\n")).mesh
    np.testing.assert_allclose(mesh.uv[mesh.triangles[1]], [[0, 0.75], [0.5, 0.75], [0.5, 0.25]])
    assert mesh.texture_index.tolist() == [0, 0]


def test_a_box_of_materials_and_relative_faces_is_closed_and_coloured(tmp_path):
    """As the Cornell box is written: each wall has four corners of its own and a material."""
    walls = [[0, 1, 2, 3], [5, 4, 7, 6], [4, 0, 3, 7], [1, 5, 6, 2], [3, 2, 6, 7], [4, 5, 1, 0]]
    text = "mtllib room.mtl\n"
    for number, wall in enumerate(walls):
        text += (
            vertices(CORNERS[wall])
            + f"g wall{number}\nusemtl {'red' if number == 2 else 'white paint'}\nf -4 -3 -2 -1\n"
        )
    mesh = load_scene(write(tmp_path, text, "newmtl white paint\nKd 0.7 0.7 0.7\nnewmtl red\nKd 0.6 0.1 0\n")).mesh
    a, b, c = mesh.vertices[mesh.triangles].astype(float).transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(-6)
    np.testing.assert_allclose(mesh.colours[mesh.triangles[4, 0]], [0.6, 0.1, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.colours[mesh.triangles[0, 0]], [0.7, 0.7, 0.7], atol=1e-6)


@pytest.mark.parametrize(
    ("line", "scale", "offset"),
    [
        ("map_Kd {}", (1, 1), (0, 0)),
        ("map_Kd -s 1 1 1 {}", (1, 1), (0, 0)),
        ("map_Kd -s 2 4 1 -o 0.5 0.25 0 {}", (2, 4), (0.5, 0.25)),
        ("map_Kd -o 0.5 -s 2 {}", (2, 1), (0.5, 0)),
        ("map_kd\t-blendu on -bm 0.5 -clamp off -texres 512 -type sphere -s 3 3 {}  ", (3, 3), (0, 0)),
    ],
)
@pytest.mark.parametrize("name", ["map.png", "my old map.png", "tex/a-b.png"])
def test_the_options_of_a_texture_move_its_coordinates(tmp_path, caplog, line, scale, offset, name):
    (tmp_path / "tex").mkdir()
    Image.new("RGB", (2, 2), (9, 8, 7)).save(tmp_path / name)
    text = "mtllib room.mtl\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl a\n" + vertices(CORNERS[:3]) + "f 1/1 2/2 3/3\n"
    mesh = load_scene(write(tmp_path, text, f"newmtl a\n{line.format(name)}\n")).mesh
    assert mesh.textures[0][0, 0].tolist() == [9, 8, 7]
    expected = np.array([[0, 0], [1, 0], [1, 1]]) * scale + offset
    np.testing.assert_allclose(mesh.uv[mesh.triangles[0]], expected * [1, -1] + [0, 1], atol=1e-6)
    assert not caplog.messages


def test_one_picture_with_two_scales_is_kept_once(tmp_path):
    Image.new("RGB", (2, 2)).save(tmp_path / "map.png")
    text = "mtllib room.mtl\nvt 0.5 0\n" + vertices(CORNERS) + "usemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 2/1 3/1\n"
    mesh = load_scene(write(tmp_path, text, "newmtl a\nmap_Kd map.png\nnewmtl b\nmap_Kd -s 4 4 map.png\n")).mesh
    assert len(mesh.textures) == 1
    assert mesh.uv[mesh.triangles[:, 0], 0].tolist() == [0.5, 2]


@pytest.mark.parametrize(
    ("library", "said"),
    [
        ("newmtl a\nKd 1 1 1\nmap_Ke glow.png\n", "of its material 'a', map_Ke is not followed"),
        ("newmtl a\nmap_Kd -clamp on map.png\n", "of its material 'a', -clamp on is not followed"),
        ("newmtl a\nd 0.2\nKe 0 0 0\n", "of its material 'a', d 0.2 is not followed"),
        ("newmtl a\nKe 1 0.5 0\nd 1\n", "of its material 'a', Ke 1 0.5 0 is not followed"),
        ("newmtl b\n", "its material 'a' is in none of its libraries and is shown white"),
    ],
)
def test_what_of_a_material_is_not_shown_is_named_once(tmp_path, caplog, library, said):
    Image.new("RGB", (2, 2)).save(tmp_path / "map.png")
    path = write(tmp_path, "mtllib room.mtl\nusemtl a\n" + vertices(CORNERS) + "f 1 2 3\n", library)
    for _ in range(2):
        load_scene(path)
    assert [message.partition("room.obj: ")[2] for message in caplog.messages] == [said]


def test_libraries_may_have_names_with_spaces_or_be_several(tmp_path):
    (tmp_path / "my room.mtl").write_text("newmtl a\nKd 0.5 0 0\n")
    (tmp_path / "other.mtl").write_text("newmtl b\nKd 0 0.5 0\n")
    text = "mtllib my room.mtl\nmtllib other.mtl other.mtl\n" + vertices(CORNERS)
    mesh = load_scene(write(tmp_path, text + "usemtl a\nf 1 2 3\nusemtl b\nf 1 2 3\n")).mesh
    np.testing.assert_allclose(mesh.colours[mesh.triangles[:, 0]], [[0.5, 0, 0], [0, 0.5, 0]])


@pytest.mark.parametrize("most", [1, 255])
def test_vertex_colours_are_shares_or_bytes(tmp_path, most):
    text = "".join(f"v {x} {y} 0 {most} {0.2 * most} 0\n" for x, y in ((0, 0), (1, 0), (0, 1))) + "f 1 2 3\n"
    mesh = load_scene(write(tmp_path, text)).mesh
    np.testing.assert_allclose(mesh.colours, [[1, 0.2, 0]] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nf -2 1 1\n", r"-2 is none of the 1 before it.*\(line 2: 'f -2 1 1'\)"),
        ("v 0 0 0\nf 0 1 1\n", r"0 is none of the 1 before it"),
        ("v 0 0 x\n", r"could not convert string to float: 'x' \(line 1: 'v 0 0 x'\)"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 three\n", "invalid literal"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n", "a face names vt 1 of 0"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999\n", "a face names v 99999999999 of 3"),
        ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "have a position that is NaN or infinite"),
        ("v 1e400 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "have a position that is NaN or infinite"),
        ("mtllib gone.mtl\n", r"gone.mtl \(referred to by room.obj\): cannot be read"),
    ],
)
def test_a_damaged_obj_is_one_line_that_names_file_and_line(tmp_path, text, message):
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(write(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert "room.obj" in str(caught.value)


@pytest.mark.parametrize("line", ["Kd red", "map_Kd -s 1 1 1", "Kd"])
def test_a_damaged_library_is_named(tmp_path, line):
    path = write(tmp_path, "mtllib room.mtl\nusemtl a\n", f"newmtl a\n{line}\n")
    with pytest.raises(SceneError, match=rf"room.obj: room.mtl: .*\(line 2: '{line}'\)"):
        load_scene(path)


def test_a_byte_order_mark_hides_no_vertex(tmp_path):
    text = "\ufeff" + vertices(CORNERS) + "f 1 2 3 4 # floor\nf 5 6 7 8"
    assert surface(load_scene(write(tmp_path, text)).mesh)[0] == CORNERS[[0, 1, 2]].tolist()


def test_a_black_factor_leaves_a_picture_as_it_is(tmp_path, caplog):
    Image.new("RGB", (2, 2)).save(tmp_path / "map.png")
    text = "mtllib room.mtl\nusemtl a\nvt 0 0\n" + vertices(CORNERS) + "f 1/1 2/1 3/1\n"
    mesh = load_scene(write(tmp_path, text, "newmtl a\nKd 0 0 0\nmap_Kd map.png\n")).mesh
    assert (mesh.colours == 1).all()
    assert "its material 'a' has a picture and a black Kd, which is taken for white" in caplog.text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a\0b.png", r"b.png \(referred to by room.obj\): cannot be read: embedded null byte"),
        ("x" * 5000, "cannot be read: File name too long"),
    ],
)
def test_a_picture_whose_name_is_none_is_named(tmp_path, name, message):
    text = "mtllib room.mtl\nusemtl a\nvt 0 0\n" + vertices(CORNERS) + "f 1/1 2/1 3/1\n"
    with pytest.raises(SceneError, match=message):
        load_scene(write(tmp_path, text, f"newmtl a\nmap_Kd {name}\n"))
