"""Where agents can stand and how they move: analytic rooms, real rooms, and properties of motion."""

import itertools
import pickle
import subprocess
import sys
from functools import cache

import networkx
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.navigation.build import build_area
from avp_habitat.navigation.parts import _border_distance
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.scenes.mesh import TexturedMesh

WIDTH, HEIGHT, DEPTH = 4.2, 2.5, 3.1


# --- small meshes -----------------------------------------------------------------------------------------------------


def quad(a, b, c, d):
    return np.array([[a, b, c], [a, c, d]], np.float64)


def box(low, high):
    """The 12 triangles of a closed box, wound to face outwards."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = [
        quad((x0, y1, z0), (x0, y1, z1), (x1, y1, z1), (x1, y1, z0)),
        quad((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)),
        quad((x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)),
        quad((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)),
        quad((x0, y0, z0), (x0, y0, z1), (x0, y1, z1), (x0, y1, z0)),
        quad((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
    ]
    return np.concatenate(faces)


def room(width=WIDTH, height=HEIGHT, depth=DEPTH, floor=0.0):
    """A closed room that faces inwards."""
    return box((0, floor, 0), (width, floor + height, depth))[:, ::-1]


WALLS = room()[4:]


def mesh_of(*parts):
    corners = np.concatenate(parts).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    white = np.ones_like(corners)
    return TexturedMesh(corners, triangles, white[:, :2], white, np.full(len(triangles), -1, np.int32))


def caster(mesh):
    """Rays straight down, every point against every triangle."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    span = (b[:, 0] - a[:, 0]) * (c[:, 2] - a[:, 2]) - (c[:, 0] - a[:, 0]) * (b[:, 2] - a[:, 2])

    def surface_below(points):
        with np.errstate(divide="ignore", invalid="ignore"):
            x, z = points[:, None, 0] - a[:, 0], points[:, None, 2] - a[:, 2]
            v = (x * (c[:, 2] - a[:, 2]) - (c[:, 0] - a[:, 0]) * z) / span
            w = ((b[:, 0] - a[:, 0]) * z - x * (b[:, 2] - a[:, 2])) / span
            y = a[:, 1] + v * (b[:, 1] - a[:, 1]) + w * (c[:, 1] - a[:, 1])
            hit = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1 + 1e-9) & (y <= points[:, None, 1])
        return np.where(hit, y, -np.inf).max(axis=1)

    return surface_below


def area_of(*parts, **options):
    mesh = mesh_of(*parts)
    return build_area(mesh, caster(mesh), **options)


def reaches(area, x, z):
    return bool(area.contains(np.array([[x, 0.0, z]]))[0])


# --- where agents can stand -------------------------------------------------------------------------------------------


def test_empty_room_is_navigable_up_to_the_radius_and_two_voxels_from_its_walls():
    area = area_of(room())
    (x0, z0), (x1, z1) = area.rings[0].min(axis=0), area.rings[0].max(axis=0)
    gaps = [x0, z0, WIDTH - x1, DEPTH - z1]
    assert all(0.1 - 1e-6 <= gap <= 0.2 + 1e-6 for gap in gaps), gaps
    assert area.area_m2 == pytest.approx((x1 - x0) * (z1 - z0))
    assert area.mask.sum() * 0.01 == pytest.approx(area.area_m2, abs=0.1 * (x1 - x0 + z1 - z0))


def test_mask_rows_run_along_z_and_columns_along_x():
    area = area_of(room())
    rows, columns = np.nonzero(area.mask)
    assert np.ptp(columns) > np.ptp(rows)
    assert area.centres.shape == (area.mask.sum(), 3)
    np.testing.assert_array_equal(area.cell_of(area.centres), np.stack([rows, columns], axis=1))
    np.testing.assert_allclose(area.centres[:, 0], area.origin[0] + (columns + 0.5) * area.cell_m)
    assert area.contains(area.centres).all()


@pytest.mark.parametrize(("height", "taken"), [(0.15, True), (0.45, False)])
def test_low_step_is_taken_and_high_one_is_not(height, taken):
    area = area_of(room(), box((2.8, 0, 0), (WIDTH, height, DEPTH)))
    assert reaches(area, 0.5, 1.5)
    assert reaches(area, 3.6, 1.5) is taken


