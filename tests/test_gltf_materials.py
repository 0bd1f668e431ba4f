"""What materials of glTF files show, where MASK leaves nothing, and what is said of the rest."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from test_scenes import PICTURE, Gltf, data_uri, png, primitive, quad, with_picture

from avp_habitat.errors import SceneError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.export import export_glb
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import Frame, locate
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.simulators.habitat.stage import write_stage
from avp_habitat.simulators.raycast import RaycastSimulator

GLOSS, UNLIT, STRENGTH = (f"KHR_materials_{name}" for name in ("pbrSpecularGlossiness", "unlit", "emissive_strength"))
INFO = {"index": 0, "texCoord": 1}


def of_material(folder: Path, material: dict, pixels: np.ndarray = PICTURE, **extra) -> TexturedMesh:
    document = with_picture(quad(**extra), {"uri": data_uri(png(pixels))})
    document.json["materials"] = [material]
    return load_scene(document.write(folder)).mesh


# --- colours ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("material", "factor"),
    [
        ({"pbrMetallicRoughness": {"baseColorTexture": INFO}}, [1, 1, 1]),
        ({"extensions": {GLOSS: {"diffuseTexture": INFO}}}, [1, 1, 1]),
        ({"extensions": {GLOSS: {"diffuseTexture": INFO, "diffuseFactor": [0.5, 1, 0.25, 1]}}}, [0.5, 1, 0.25]),
        # The metallic-roughness part is there for who does not know the extension.
        (
            {
                "extensions": {GLOSS: {"diffuseTexture": INFO}},
                "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]},
            },
            [1, 1, 1],
        ),
        ({"emissiveTexture": INFO, "emissiveFactor": [1, 1, 1]}, [1, 1, 1]),
        (
            {
                "emissiveTexture": INFO,
                "emissiveFactor": [1, 1, 1],
                "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
            },
            [1, 1, 1],
        ),
        # As Blender writes an emissive picture over its default grey.
        (
            {
                "emissiveTexture": INFO,
                "emissiveFactor": [1, 0.5, 1],
                "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.8, 0.8, 1]},
            },
            [1, 0.5, 1],
        ),
        (
            {
                "emissiveTexture": INFO,
                "emissiveFactor": [0.25, 0.25, 0.25],
                "extensions": {STRENGTH: {"emissiveStrength": 2.0}},
            },
            [0.5, 0.5, 0.5],
        ),
        (
            {
                "emissiveTexture": INFO,
                "emissiveFactor": [1, 1, 1],
                "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "baseColorTexture": INFO},
            },
            [1, 1, 1],
        ),
    ],
)
def test_the_picture_is_found_wherever_a_material_keeps_it(tmp_path, material, factor):
    mesh = of_material(tmp_path, material)
    assert np.array_equal(mesh.textures[0], PICTURE)
    assert mesh.texture_index.tolist() == [0, 0]
    np.testing.assert_allclose(mesh.colours, np.tile(np.float32(factor), (4, 1)))


@pytest.mark.parametrize(
    ("material", "colour"),
    [
        ({"extensions": {GLOSS: {"diffuseFactor": [0.8, 0.2, 0.1, 1]}}}, [0.8, 0.2, 0.1]),
        ({"emissiveFactor": [1, 0.5, 0]}, [1, 0.5, 0]),
        ({"emissiveFactor": [1, 0.5, 0], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}}, [1, 0.5, 0]),
        # A coloured thing that glows keeps its colour, one that emits nothing does so too.
        (
            {"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}},
            [0.2, 0.4, 0.6],
        ),
        ({"emissiveTexture": INFO, "pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}}, [0.2, 0.4, 0.6]),
        ({"emissiveFactor": [1, 0, 0], "extensions": {UNLIT: {}}}, [1, 1, 1]),
    ],
)
def test_a_colour_without_picture_is_found_as_well(tmp_path, material, colour):
    mesh = of_material(tmp_path, material)
    assert mesh.textures == []
    np.testing.assert_allclose(mesh.colours, np.tile(np.float32(colour), (4, 1)))


def test_specular_glossiness_may_be_required_and_its_texture_moved(tmp_path):
    info = INFO | {"extensions": {"KHR_texture_transform": {"offset": [0.25, 0.5]}}}
    mesh = of_material(tmp_path, {"extensions": {GLOSS: {"diffuseTexture": info}}}, extensionsRequired=[GLOSS])
    np.testing.assert_allclose(mesh.uv[3], [1.25, 1.5])


def test_vertex_colours_do_not_tint_what_is_all_light(tmp_path):
    document = with_picture(quad(), {"uri": data_uri(png(PICTURE))})
    document.json["materials"] = [{"emissiveTexture": INFO, "emissiveFactor": [1, 1, 1]}]
    primitive(document)["attributes"]["COLOR_0"] = document.accessor(np.full((4, 3), 0.25, "<f4"))
    assert (load_scene(document.write(tmp_path)).mesh.colours == 1).all()


@pytest.mark.parametrize(
    ("stored", "normalised"),
    [
        (np.full((4, 4), 51, "u1"), True),
        (np.full((4, 4), 51, "u1"), False),
        (np.full((4, 4), 13107, "<u2"), False),
        (np.full((4, 3), 0.2, "<f4"), False),
        (np.full((4, 4), 0.2, "<f4"), False),
    ],
)
def test_vertex_colours_of_every_type_mean_the_same(tmp_path, stored, normalised):
    document = quad()
    primitive(document)["attributes"]["COLOR_0"] = document.accessor(stored, normalized=normalised)
    np.testing.assert_allclose(load_scene(document.write(tmp_path)).mesh.colours, np.full((4, 3), 0.2), atol=1e-6)


# --- what is said -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("material", "extensions", "words"),
    [
        ({"alphaMode": "BLEND", "name": "glass"}, [], "transparent materials are shown opaque: glass"),
        ({"alphaMode": "BLEND"}, [], "transparent materials are shown opaque: material 0"),
        (
            {"name": "pane", "extensions": {"KHR_materials_transmission": {}}},
            ["KHR_materials_transmission", "KHR_materials_ior"],
            "transparent materials are shown opaque: pane",
        ),
        ({}, ["EXT_b", "EXT_a"], "extensions that are not supported are ignored: EXT_a, EXT_b"),
        ({"alphaMode": "BLEND"}, ["EXT_a"], "transparent .*material 0; extensions .*EXT_a"),
    ],
)
def test_what_is_not_shown_is_named_in_one_line(tmp_path, caplog, material, extensions, words):
    for _ in range(2):
        of_material(tmp_path, material, extensionsUsed=extensions)
    (message,) = caplog.messages
    assert message.startswith(f"{tmp_path / 'scene.gltf'}: ")
    assert "\n" not in message
    assert re.search(rf": {words}$", message), message


def test_nothing_is_said_of_what_changes_nothing(tmp_path, caplog):
    lit_only = ["KHR_materials_ior", "KHR_materials_specular", "KHR_lights_punctual", "KHR_texture_basisu"]
    of_material(tmp_path, {"pbrMetallicRoughness": {"baseColorTexture": INFO}}, extensionsUsed=lit_only)
    assert caplog.messages == []


# --- masks ------------------------------------------------------------------------------------------------------------

HOLE = np.full((8, 8, 4), 255, np.uint8)
HOLE[:, 4:, 3] = 0
HOLE[..., 0] = 10
WIDE, HIGH, DEEP = 4.0, 2.5, 3.0


@pytest.mark.parametrize("wrap", [33071, 33648])
@pytest.mark.parametrize("scale", [1, 3])
def test_a_picture_that_is_not_repeated_beyond_its_edge_is_named(tmp_path, caplog, wrap, scale):
    moved = INFO | {"extensions": {"KHR_texture_transform": {"scale": [scale, 1]}}}
    document = with_picture(quad(), {"uri": data_uri(png(PICTURE))})
    document.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": moved}}]
    document.json["samplers"] = [{"wrapS": wrap}]
    document.json["textures"][0]["sampler"] = 0
    load_scene(document.write(tmp_path))
    assert len(caplog.messages) == (scale > 1)
    assert "clamped or mirrored beyond their edges are repeated there" in caplog.text or scale == 1


def panes(*pixels: np.ndarray, at: float = 2.0, gap: float = 0.3, alpha: float = 1.0, **extra) -> Gltf:
    """A room of one colour, cut in two by masked panes, each with a picture of its own."""
    document = Gltf()
    x, y, z = WIDE, HIGH, DEEP
    box = np.array(list(itertools.product((0, x), (0, y), (0, z))), "<f4")
    sides = [(0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5), (0, 2, 3, 1), (4, 5, 7, 6)]
    corners = np.array([[a, b, c, a, c, d] for a, b, c, d in sides], "<u2").ravel()
    position = document.accessor(box)
    document.mesh({"POSITION": position}, indices=document.accessor(corners))
    document.json |= {"materials": [], "textures": [], "images": []}
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
    for number, picture in enumerate(pixels):
        here = at + number * gap
        pane = np.array([[here, 0, 0], [here, 0, z], [here, y, z], [here, y, 0]], "<f4")
        attributes = {"POSITION": document.accessor(pane), "TEXCOORD_0": document.accessor(uv)}
        shading = {"baseColorTexture": {"index": number}, "baseColorFactor": [1, 1, 1, alpha]}
        document.json["meshes"][0]["primitives"].append(
            {
                "attributes": attributes,
                "indices": document.accessor(np.array([0, 1, 2, 0, 2, 3], "<u2")),
                "material": number,
            }
        )
        document.json["materials"].append({"alphaMode": "MASK", "pbrMetallicRoughness": shading, **extra})
        document.json["textures"].append({"source": number})
        document.json["images"].append({"uri": data_uri(png(picture))})
    return document


def simulator(folder: Path, document: Gltf) -> RaycastSimulator:
    return RaycastSimulator(load_scene(document.write(folder)))


def look(sim: RaycastSimulator):
    """From the west wall to the east: the pane's picture begins at z = 0, which is on the left."""
    pose = camera_to_world(np.array([[0.5, 1.25, 1.5]]), yaw=np.array([-np.pi / 2]), pitch=np.zeros(1))
    return sim.render(pose, Intrinsics.from_hfov(64, 48, hfov_deg=60), rgb=True)


