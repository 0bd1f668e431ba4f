import hashlib
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from test_builtin_rooms import printed_elsewhere

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.builtin.home import home
from avp_habitat.scenes.builtin.home.cells import plan_cells
from avp_habitat.scenes.builtin.home.home import generate_home, plan_furnished
from avp_habitat.scenes.builtin.home.plan import plan_home
from avp_habitat.scenes.builtin.kit import FLAT_M
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.loader import Scene, identify, load_scene
from avp_habitat.scenes.location import locate
from avp_habitat.scenes.mesh import TexturedMesh, merge
from avp_habitat.simulators.raycast import RaycastSimulator

FEW = (5, 7)
"""Two rooms, five rooms with a corridor that ends in the living room."""
MANY = range(150)


@cache
def furnished(seed):
    rooms, _, placed = plan_furnished(seed)
    return rooms, placed


@cache
def mesh_of(seed):
    return generate_home(seed)


@cache
def simulator(seed):
    return RaycastSimulator(Scene("test", "0", mesh_of(seed)))


def digest(mesh):
    parts = [mesh.vertices, mesh.triangles, mesh.uv, mesh.colours, mesh.texture_index, *mesh.textures]
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


@cache
def empty_home(seed):
    """The first plan of rooms that came to something, and how many were made."""
    count = 2 + seed % 5
    plans = ((attempt, plan_home(Random(seed, attempt), count)) for attempt in range(1, 40))
    return next((rooms, attempt) for attempt, rooms in plans if rooms is not None)


def standing_in(shell, points):
    x0, z0, x1, z1 = shell.bounds
    return points[(points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 2] > z0) & (points[:, 2] < z1)]


def test_another_process_makes_the_same_home():
    code = "from test_builtin_homes import digest, generate_home; print(digest(generate_home(5)))"
    assert printed_elsewhere(code) == digest(mesh_of(5))


def test_seed_5_is_still_the_home_of_its_version():
    """A failure here means: raise HOME_VERSION, then write down the new home."""
    rooms, placed = furnished(5)
    assert home.HOME_VERSION == 2
    assert [(room.use, room.shell.bounds, room.shell.ceiling) for room in rooms] == [
        ("living", (-2.38, -0.01, 2.38, 3.63), 3.05),
        ("bedroom", (-2.38, -3.63, 2.38, -0.13), 2.49),
    ]
    assert sorted(stand.piece.kind for stand in placed[1]) == [
        "basket",
        "bed",
        "boxes",
        "clock",
        "drawers",
        "picture",
        "picture",
        "picture",
        "picture",
        "plant",
        "rug",
        "side table",
        "wardrobe",
    ]


def test_homes_have_two_to_six_rooms_of_30_to_150_square_metres_under_ceilings_of_different_heights():
    areas, tries = [], 0
    for seed in MANY:
        rooms, attempt = empty_home(seed)
        tries += attempt
        areas.append(sum(room.shell.floor_area for room in rooms))
        assert sum(room.use != "corridor" for room in rooms) == 2 + seed % 5
        assert len({room.shell.ceiling for room in rooms}) >= 2
        assert all(2.3 <= room.shell.ceiling <= 3.4 for room in rooms)
    assert tries < 2 * len(MANY)
    assert min(areas) >= 30
    assert max(areas) <= 150
    counts, _ = np.histogram(areas, bins=(30, 50, 70, 90, 110, 150))
    assert (counts > len(MANY) / 20).all()
    with_corridor = sum(any(room.use == "corridor" for room in empty_home(seed)[0]) for seed in MANY)
    assert 0.3 < with_corridor / len(MANY) < 0.8


def test_rooms_tile_the_outline_without_meeting():
    for seed in range(100):
        cells = next(filter(None, (plan_cells(Random(seed, attempt), 2 + seed % 5) for attempt in range(40))))
        boxes = np.array([cell.area for cell in cells])
        low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
        high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
        shared = np.clip(high - low, 0, None).prod(axis=2)
        np.testing.assert_allclose(shared, np.diag(shared.diagonal()), atol=1e-9)


def test_each_doorway_is_in_both_walls_wide_and_high_enough_and_leads_to_every_room():
    for seed in MANY:
        rooms, _ = empty_home(seed)
        ends = []
        for index, room in enumerate(rooms):
            for hole in (hole for hole in room.shell.openings if hole.kind == "passage"):
                wall = room.shell.walls[hole.wall]
                assert 0.8 - 1e-9 <= hole.right - hole.left <= 1.0 + 1e-9
                assert hole.top >= 2
                assert hole.left > 0.1
                assert hole.right < wall.length - 0.1
                ends.append((index, hole, np.array(wall.point((hole.left + hole.right) / 2, -0.06))))
        part = list(range(len(rooms)))
        for index, hole, middle in ends:
            (other,) = [
                (each, theirs)
                for each, theirs, there in ends
                if each != index and np.abs(there - middle).max() < 1e-6 and theirs.top == hole.top
            ]
            part = [part[index] if each == part[other[0]] else each for each in part]
        assert len(set(part)) == 1


