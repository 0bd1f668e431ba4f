"""`.navmesh` files, written here byte by byte after Detour's own structures (DetourNavMesh.h, version 7)."""

import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from avp_habitat.errors import SceneError
from avp_habitat.navigation.navmesh import read_navmesh
from avp_habitat.scenes.loader import load_scene
from avp_habitat.sight.tables import scene_tables
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.settings import TaskSettings

AGENT = {"agent_height": 1.5, "agent_radius": 0.1, "agent_max_climb": 0.2, "agent_max_slope": 45.0}
# Two squares that share an edge at x = 1, seen from above with z downwards, and one apart.
VERTICES = [
    (0, 0, 0),
    (1, 0, 0),
    (1, 0, 1),
    (0, 0, 1),
    (2, 0, 0),
    (2, 0, 1),
    (5, 1, 0),
    (6, 1, 0),
    (6, 1, 1),
    (5, 1, 1),
]
POLYGONS = [(0, 3, 2, 1), (1, 2, 5, 4), (6, 9, 8, 7)]
BESIDE = [(0, 0, 2, 0), (1, 0, 0, 0), (0, 0, 0, 0)]


def navmesh(*, vertices=VERTICES, polygons=POLYGONS, beside=BESIDE, agent=AGENT, tiles=1, version=2, flags=None):
    """Content of a file; every polygon is a fan of triangles, the first one with a detail vertex in its middle."""
    flags = flags or [1] * len(polygons)
    middle = np.mean([vertices[corner % len(vertices)] for corner in polygons[0]], axis=0)
    fans = [[(4, corner, (corner + 1) % 4) for corner in range(4)]]
    fans += [[(0, corner, corner + 1) for corner in range(1, len(polygon) - 1)] for polygon in polygons[1:]]
    details, triangles = b"", b""
    for number, fan in enumerate(fans):
        details += struct.pack("<IIBB2x", int(number > 0), len(triangles) // 4, int(number == 0), len(fan))
        triangles += b"".join(struct.pack("<4B", *corners, 0) for corners in fan)
    body = struct.pack("<4si3iI", b"VAND", 7, 0, 0, 0, 0)
    body += struct.pack(
        "<9i", len(polygons), len(vertices), 2, len(polygons), 1, len(triangles) // 4, 0, 0, len(polygons)
    )
    body += struct.pack("<10f", 1.5, 0.1, 0.2, 0, 0, 0, 6, 1, 1, 20)
    body += b"".join(struct.pack("<3f", *vertex) for vertex in vertices)
    for polygon, neighbours, flag in zip(polygons, beside, flags, strict=True):
        corners, around = ([*row, 0, 0, 0][:6] for row in (polygon, neighbours))
        body += struct.pack("<I6H6HHBB", 0xFFFFFFFF, *corners, *around, flag, len(polygon), 0)
    body += bytes(2 * 12) + details + struct.pack("<3f", *middle) + triangles
    head = struct.pack("<4siif4fii", b"TESM", version, tiles, 0, 0, 0, 6, 1, 1, 8)
    if version == 2:
        names = ("agent_height", "agent_radius", "agent_max_climb", "agent_max_slope")
        head += struct.pack("<13f4?", 0.05, 0.2, *(agent[name] for name in names), *([1.0] * 7), *([True] * 4))
    return head + struct.pack("<Ii", 1, len(body)) + body


def written(folder, **options):
    path = folder / "room.navmesh"
    path.write_bytes(navmesh(**options))
    return path


def area(triangles):
    return (
        np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum() / 2
    )


def test_islands_and_agent_are_read(tmp_path):
    found = read_navmesh(written(tmp_path))
    assert found.agent == pytest.approx(AGENT)
    assert [len(island) for island in found.islands] == [6, 2]
    assert [area(island) for island in found.islands] == pytest.approx([2, 1])
    np.testing.assert_allclose(found.islands[0].reshape(-1, 3).max(axis=0), [2, 0, 1])
    assert [0.5, 0, 0.5] in found.islands[0].reshape(-1, 3).tolist(), "expected the detail vertex in the middle"
    np.testing.assert_allclose(found.islands[1][..., 1], 1)


def test_polygons_that_are_not_beside_each_other_are_islands_of_their_own(tmp_path):
    assert len(read_navmesh(written(tmp_path, beside=[(0, 0, 0, 0)] * 3)).islands) == 3


def test_switched_off_polygons_are_left_out(tmp_path):
    found = read_navmesh(written(tmp_path, flags=[1, 1, 0]))
    assert [area(island) for island in found.islands] == pytest.approx([2])


def test_the_first_version_says_nothing_of_its_agent(tmp_path):
    found = read_navmesh(written(tmp_path, version=1))
    assert found.agent == {}
    assert len(found.islands) == 2


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (navmesh(tiles=3), "it does not begin as one of a single tile"),
        (navmesh(version=4), "it does not begin as one of a single tile"),
        (navmesh(vertices=[*VERTICES[:9], (float("nan"), 0, 0)]), "a position cannot be right"),
        (navmesh() + b" ", r"its tile has \d+ bytes where \d+ are said"),
        (navmesh(polygons=[(0, 3, 2, 99), *POLYGONS[1:]]), "index 99 is out of bounds .*"),
        (navmesh(beside=[(0, 0, 9, 0), *BESIDE[1:]]), ".* index .*"),
    ],
)
def test_what_cannot_be_right_is_named(tmp_path, content, reason):
    path = tmp_path / "room.navmesh"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=rf"^{path}: expected a NavMesh .*, but {reason}; is it damaged\?$"):
        read_navmesh(path)