def test_rays_go_on_through_the_holes_of_a_masked_pane(tmp_path):
    sim = simulator(tmp_path, panes(HOLE))
    seen = look(sim)
    middle = seen.depth[0, 24]
    np.testing.assert_allclose(middle[:31], 1.5, atol=1e-4)
    np.testing.assert_allclose(middle[33:54], 3.5, atol=1e-3)
    assert seen.rgb is not None
    assert seen.rgb[0, 24, :30].tolist() == [[10, 255, 255]] * 30
    assert seen.rgb[0, 24, 34:].tolist() == [[255, 255, 255]] * 30


def test_no_rays_are_no_hits(tmp_path):
    """As where nothing of the floor that is new to an agent lies in its picture, or nothing hides any of it."""
    sim, none = simulator(tmp_path, panes(HOLE)), np.zeros((0, 3))
    assert sim.distance(none, none).shape == (0,)
    assert sim.surface_below(none).shape == (0,)
    eye, ahead = np.array([[0.5, 1.25, 2.5]]), np.array([[1.0, 1.25, 2.5]])
    assert sim.reached(eye, ahead, np.zeros((0, 2), int), tolerance_m=0.1).shape == (0,)
    assert sim.reached(eye, ahead, np.array([[0, 0]]), tolerance_m=0.1).tolist() == [True]