def check_walkable(rooms, sim):
    area = sim.area
    floor = sum(room.shell.floor_area for room in rooms)
    assert area.area_m2 / floor >= 0.55
    heights = area.heights[area.mask]
    assert heights.min() > -0.001
    assert heights.max() < 0.02
    for room in rooms:
        assert len(standing_in(room.shell, area.centres)) * area.cell_m**2 > 0.3 * room.shell.floor_area, room.use


@pytest.mark.parametrize("seed", FEW)
def test_one_connected_part_of_the_floor_reaches_into_every_room(seed):
    check_walkable(furnished(seed)[0], simulator(seed))


def test_a_doorway_that_is_closed_would_be_found():
    shell = furnished(5)[0][0].shell
    (hole,) = [each for each in shell.openings if each.kind == "passage"]
    wall, middle = shell.walls[hole.wall], (hole.left + hole.right) / 2
    corners = np.array([wall.point(middle + x, z) for x in (-0.6, 0.6) for z in (-0.03, -0.09)])
    vertices = np.array([[x, y, z] for x, z in corners for y in (0.0, 2.2)], np.float32)
    lid = np.array([[0, 1, 5], [0, 5, 4], [2, 7, 3], [2, 6, 7], [1, 3, 7], [1, 7, 5]], np.int32)
    none = np.full(len(lid), -1, np.int32)
    shut = TexturedMesh(vertices, lid, np.zeros((8, 2), np.float32), np.ones((8, 3), np.float32), none)
    with pytest.raises(AssertionError):
        check_walkable(furnished(5)[0], RaycastSimulator(Scene("test", "0", merge([mesh_of(5), shut]))))


@pytest.mark.parametrize("seed", range(5))
def test_furniture_keeps_to_its_place_in_its_room(seed):
    for room, placed in zip(*furnished(seed), strict=True):
        found = []
        for stand in placed:
            points = np.concatenate([surface.vertices for surface in stand.surfaces()])
            low, high = points.min(axis=0), points.max(axis=0)
            x0, z0, x1, z1 = stand.footprint
            assert (low[[0, 2]] >= [x0 - 0.015, z0 - 0.015]).all(), stand.piece.kind
            assert (high[[0, 2]] <= [x1 + 0.015, z1 + 0.015]).all(), stand.piece.kind
            assert low[1] > -1e-6
            assert high[1] <= room.shell.ceiling + 1e-6
            assert room.shell.contains(x0, z0, x1, z1), stand.piece.kind
            if stand.piece.height > FLAT_M:
                found.append((stand.piece.kind, np.array([x0, low[1], z0]), np.array([x1, high[1], z1])))
        for (kind, low, high), (other, other_low, other_high) in combinations(found, 2):
            overlap = np.minimum(high, other_high) - np.maximum(low, other_low)
            assert overlap.min() < 1e-6, f"{kind} and {other} share {overlap} m"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(20), 10**6, 2**40, 10**30])
def test_any_seed_gives_a_closed_walkable_home(seed):
    sim = RaycastSimulator(Scene("test", "0", generate_home(seed)))
    check_walkable(plan_furnished(seed)[0], sim)
    assert misses(sim, plan_furnished(seed)[0]) == 0


def misses(sim, rooms):
    """Rays that leave the scene, from a place in each room in all directions."""
    eyes = np.array([standing_in(room.shell, sim.area.centres)[0] + [0, 1.5, 0] for room in rooms])
    yaw, pitch = np.tile(np.arange(8) * np.pi / 4, len(eyes)), np.tile([0, -0.9, 0, 0.9, 0, -1.3, 0, 1.3], len(eyes))
    poses = camera_to_world(np.repeat(eyes, 8, axis=0), yaw=yaw, pitch=pitch)
    return int((sim.render(poses, Intrinsics.from_hfov(160, 120, hfov_deg=90), rgb=False).depth == 0).sum())


@pytest.mark.parametrize("seed", FEW)
def test_rays_from_inside_always_hit_something(seed):
    assert misses(simulator(seed), furnished(seed)[0]) == 0


def test_homes_are_scenes_with_a_digest_of_their_own():
    scene = load_scene("builtin-home:05")
    assert scene.name == "builtin-home:5"
    assert scene.digest == identify(locate("builtin-home:5"))[0]
    assert scene.digest != identify(locate("builtin:5"))[0]
    assert digest(scene.mesh) == digest(mesh_of(5))


@pytest.mark.parametrize("seed", ["x", "-1", "", "1.5"])
def test_a_seed_that_is_none_is_named(seed):
    with pytest.raises(
        UsageError, match=rf"^builtin-home:{seed}: expected builtin-home:SEED with an integer SEED >= 0"
    ):
        load_scene(f"builtin-home:{seed}")


def test_a_home_that_cannot_be_made_is_named_by_its_seed(monkeypatch):
    monkeypatch.setattr(home, "plan_home", lambda rng, count: None)
    with pytest.raises(SceneError, match=r"^builtin-home:12: expected a home .* none of 40 plans .* another seed$"):
        load_scene("builtin-home:12")