@pytest.mark.parametrize(("depth", "taken"), [(0.0, True), (0.15, False)])
def test_step_between_one_and_two_voxels_depends_on_where_voxels_begin_as_in_recast(depth, taken):
    """0.3 m are one or two voxels of 0.2 m, counted from the mesh's lowest point."""
    pit = box((-1.0, -depth, -1.0), (-0.9, 0.1, -0.9))
    area = area_of(room(), pit, box((2.8, 0, 0), (WIDTH, 0.3, DEPTH)))
    assert reaches(area, 3.6, 1.5) is taken


def test_agent_keeps_its_radius_from_a_ledge():
    stage = box((1.33, 0, 0), (WIDTH, 1.0, DEPTH))
    area = area_of(room(height=3.0), stage, start=np.array([3.0, 1.0, 1.5]))
    np.testing.assert_allclose(area.centres[:, 1], 1.0, atol=1e-6)
    assert 1.33 + 0.1 <= area.rings[0][:, 0].min() <= 1.33 + 0.2


@pytest.mark.parametrize(("climb", "taken"), [(0.2, False), (0.4, True)])
def test_low_hanging_sheet_is_stepped_onto_when_it_is_within_the_climb(climb, taken):
    sheet = quad((1.5, 0.5, 1.0), (3.0, 0.5, 1.0), (3.0, 0.5, 2.1), (1.5, 0.5, 2.1))
    area = area_of(room(), sheet, settings=NavigationSettings(max_climb_m=climb))
    assert reaches(area, 2.2, 1.5) is taken


def test_border_distance_is_the_chamfer_distance():
    shape = (17, 23)
    solid = np.random.default_rng(5).random(shape) < 0.06
    number = np.where(solid, -1, np.cumsum(~solid).reshape(shape) - 1)
    padded = np.pad(number, 1, constant_values=-1)
    beside = np.stack([padded[1:-1, :-2], padded[2:, 1:-1], padded[1:-1, 2:], padded[:-2, 1:-1]], axis=-1)[~solid]
    graph = networkx.Graph()
    for (row, column), (down, across) in itertools.product(np.ndindex(shape), [(0, 1), (1, 0), (1, 1), (1, -1)]):
        ends = padded[row + 1, column + 1], padded[row + 1 + down, column + 1 + across]
        if min(ends) >= 0:
            graph.add_edge(*ends, weight=3 if down and across else 2)
    borders = set(np.flatnonzero(beside.min(axis=1) < 0).tolist())
    expected = networkx.multi_source_dijkstra_path_length(graph, borders)
    distance = _border_distance(beside)
    np.testing.assert_array_equal(distance, [expected[i] for i in range(len(beside))])
    assert distance.max() > 3


def test_table_leaves_a_hole_and_its_surroundings():
    area = area_of(room(), box((1.2, 0, 0.9), (2.3, 0.75, 1.5)))
    assert len(area.rings) == 2
    assert not reaches(area, 1.7, 1.2)
    hole = area.rings[1]
    for axis, (low, high) in enumerate([(1.2, 2.3), (0.9, 1.5)]):
        assert low - 0.2 <= hole[:, axis].min() <= low - 0.05
        assert high + 0.05 <= hole[:, axis].max() <= high + 0.2


@pytest.mark.parametrize(("slope_deg", "taken"), [(30, True), (60, False)])
def test_gentle_ramp_is_walkable_and_steep_one_is_not(slope_deg, taken):
    length, rise = 6.0, 1.2
    start = 4.0 - rise / np.tan(np.radians(slope_deg))
    ramp = quad((start, 0, 0), (start, 0, DEPTH), (4.0, rise, DEPTH), (4.0, rise, 0))
    area = area_of(room(length, 4.0), ramp, box((4.0, 0, 0), (length, rise, DEPTH)), start=np.array([0.5, 0, 1.5]))
    assert reaches(area, 0.5, 1.5)
    assert reaches(area, 5.2, 1.5) is taken
    if taken:
        on_ramp = area.centres[(area.centres[:, 0] > start + 0.1) & (area.centres[:, 0] < 3.9)]
        expected = (on_ramp[:, 0] - start) * np.tan(np.radians(slope_deg))
        np.testing.assert_allclose(on_ramp[:, 1], expected, atol=1e-5)
        between = on_ramp + [0.03, 0, 0.02]
        np.testing.assert_allclose(
            area.floor_height(between[:1]), (between[:1, 0] - start) * np.tan(np.radians(30)), atol=1e-5
        )