def test_single_rays_agree_with_the_picture(tmp_path):
    sim = simulator(tmp_path, panes(HOLE))
    origin, east = np.array([[0.5, 1.25, 0.5], [0.5, 1.25, 2.5]]), np.tile([1.0, 0, 0], (2, 1))
    np.testing.assert_allclose(sim.distance(origin, east), [1.5, 3.5], atol=1e-3)
    pose = camera_to_world(origin, yaw=np.full(2, -np.pi / 2), pitch=np.zeros(2))
    points = origin + [3.0, 0, 0]
    pairs = np.array([[0, 0], [1, 1], [0, 1]])
    assert sim.reached(origin, points, pairs, tolerance_m=0.1).tolist() == [False, True, False]
    camera = Intrinsics.from_hfov(64, 48, hfov_deg=60)
    assert sim.visible(pose, camera, points, pairs[:2], tolerance_m=0.1).tolist() == [False, True]


def test_one_walks_through_the_hole_and_not_through_the_pane(tmp_path):
    area = simulator(tmp_path, panes(HOLE)).area
    assert area.contains(np.array([[1.0, 0, 1.0], [3.0, 0, 1.0]])).all()
    assert area.contains(np.array([[2.0, 0, 2.3]])).all()
    assert not area.contains(np.array([[2.0, 0, 0.7]])).any()


def test_a_floor_with_a_hole_lets_one_look_down(tmp_path):
    document = panes(HOLE)
    document.json["accessors"][2] |= {
        "bufferView": document.view(np.array([[0, 1, 0], [0, 1, 3], [4, 1, 3], [4, 1, 0]], "<f4").tobytes())
    }
    sim = simulator(tmp_path, document)
    np.testing.assert_allclose(sim.surface_below(np.array([[2.0, 2.0, 0.5], [2.0, 2.0, 2.5]])), [1, 0], atol=1e-3)


def test_many_layers_behind_each_other_are_passed(tmp_path):
    """Ten panes a millimetre apart, with the hole in the same place, and one that is whole there."""
    whole = HOLE.copy()
    whole[..., 3] = 255
    sim = simulator(tmp_path, panes(*[HOLE] * 10, whole, gap=0.001))
    origin = np.array([[0.5, 1.25, 2.5]])
    np.testing.assert_allclose(sim.distance(origin, np.array([[1.0, 0, 0]])), [1.51], atol=1e-4)