def test_a_cut_file_is_named_at_every_length(tmp_path):
    path, content = tmp_path / "room.navmesh", navmesh()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(SceneError, match="expected a NavMesh"):
            read_navmesh(path)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.integers(0, len(navmesh()) - 1), value=st.integers(0, 255))
def test_a_wrong_byte_is_an_error_of_ours_or_harmless(tmp_path, place, value):
    content = bytearray(navmesh())
    content[place] = value
    path = tmp_path / "room.navmesh"
    path.write_bytes(content)
    try:
        found = read_navmesh(path)
    except SceneError:
        return
    assert all(island.shape[1:] == (3, 3) and np.isfinite(island).all() for island in found.islands)


def floor_of(simulator, shift=0.0):
    """One square of floor in the middle of a room's area, as the file's vertices and polygons."""
    r = 0.3
    around = np.array([(x, 0, z) for x in (-r, 0, r) for z in (-r, 0, r)])
    free = [simulator.area.contains(centre + around).all() for centre in simulator.area.centres]
    x, y, z = simulator.area.centres[np.argmax(free)] + [shift, 0.15, 0]
    vertices = [(x - r, y, z - r), (x + r, y, z - r), (x + r, y, z + r), (x - r, y, z + r)]
    return {"vertices": vertices, "polygons": [(0, 3, 2, 1)], "beside": [(0, 0, 0, 0)]}


def test_the_ray_caster_walks_where_the_file_says_on_the_scenes_own_floor(tmp_path):
    own = RaycastSimulator(load_scene("builtin:0"))
    path = written(tmp_path, **floor_of(own))
    given_one = make_simulator("raycast", "builtin:0", navmesh=path)
    assert given_one.area.area_m2 == pytest.approx(0.36, abs=0.001)
    assert own.area.contains(given_one.area.centres).all()
    np.testing.assert_allclose(given_one.area.centres[:, 1], own.area.floor_height(given_one.area.centres), atol=0.03)
    assert make_simulator("raycast", "builtin:0") is not given_one
    # Tables on disk are of the cells that there are.
    own_tables, other_tables = (scene_tables(each, TaskSettings(lookup=True)) for each in (own, given_one))
    assert own_tables.name != other_tables.name


def test_a_file_of_another_scene_is_refused(tmp_path):
    path = written(tmp_path, **floor_of(RaycastSimulator(load_scene("builtin:0")), shift=30.0))
    with pytest.raises(SceneError, match=rf"^{path}: is this the NavMesh of another scene\?"):
        _ = make_simulator("raycast", "builtin:0", navmesh=path).area


def test_a_file_for_another_agent_is_taken_with_a_warning(tmp_path):
    path = written(tmp_path, **floor_of(RaycastSimulator(load_scene("builtin:0"))), agent=AGENT | {"agent_radius": 0.4})
    simulator = make_simulator("raycast", "builtin:0", navmesh=path)
    with pytest.warns(UserWarning, match=r"made for another agent.*agent_radius 0\.4 \(ours: 0\.1\)"):
        _ = simulator.area
