"""Floors of rooms whose triangles are wound the wrong way round, as a whole or in part."""

from dataclasses import replace

import numpy as np
import pytest
from test_navigation import DEPTH, WALLS, WIDTH, area_of, box, caster, mesh_of, quad, reaches, room

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.navigation.build import build_area
from avp_habitat.scenes.builtin.room import generate_room
from avp_habitat.scenes.loader import Scene
from avp_habitat.simulators.raycast import RaycastSimulator

TABLE = box((1.0, 0.7, 1.0), (2.5, 0.75, 2.2))
FLOOR = quad((0, 0, 0), (0, 0, DEPTH), (WIDTH, 0, DEPTH), (WIDTH, 0, 0))


def turned(*parts):
    return [part[:, ::-1] for part in parts]


def storeys(*, below: bool, above: bool) -> list:
    """Two rooms, one 0.3 m above the other; each one wound the right way or not."""
    low, high = room(), room(floor=2.8)
    return [low if below else low[:, ::-1], high if above else high[:, ::-1]]


def same(area: NavigableArea, expected: NavigableArea) -> None:
    np.testing.assert_array_equal(area.mask, expected.mask)
    np.testing.assert_allclose(area.centres, expected.centres, atol=1e-6)
    assert area.area_m2 == pytest.approx(expected.area_m2)


ROOMS = {
    "empty": [room()],
    "furnished": [room(), TABLE, box((3.0, 0, 0.2), (3.6, 1.9, 1.2))],
    "without a ceiling": [room()[2:], TABLE],
    "without walls": [FLOOR],
    "one storey over another": storeys(below=True, above=True),
    "a ramp and a gallery": [
        room(8.0, 6.0, 5.0),
        quad((1.0, 0, 4.0), (1.0, 0, 5.0), (6.0, 2.4, 5.0), (6.0, 2.4, 4.0)),
        box((3.0, 2.2, 0.0), (6.0, 2.4, 4.0)),
    ],
    "a house with an attic": [room(), box((-0.2, -0.3, -0.2), (WIDTH + 0.2, 5.0, DEPTH + 0.2))],
}


@pytest.mark.parametrize("parts", ROOMS.values(), ids=ROOMS)
def test_a_scene_that_is_wound_the_wrong_way_round_has_the_same_floor(parts):
    same(area_of(*turned(*parts)), area_of(*parts))


@pytest.mark.parametrize("seed", [0, 3])
def test_a_generated_room_turned_inside_out_has_the_same_floor(seed):
    mesh = generate_room(seed)
    areas = [
        RaycastSimulator(Scene("room", "", each)).area
        for each in (mesh, replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1])))
    ]
    same(areas[1], areas[0])


@pytest.mark.parametrize("half", [(0, 1), (1, 0), (0, 0)])
def test_halves_that_are_wound_differently_are_one_floor(half):
    """As where an exporter has mirrored half of a scene and left the winding."""
    parts = [room(), room() + [WIDTH, 0, 0]]
    # Without the wall between them.
    parts = [parts[0][:-2], parts[1][[*range(8), *range(10, 12)]]]
    mixed = [part[:, ::-1] if flip else part for part, flip in zip(parts, half, strict=True)]
    area = area_of(*mixed)
    same(area, area_of(*parts))
    assert np.allclose(area.centres[:, 1], 0, atol=1e-6)
    assert reaches(area, 0.5, 1.5)
    assert reaches(area, 2 * WIDTH - 0.5, 1.5)


def test_tables_wound_the_wrong_way_round_stand_on_the_floor_as_others_do():
    same(area_of(room(), *turned(TABLE)), area_of(room(), TABLE))
    same(area_of(*turned(room()), TABLE), area_of(room(), TABLE))


@pytest.mark.parametrize(("below", "above"), [(True, True), (True, False), (False, True)])
def test_of_two_storeys_one_is_the_floor_and_no_ceiling(below, above):
    area = area_of(*storeys(below=below, above=above))
    assert set(np.round(area.centres[:, 1], 3)) <= {0.0, 2.8}
    assert area.mask.sum() == area_of(room()).mask.sum()


def test_a_ceiling_over_holes_of_the_floor_is_no_floor():
    """A scan lacks floor under furniture; the ceiling is then the lowest surface there."""
    hole = quad((0, 0, 0), (0, 0, DEPTH), (2.4, 0, DEPTH), (2.4, 0, 0))
    ceiling = room()[:2]
    area = area_of(WALLS, ceiling, hole, start=np.array([3.4, 2.5, 1.5]))
    np.testing.assert_allclose(area.centres[:, 1], 0, atol=1e-6)


def test_a_ceiling_below_a_roof_is_no_floor():
    """The attic is bounded by the backs of the ceiling and of the roof; nobody gets there."""
    parts = ROOMS["a house with an attic"]
    for start in (None, np.array([2.0, 2.45, 1.5])):
        np.testing.assert_allclose(area_of(*parts, start=start).centres[:, 1], 0, atol=1e-6)


def test_a_scene_of_walls_has_no_floor_whichever_way_they_are_wound():
    for part in (WALLS, WALLS[:, ::-1]):
        mesh = mesh_of(part)
        with pytest.raises(SceneError, match="no floor"):
            build_area(mesh, caster(mesh))