@pytest.mark.parametrize(
    ("document", "there"),
    [
        (panes(HOLE, alpha=0.0), False),
        (panes(HOLE[:, 4:]), False),
        (panes(HOLE[:, :4], alpha=0.4), False),
        (panes(HOLE[:, :4], alpha=0.4, alphaCutoff=0.3), True),
        (panes(HOLE[:, :4]), True),
        (panes(HOLE[:, 4:], alphaCutoff=0.0), True),
    ],
    ids=["factor", "picture", "factor below", "factor above its cutoff", "whole", "cutoff of nothing"],
)
def test_triangles_that_are_masked_as_a_whole_are_left_out_and_whole_ones_need_no_mask(tmp_path, document, there):
    mesh = load_scene(document.write(tmp_path)).mesh
    assert len(mesh.triangles) == (14 if there else 12)
    assert mesh.masks == []


def test_vertex_alpha_masks_as_well(tmp_path):
    document = panes(HOLE[:, :4])
    colours = np.array([[1, 1, 1, alpha] for alpha in (1, 1, 0.8, 0)], "<f4")
    document.json["meshes"][0]["primitives"][1]["attributes"]["COLOR_0"] = document.accessor(colours)
    # Means of the corners: 0.93 and 0.6.
    document.json["materials"][0]["alphaCutoff"] = 0.7
    assert len(load_scene(document.write(tmp_path)).mesh.triangles) == 13


def test_what_is_masked_altogether_is_no_scene(tmp_path):
    with pytest.raises(SceneError, match="expected a mesh with triangles, found none"):
        of_material(tmp_path, {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}})


@pytest.mark.parametrize("seed", range(3))
def test_any_mask_is_met_where_its_picture_says(tmp_path, seed):
    """Against the texel of each ray, with coordinates that repeat and lie below zero."""
    rng = np.random.default_rng(seed)
    pixels = np.full((16, 16, 4), 255, np.uint8)
    pixels[..., 3] = np.kron(rng.integers(0, 2, (4, 4)), np.ones((4, 4))) * 255
    document = panes(pixels)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * [2.6, 0.7] + rng.uniform(-3, 3, 2)
    document.json["accessors"][3] |= {"bufferView": document.view(uv.astype("<f4").tobytes())}
    sim = simulator(tmp_path, document)
    at = rng.uniform([0.1, 0.1], [HIGH - 0.1, DEEP - 0.1], (3000, 2))
    origin = np.column_stack([np.full(len(at), 0.5), at])
    distance = sim.distance(origin, np.tile([1.0, 0, 0], (len(at), 1)))
    share = np.column_stack([at[:, 1] / DEEP, 1 - at[:, 0] / HIGH]) * (uv[1] - uv[3] + [0, 0])
    exact = (share + uv[3]) * 16
    column, row = (np.floor(exact).astype(int) % 16).T
    clear = (np.abs(exact - np.round(exact)) > 1e-3).all(axis=1)
    np.testing.assert_allclose(distance[clear], np.where(pixels[row, column, 3] > 0, 1.5, 3.5)[clear], atol=1e-3)


def test_an_exported_scene_keeps_its_holes(tmp_path):
    mesh = load_scene(panes(HOLE, HOLE[:, :4]).write(tmp_path)).mesh
    export_glb(mesh, tmp_path / "again.glb")
    again = load_scene(str(tmp_path / "again.glb"))
    assert len(again.mesh.masks) == 1
    np.testing.assert_array_equal(
        look(RaycastSimulator(again)).depth, look(simulator(tmp_path, panes(HOLE, HOLE[:, :4]))).depth
    )


def mirrored() -> Gltf:
    return quad(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}])


def glowing() -> Gltf:
    return quad(materials=[{"emissiveFactor": [1, 0.5, 0]}])


@pytest.mark.parametrize(
    ("document", "rewritten"),
    [(quad(), False), (panes(HOLE), True), (mirrored(), True), (glowing(), True)],
    ids=["plain", "masked", "mirrored", "glowing"],
)
def test_habitat_is_given_what_it_would_not_show_rightly_in_a_form_that_it_does(tmp_path, document, rewritten):
    path = document.write(tmp_path)
    (tmp_path / "stage").mkdir()
    write_stage(locate(path), Frame(), tmp_path / "stage")
    asset = Path(json.loads((tmp_path / "stage/scene.stage_config.json").read_text())["render_asset"])
    assert asset == (tmp_path / "stage/room.glb" if rewritten else Path(path))
    assert len(load_scene(str(asset)).mesh.triangles) == len(load_scene(path).mesh.triangles)


def test_habitat_is_given_a_file_that_only_it_reads(tmp_path):
    path = quad(extensionsRequired=["KHR_texture_basisu"], materials=[{"alphaMode": "MASK"}]).write(tmp_path)
    write_stage(locate(path), Frame(), tmp_path)
    assert json.loads((tmp_path / "scene.stage_config.json").read_text())["render_asset"] == path