@pytest.mark.parametrize(("underside", "blocks"), [(1.2, True), (1.9, False)])
def test_low_beam_blocks_and_high_one_does_not(underside, blocks):
    area = area_of(room(), box((2.5, underside, 0), (2.8, underside + 0.2, DEPTH)))
    assert reaches(area, 0.5, 1.5)
    assert reaches(area, 3.6, 1.5) is not blocks


@pytest.mark.parametrize(("gap", "joined"), [(0.8, True), (0.15, False)])
def test_door_joins_rooms_when_an_agent_fits_through(gap, joined):
    wall = [box((2.6, 0, 0), (2.7, HEIGHT, 1.3)), box((2.6, 0, 1.3 + gap), (2.7, HEIGHT, DEPTH))]
    area = area_of(room(), *wall)
    assert reaches(area, 0.5, 1.5)
    assert reaches(area, 3.6, 1.5) is joined


def test_wall_without_thickness_separates():
    sheet = quad((2.6, 0, 0), (2.6, HEIGHT, 0), (2.6, HEIGHT, DEPTH), (2.6, 0, DEPTH))
    area = area_of(room(), sheet)
    assert reaches(area, 0.5, 1.5)
    assert not reaches(area, 3.6, 1.5)


def test_start_selects_its_part_and_the_largest_is_taken_without_one():
    wall = box((2.6, 0, 0), (2.7, HEIGHT, DEPTH))
    assert reaches(area_of(room(), wall), 0.5, 1.5)
    small = area_of(room(), wall, start=np.array([3.5, 0.0, 1.5]))
    assert reaches(small, 3.6, 1.5)
    assert not reaches(small, 0.5, 1.5)


def test_roof_larger_than_the_furnished_floor_is_not_chosen():
    roof = box((-0.5, HEIGHT, -0.5), (WIDTH + 0.5, HEIGHT + 0.3, DEPTH + 0.5))
    area = area_of(room(), roof, box((2.0, 0, 0), (WIDTH, 1.0, DEPTH)))
    assert area.centres[:, 1].max() < 0.1
    assert reaches(area, 0.5, 1.5)


def test_backdrop_box_around_the_room_is_not_chosen():
    backdrop = box((-0.6, -0.6, -0.6), (WIDTH + 0.6, HEIGHT + 0.6, DEPTH + 0.6))[:, ::-1]
    area = area_of(room(), backdrop)
    assert reaches(area, 0.5, 1.5)
    assert not reaches(area, -0.3, 1.5)


def test_one_storey_is_kept_where_two_lie_over_each_other():
    """A gallery above a third of the hall, joined to it by a ramp along one side."""
    hall = room(8.0, 6.0, 5.0)
    ramp = quad((1.0, 0, 4.0), (1.0, 0, 5.0), (6.0, 2.4, 5.0), (6.0, 2.4, 4.0))
    gallery = box((3.0, 2.2, 0.0), (6.0, 2.4, 4.0))
    landing = box((6.0, 2.2, 0.0), (8.0, 2.4, 5.0))
    area = area_of(hall, ramp, gallery, landing)
    assert reaches(area, 2.0, 2.0)
    for heights, mask in ((area.heights, area.mask), (area.heights.T, area.mask.T)):
        assert np.abs(np.diff(heights, axis=1))[mask[:, 1:] & mask[:, :-1]].max() < 0.4


def test_floor_height_is_the_meshs_not_the_voxels():
    pit = box((-1.0, -0.31, -1.0), (-0.9, 0.1, -0.9))
    area = area_of(room(floor=0.137), pit)
    np.testing.assert_allclose(area.centres[:, 1], 0.137, atol=1e-6)
    points = area.random_points(np.random.default_rng(3), 200)
    np.testing.assert_allclose(points[:, 1], 0.137, atol=1e-6)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([WALLS], r"no floor.*Z-up"),
        ([room(height=1.2)], r"ceiling lower than 1\.5 m"),
        ([room(0.05, 0.03, 0.04)], r"not in metres"),
        ([room(42000, 2500, 31000)], r"measures 42000 x 2500 x 31000 m .* millimetres"),
        ([room(3e38, 3e38, 3e38)], r"measures 3e\+38 x .* expected at most 100000 m²"),
        ([room(4, 3e38, 3)], r"measures 4 x 3e\+38 x 3 m"),
        ([room(3e38, 2.5, 1e-38)], r"measures 3e\+38 x 2\.5 x "),
    ],
)
def test_mesh_without_room_for_an_agent_says_why(parts, message):
    with pytest.raises(SceneError, match=message):
        area_of(*parts)


