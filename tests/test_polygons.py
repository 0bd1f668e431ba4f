"""Polygons that are not convex, as modelling programs write them: they cover what they should, and nothing else."""

import numpy as np
import pytest
from test_scene_placing import box

from avp_habitat.errors import SceneError
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.mesh import triangulate
from avp_habitat.simulators.registry import make_simulator

WITH_DOOR = [(0, 0), (2, 0), (2, 2), (3, 2), (3, 0), (5, 0), (5, 2.6), (0, 2.6)]
# A bridge to the window's corner and back, as a hole is written.
WITH_WINDOW = [(0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1), (0, 0), (5, 0), (5, 2.6), (0, 2.6)]
DART = [(0, 0), (2, 1), (0, 2), (0.5, 1)]


def star(corners, seed=0):
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(0, 0.9, corners)) / corners
    return rng.uniform(0.2, 1, corners)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def normals(points):
    points = points - points[..., :1, :]
    return np.cross(points, np.roll(points, -1, axis=-2)).sum(axis=-2) / 2


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("flat", [WITH_DOOR, WITH_WINDOW, DART, star(9), star(40)])
def test_triangles_tile_a_polygon_from_whichever_corner_it_begins(flat, backwards):
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for first in range(len(flat)):
        points = np.roll(np.array(flat, float), first, axis=0)[:: -1 if backwards else 1]
        points = np.pad(points, ((0, 0), (0, 1))) @ turned.T + 100
        places, _ = triangulate(np.array([len(flat)]), np.arange(len(flat)), points)
        whole, pieces = normals(points), normals(points[places])
        assert (pieces @ whole >= -1e-9).all()
        assert np.sqrt((pieces**2).sum(axis=1)).sum() == pytest.approx(np.sqrt((whole**2).sum()))


def test_convex_polygons_are_fans_among_others():
    square, triangle = [(0, 0), (1, 0), (1, 1), (0, 1)], [(5, 5), (6, 5), (5, 6)]
    points = np.pad(np.array([*square, *DART, *triangle, *square], float), ((0, 0), (0, 1)))
    places, polygons = triangulate(np.array([4, 4, 3, 4]), np.arange(15), points)
    assert places.tolist() == [[0, 1, 2], [0, 2, 3], [7, 4, 5], [5, 6, 7], [8, 9, 10], [11, 12, 13], [11, 13, 14]]
    assert polygons.tolist() == [0, 0, 1, 1, 2, 3, 3]


def two_rooms():
    wall = np.array([(y, z) for z, y in WITH_DOOR], float)
    sides = [np.insert(wall[::step], 0, x, axis=1) for x, step in ((4, 1), (4.15, -1))]
    return [*box((0, 0, 0), (8, 2.6, 5), inward=True), *sides]


def write(path, polygons):
    points = np.concatenate(polygons)
    ends = np.cumsum([len(each) for each in polygons])
    faces = [range(end - len(each), end) for each, end in zip(polygons, ends, strict=True)]
    if path.suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in points]
        lines += ["f " + " ".join(str(each + 1) for each in face) for face in faces]
    else:
        lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        lines += [f"property float {name}" for name in "xyz"] + [f"element face {len(faces)}"]
        lines += ["property list uchar int vertex_indices", "end_header"]
        lines += [f"{x} {y} {z}" for x, y, z in points]
        lines += [f"{len(face)} " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_a_wall_of_one_polygon_leaves_its_door_open(tmp_path, suffix):
    # Both rooms, and the door between them.
    area = make_simulator("raycast", write(tmp_path / f"a{suffix}", two_rooms())).area
    assert area.area_m2 == pytest.approx(34.7, abs=0.3)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_what_would_take_minutes_is_refused(tmp_path, suffix):
    polygons = [*two_rooms(), np.pad(star(2001), ((0, 0), (0, 1)))]
    with pytest.raises(SceneError, match=r"polygon 9 is not convex and has 2001 corners; expected 2000 at most"):
        load_scene(write(tmp_path / f"a{suffix}", polygons))