def test_mesh_without_triangles_or_with_nan_is_refused():
    mesh = mesh_of(room())
    empty = TexturedMesh(mesh.vertices, mesh.triangles[:0], mesh.uv, mesh.colours, mesh.texture_index[:0])
    with pytest.raises(SceneError, match="no triangles"):
        build_area(empty, caster(mesh))
    mesh.vertices[3, 1] = np.nan
    with pytest.raises(SceneError, match="NaN"):
        build_area(mesh, caster(mesh))


# Outlines that Recast 1.6.0 (the version in Habitat-Sim 0.3.4) makes of the real rooms with Habitat-Sim's settings, in
# voxels of 0.05 m from the mesh's least corner. Their surface on Recast's own height samples is 27.4 and 14.4 m².
RECAST = {
    "white_room": """
        24,33 24,46 27,46 28,49 32,51 32,74 30,75 28,75 27,78 23,78 23,91 17,92 17,163 121,163 121,99 120,70 118,70
        117,75 97,75 95,74 95,63 96,48 117,48 119,53 119,64 121,63 121,51 119,50 119,45 114,45 111,42 111,35 113,33
        99,33 98,28 84,20 67,18 52,20 38,28 36,33
        / 49,105 48,84 49,82 92,83 92,104 87,106 / 61,71 60,65 60,57 68,56 88,56 89,63 88,71
        / 67,51 59,50 59,29 69,27 81,27 86,29 86,50""",
    "grey_white_room": """
        18,27 18,41 25,42 25,65 18,66 18,80 24,80 25,82 30,83 33,79 42,79 46,83 47,79 72,79 74,83 80,78 86,78 90,83
        122,82 122,15 83,16 83,28 77,30 73,27 72,22 53,22 48,20 50,26 47,27 46,30 41,30 38,28 38,16 34,15 25,15 25,26
        / 62,49 63,41 68,36 75,35 80,36 84,40 85,47 85,52 81,57 67,57""",
}


@pytest.mark.parametrize(("name", "square_metres"), [("white_room", 27.4), ("grey_white_room", 14.4)])
def test_real_room_agrees_with_recast(shared, name, square_metres):
    from avp_habitat.scenes.loader import load_scene
    from avp_habitat.simulators.raycast import RaycastSimulator

    simulator = RaycastSimulator(load_scene(str(shared / "scenes" / f"{name}.glb")))
    area = simulator.area
    assert area.area_m2 == pytest.approx(square_metres, rel=0.03)
    rings = [np.array([pair.split(",") for pair in ring.split()], float) for ring in RECAST[name].split("/")]
    rings = [ring * 0.05 + area.origin + 0.025 for ring in rings]
    recast = shapely.Polygon(rings[0], rings[1:])
    own = shapely.Polygon(area.rings[0], area.rings[1:])
    assert recast.intersection(own).area / recast.union(own).area > 0.975
    rows, columns = np.indices(area.mask.shape)
    x, z = (area.origin[axis] + (index + 0.5) * 0.1 for axis, index in enumerate((columns, rows)))
    mask = shapely.contains_xy(recast, x, z)
    assert (mask & area.mask).sum() / (mask | area.mask).sum() > 0.97


# --- motion on a plane with corners of every kind ---------------------------------------------------------------------

L_SHAPE = np.array([[0, 0], [5, 0], [6.5, 1.5], [6.5, 3], [3, 3], [3, 5.5], [1.2, 6.1], [0, 4]], float)
PILLAR = np.array([[1.0, 1.0], [1.0, 2.2], [1.7, 1.9], [2.2, 1.0]])
BLADE = np.array([[4.0, 1.5], [5.2, 1.9], [5.2, 1.88]])


@cache
def plane():
    cell, rows, columns = 0.1, 62, 66
    x, z = (np.arange(columns) + 0.53) * cell, (np.arange(rows) + 0.53) * cell
    mask = shapely.contains_xy(polygon(), *np.meshgrid(x, z))
    heights = np.full(mask.shape, 0.37)
    return NavigableArea(cell, np.array([0.003, 0.003]), mask, heights, (L_SHAPE, PILLAR, BLADE))


def polygon():
    return shapely.Polygon(L_SHAPE, [PILLAR, BLADE])


def on_floor(*points):
    return np.array([[x, 0.37, z] for x, z in points])


def start_points(count=400):
    return plane().random_points(np.random.default_rng(7), count)


def on_plane(*points):
    return [tuple(point) for some in points for point in some[:, [0, 2]].tolist()]


@cache
def visibility_graph():
    """Every corner of the polygon joined to those that it sees, by shapely's own geometry."""
    inside = polygon().buffer(1e-7)
    shapely.prepare(inside)
    graph = networkx.Graph()
    corners = [tuple(corner) for ring in (L_SHAPE, PILLAR, BLADE) for corner in ring]
    for a, b in itertools.combinations(corners, 2):
        if inside.covers(shapely.LineString([a, b])):
            graph.add_edge(a, b, weight=np.hypot(a[0] - b[0], a[1] - b[1]))
    return graph, inside, corners


def shortest(start, goal):
    """Length of the shortest walk from one point (x, z) to another."""
    graph, inside, corners = visibility_graph()
    graph = graph.copy()
    for a in (start, goal):
        for b in [*corners, start]:
            if a != b and inside.covers(shapely.LineString([a, b])):
                graph.add_edge(a, b, weight=np.hypot(a[0] - b[0], a[1] - b[1]))
    return networkx.dijkstra_path_length(graph, start, goal)


moves = st.tuples(st.floats(0, 2 * np.pi), st.sampled_from([0.01, 0.25, 0.25, 2.0, 30.0, 1e4]))


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 399), st.lists(moves, min_size=1, max_size=8))
def test_agents_never_leave_the_area_nor_jump_through_obstacles(index, steps):
    area, at = plane(), start_points()[index : index + 1]
    for angle, length in steps:
        to = area.slide(at, np.array([[length * np.cos(angle), 0.0, length * np.sin(angle)]]))
        assert area.contains(to).all()
        if length < 10:
            assert shortest(*on_plane(at, to)) <= length + 0.01
        at = to


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 399), moves)
def test_free_move_is_exact(index, move):
    area, at = plane(), start_points()[index : index + 1]
    angle, length = move
    step = np.array([[length * np.cos(angle), 0.0, length * np.sin(angle)]])
    way = shapely.LineString([at[0, [0, 2]], (at + step)[0, [0, 2]]])
    if polygon().buffer(-0.001).contains(way):
        np.testing.assert_allclose(area.slide(at, step), at + step, rtol=0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.2, 2.5), st.floats(0.02, 0.3), st.floats(-0.5, 0.5))
def test_component_along_a_wall_is_kept(along, into, sideways):
    """The diagonal from (5, 0) to (6.5, 1.5): its direction is (1, 1), its inside (-1, 1)."""
    area = plane()
    wall, inner = np.array([1.0, 1.0]) / np.sqrt(2), np.array([-1.0, 1.0]) / np.sqrt(2)
    along = 0.6 + along * 0.3
    begin = np.array([5.0, 0.0]) + along * wall + 0.05 * inner
    move = sideways * wall - (0.05 + into) * inner
    end = area.slide(on_floor(begin), on_floor(move))[0, [0, 2]]
    assert (end - begin) @ wall == pytest.approx(sideways, abs=1e-8)
    assert 0 < (end - [5.0, 0.0]) @ inner < 0.001


@pytest.mark.parametrize("corner", [*PILLAR.tolist(), *BLADE.tolist(), [3.0, 3.0]])
def test_aiming_exactly_at_a_corner_leads_around_it_not_into_the_obstacle(corner):
    area = plane()
    angles = np.linspace(0, 2 * np.pi, 721)
    ring = np.array(corner) - 0.25 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for shift in (0.0, 3e-5, -3e-5):
        aside = shift * np.stack([-np.sin(angles), np.cos(angles)], axis=1)
        begin = on_floor(*(ring + aside))
        begin, towards = (values[area.contains(begin)] for values in (begin, on_floor(*(np.array(corner) - ring))))
        towards[:, 1] = 0
        ends = area.slide(begin, 2 * towards)
        assert area.contains(ends).all()
        for start, end in zip(on_plane(begin[::9]), on_plane(ends[::9]), strict=True):
            assert shortest(start, end) < 0.51


def test_zero_displacement_changes_nothing():
    points = start_points()
    np.testing.assert_array_equal(plane().slide(points, np.zeros_like(points)), points)


@pytest.mark.parametrize("length", [1e-3, 1e-9, 1e-15, 1e-30, 1e-160, 1e-170, 1e-300])
def test_displacements_of_any_smallness_towards_a_corner_are_moves(length):
    # Contacts in a corner leave 1e-17 of a displacement each time: after ten its square is 0, by which none may divide.
    area = plane()
    corner = np.array(PILLAR[0])
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    around = corner + 0.001 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    begin = on_floor(*around)
    begin = begin[area.contains(begin)]
    towards = np.zeros_like(begin)
    towards[:, [0, 2]] = length * (corner - begin[:, [0, 2]])
    end = area.slide(begin, towards)
    assert area.contains(end).all()
    assert np.linalg.norm(end - begin, axis=1).max() <= length


def test_agent_in_a_concave_corner_stays_and_can_leave():
    area = plane()
    corner = area.slide(on_floor((0.3, 0.4)), np.array([[-5.0, 0.0, -4.0]]))
    assert np.abs(corner[0, [0, 2]]).max() < 0.001
    np.testing.assert_array_equal(area.slide(corner, np.array([[-1.0, 0.0, -0.7]])), corner)
    step = np.array([[0.2, 0.0, 0.15]])
    np.testing.assert_allclose(area.slide(corner, step), corner + step, atol=1e-12)


def test_agent_at_a_wall_can_leave_and_walk_along_it():
    area = plane()
    at = area.slide(on_floor((2.0, 0.5)), np.array([[0.0, 0.0, -1.0]]))
    for step in ([0.1, 0.0, 0.2], [-0.4, 0.0, 0.0], [0.3, 0.0, 0.0]):
        np.testing.assert_allclose(area.slide(at, np.array([step])), at + step, atol=1e-12)


def test_move_across_a_thin_blade_slides_along_it():
    start, step = np.array([5.0, 1.2]), np.array([0.0, 0.9])
    end = plane().slide(on_floor(start), np.array([[*step, 0.0]])[:, [0, 2, 1]])[0, [0, 2]]
    near_side = shapely.LineString(BLADE[[0, 2]])
    assert shapely.distance(near_side, shapely.Point(end)) < 0.001
    assert end[0] > 5.02
    assert end[1] < np.interp(end[0], BLADE[[0, 2], 0], BLADE[[0, 2], 1])


def test_many_agents_move_as_each_alone():
    area, points = plane(), start_points()
    angles = np.linspace(0, 40, len(points))
    steps = np.stack([1.5 * np.cos(angles), np.zeros_like(angles), 1.5 * np.sin(angles)], axis=1)
    together = area.slide(points, steps)
    alone = np.concatenate([area.slide(points[i : i + 1], steps[i : i + 1]) for i in range(len(points))])
    np.testing.assert_array_equal(together, alone)


def test_agents_outside_or_not_finite_are_refused():
    with pytest.raises(ValueError, match=r"1 of 2 are outside, the first at x, z = \[9\. 9\.\]"):
        plane().slide(on_floor((0.5, 0.5), (9.0, 9.0)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="NaN"):
        plane().slide(on_floor((0.5, 0.5)), np.full((1, 3), np.nan))


def test_agent_exactly_on_a_wall_is_taken_inside():
    end = plane().slide(on_floor((2.0, 0.0), (5.5, 0.5)), np.array([[0.1, 0.0, 0.1], [0.0, 0.0, 0.2]]))
    assert plane().contains(end).all()


def test_random_points_are_inside_and_uniform():
    area = plane()
    points = area.random_points(np.random.default_rng(1), 20_000)
    assert area.contains(points).all()
    np.testing.assert_array_equal(points, area.random_points(np.random.default_rng(1), 20_000))
    for window in (shapely.box(0, 0, 3, 3), shapely.box(4, 0, 7, 3), shapely.box(0, 3, 1.5, 7)):
        share = polygon().intersection(window).area / polygon().area
        found = shapely.contains_xy(window, points[:, 0], points[:, 2]).mean()
        assert found == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / len(points)))


def test_area_is_that_of_the_outline():
    assert plane().area_m2 == pytest.approx(polygon().area)


def test_diameter_is_the_greatest_distance_between_cells():
    centres = plane().centres[:, [0, 2]]
    expected = max(np.hypot(*(centres - centre).T).max() for centre in centres)
    assert plane().diameter_m == pytest.approx(expected)


def test_area_survives_pickling_after_use():
    area = plane()
    again = pickle.loads(pickle.dumps(area))
    points = start_points()[:20]
    np.testing.assert_array_equal(again.mask, area.mask)
    np.testing.assert_array_equal(again.slide(points, points), area.slide(points, points))


def test_importing_the_area_brings_no_compiler_nor_geometry_library():
    code = (
        "import sys, avp_habitat.navigation.area; print([m for m in ('numba', 'shapely', 'scipy') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
