import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter, uniform_filter, zoom

from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.builtin.furnish import largest_part
from avp_habitat.scenes.builtin.kit import FLAT_M, Kit
from avp_habitat.scenes.builtin.noise import Random, fractal
from avp_habitat.scenes.builtin.room import generate_room, plan_room
from avp_habitat.scenes.builtin.shapes import Material, box, cushion, cylinder, lathe
from avp_habitat.scenes.builtin.shell import Shell
from avp_habitat.scenes.loader import Scene
from avp_habitat.simulators.raycast import RaycastSimulator

MANY = range(20)
FEW = (0, 1, 9)
PLAIN = Material(lambda: np.full((64, 64, 3), 200, np.uint8), 1.0, 1.0)


@cache
def plan(seed):
    return plan_room(seed)[1:]


@cache
def room(seed):
    return generate_room(seed)


def simulator_of(mesh):
    return RaycastSimulator(Scene("test", "0", mesh))


@cache
def simulator(seed):
    return simulator_of(room(seed))


def digest(mesh):
    parts = [mesh.vertices, mesh.triangles, mesh.uv, mesh.colours, mesh.texture_index, *mesh.textures]
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


def standing_eyes(seed, count=4):
    centres = simulator(seed).area.centres
    return centres[:: max(1, len(centres) // count)][:count] + [0, 1.5, 0]


def look_around(sim, eyes, *, size=(160, 120), rgb=False):
    """Frames in eight directions, up and down included, from each eye."""
    yaw, pitch = np.tile(np.arange(8) * np.pi / 4, len(eyes)), np.tile([0, -0.9, 0, 0.9, 0, -1.3, 0, 1.3], len(eyes))
    poses = camera_to_world(np.repeat(eyes, 8, axis=0), yaw=yaw, pitch=pitch)
    return sim.render(poses, Intrinsics.from_hfov(*size, hfov_deg=90), rgb=rgb)


def test_the_same_seed_gives_the_same_bytes():
    assert digest(generate_room(1)) == digest(room(1))


def printed_elsewhere(code):
    """What a line of Python prints in another process, which finds the tests."""
    line = [sys.executable, "-c", f"import sys; sys.path.insert(0, 'tests'); {code}"]
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    return subprocess.run(line, capture_output=True, text=True, check=True, env=environment).stdout.strip()


def test_another_process_makes_the_same_room():
    code = "from test_builtin_rooms import digest, generate_room; print(digest(generate_room(1)))"
    assert printed_elsewhere(code) == digest(room(1))


def test_seed_0_is_still_the_room_of_generator_version_1():
    """A failure here means: raise GENERATOR_VERSION, then write down the new room."""
    shell, placed = plan(0)
    kinds = sorted({stand.piece.kind for stand in placed})
    assert (shell.bounds, shell.ceiling) == ((-3.78, -2.58, 3.78, 2.59), 3.05)
    assert "bed" in kinds
    assert "divider shelf" in kinds


def test_seeds_differ_in_size_height_and_furniture():
    assert len({plan(seed)[0].bounds for seed in MANY}) == len(MANY)
    assert len({plan(seed)[0].ceiling for seed in MANY}) > 12
    assert len({tuple(stand.piece.kind for stand in plan(seed)[1]) for seed in MANY}) == len(MANY)
    assert {plan(seed)[0].notch is None for seed in MANY} == {True, False}


def test_seeds_differ_in_pictures():
    assert not np.array_equal(room(0).textures[0], room(1).textures[0])


@pytest.mark.parametrize("seed", MANY)
def test_rooms_have_the_size_of_rooms(seed):
    shell, _ = plan(seed)
    x0, z0, x1, z1 = shell.bounds
    assert 4 <= x1 - x0 <= 8
    assert 3.5 <= z1 - z0 <= 6.5
    assert 2.5 <= shell.ceiling <= 3.2
    assert sum(hole.kind == "door" for hole in shell.openings) == 1
    assert sum(hole.kind == "window" for hole in shell.openings) >= 1


@pytest.mark.parametrize("seed", MANY)
def test_rooms_hold_many_kinds_of_furniture(seed):
    kinds = {stand.piece.kind for stand in plan(seed)[1]}
    assert len(kinds) >= 8
    assert kinds & {"sofa", "bed"}
    assert "picture" in kinds


@pytest.mark.parametrize("seed", MANY)
def test_furniture_keeps_to_its_footprint_inside_the_room(seed):
    shell, placed = plan(seed)
    for stand in placed:
        points = np.concatenate([surface.vertices for surface in stand.surfaces()])
        low, high = points.min(axis=0), points.max(axis=0)
        x0, z0, x1, z1 = stand.footprint
        assert (low[[0, 2]] >= [x0 - 0.015, z0 - 0.015]).all(), stand.piece.kind
        assert (high[[0, 2]] <= [x1 + 0.015, z1 + 0.015]).all(), stand.piece.kind
        assert low[1] > -1e-6
        assert high[1] <= shell.ceiling + 1e-6
        assert shell.contains(x0 + 0.021, z0 + 0.021, x1 - 0.021, z1 - 0.021), stand.piece.kind


def boxes(placed):
    for stand in placed:
        if stand.piece.height > FLAT_M:
            heights = np.concatenate([surface.vertices[:, 1] for surface in stand.surfaces()])
            x0, z0, x1, z1 = stand.footprint
            yield stand.piece.kind, np.array([x0, heights.min(), z0]), np.array([x1, heights.max(), z1])


@pytest.mark.parametrize("seed", MANY)
def test_no_piece_stands_in_another(seed):
    found = list(boxes(plan(seed)[1]))
    for index, (kind, low, high) in enumerate(found):
        for other, other_low, other_high in found[index + 1 :]:
            overlap = np.minimum(high, other_high) - np.maximum(low, other_low)
            assert overlap.min() < 1e-6, f"{kind} and {other} share {overlap} m"


@pytest.mark.parametrize("seed", MANY)
def test_the_door_can_be_reached(seed):
    shell, placed = plan(seed)
    (door,) = [hole for hole in shell.openings if hole.kind == "door"]
    x, z = shell.walls[door.wall].point((door.left + door.right) / 2, 0.5)
    for kind, low, high in boxes(placed):
        assert not (low[0] - 0.3 < x < high[0] + 0.3 and low[2] - 0.3 < z < high[2] + 0.3), kind


@pytest.mark.parametrize("seed", FEW)
def test_the_mesh_is_finite_indexed_and_of_moderate_size(seed):
    mesh, (shell, _) = room(seed), plan(seed)
    for part in (mesh.vertices, mesh.uv, mesh.colours):
        assert np.isfinite(part).all()
    assert mesh.colours.min() >= 0
    assert mesh.colours.max() <= 1
    assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
    assert 10_000 <= len(mesh.triangles) <= 60_000
    assert abs(mesh.bounds[0, 1]) < 1e-6
    assert abs(mesh.bounds[1, 1] - shell.ceiling) < 1e-3


@pytest.mark.parametrize("seed", FEW)
def test_every_texture_is_a_used_picture_with_something_on_it(seed):
    mesh = room(seed)
    assert set(np.unique(mesh.texture_index)) == set(range(len(mesh.textures)))
    for picture in mesh.textures:
        assert picture.dtype == np.uint8
        assert min(picture.shape[:2]) >= 64
        assert picture.std(axis=(0, 1)).max() > 2


def misses(mesh, eyes):
    return int((look_around(simulator_of(mesh), eyes).depth == 0).sum())


@pytest.mark.parametrize("seed", FEW)
def test_rays_from_inside_always_hit_something(seed):
    assert misses(room(seed), standing_eyes(seed)) == 0


def test_a_hole_in_the_ceiling_would_be_found():
    mesh = room(1)
    heights = mesh.vertices[mesh.triangles][:, :, 1]
    open_above = heights.min(axis=1) < mesh.bounds[1, 1] - 1e-3
    opened = replace(mesh, triangles=mesh.triangles[open_above], texture_index=mesh.texture_index[open_above])
    assert misses(opened, standing_eyes(1)) > 1000


@pytest.mark.parametrize("seed", FEW)
def test_surfaces_turn_their_fronts_to_the_agent(seed):
    """Habitat-Sim does not draw backs."""
    mesh = room(seed)
    corners = mesh.vertices[mesh.triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    backs = hits = 0
    import open3d

    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(mesh.vertices, mesh.triangles.astype(np.uint32))
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    for eye in standing_eyes(seed):
        cast = np.concatenate([np.broadcast_to(eye, directions.shape), directions], axis=1).astype(np.float32)
        triangle = rays.cast_rays(open3d.core.Tensor(cast))["primitive_ids"].numpy()
        backs += int((np.einsum("ij,ij->i", normals[triangle], directions) > 0).sum())
        hits += len(triangle)
    assert backs / hits < 0.002


def check_walkable(seed, sim):
    shell, placed = plan(seed)
    area = sim.area
    assert area.area_m2 / shell.floor_area >= 0.4
    heights = area.heights[area.mask]
    assert heights.min() > -0.001
    assert heights.max() < 0.02
    rugs = [stand.position for stand in placed if stand.piece.kind == "rug"]
    assert rugs
    assert heights.max() > 0.01, "agents should walk over rugs"


@pytest.mark.parametrize("seed", FEW)
def test_two_fifths_of_the_floor_can_be_walked_on(seed):
    check_walkable(seed, simulator(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(20), 10**6, 2**40, 10**30])
def test_any_seed_gives_a_closed_walkable_room(seed):
    mesh = generate_room(seed)
    sim = simulator_of(mesh)
    check_walkable(seed, sim)
    centres = sim.area.centres
    assert misses(mesh, centres[:: len(centres) // 3] + [0, 1.5, 0]) == 0
    assert 10_000 <= len(mesh.triangles) <= 60_000


@pytest.mark.parametrize("seed", FEW)
def test_no_single_spot_sees_the_whole_floor(seed):
    sim = simulator(seed)
    points, eyes = sim.area.centres, standing_eyes(seed, 40)
    pairs = np.stack(np.meshgrid(np.arange(len(eyes)), np.arange(len(points)), indexing="ij"), -1).reshape(-1, 2)
    seen = sim.reached(eyes, points, pairs, tolerance_m=0.1).reshape(len(eyes), len(points))
    assert seen.mean(axis=1).max() < 0.9


def share_of_corners(frames):
    """Share of 20x20 blocks of grey pictures that hold a corner (smaller eigenvalue of the structure tensor)."""
    grey = frames.astype(float).mean(axis=-1)
    dy, dx = np.gradient(grey, axis=(1, 2))

    def blocks(values):
        count, height, width = values.shape
        return values.reshape(count, height // 20, 20, width // 20, 20).mean(axis=(2, 4))

    xx, yy, xy = blocks(dx * dx), blocks(dy * dy), blocks(dx * dy)
    smaller = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return float((smaller > 2.0).mean())


@pytest.mark.parametrize("seed", FEW)
def test_most_of_what_cameras_see_has_corners_to_match(seed):
    rich = look_around(simulator(seed), standing_eyes(seed), size=(320, 240), rgb=True).rgb
    assert share_of_corners(rich) > 0.6


def test_a_room_with_plain_surfaces_would_have_too_few_corners():
    mesh = room(1)
    plain = [np.broadcast_to(t.mean(axis=(0, 1)).astype(np.uint8), (8, 8, 3)).copy() for t in mesh.textures]
    poor = look_around(simulator_of(replace(mesh, textures=plain)), standing_eyes(1), size=(320, 240), rgb=True).rgb
    assert share_of_corners(poor) < 0.4


def keypoints_per_square_metre(material, distance_m):
    """Extrema of differences of Gaussians above SIFT's threshold, for a focal length of 320 pixels."""
    grey = material.picture.astype(float).mean(axis=-1) * 0.75
    wanted = np.array([material.height_m, material.width_m]) * 320 / distance_m
    ratio = wanted.astype(int) / grey.shape
    smooth = uniform_filter(grey, np.maximum(1, np.rint(1 / ratio)), mode="wrap")
    seen = zoom(smooth, ratio, order=1, mode="grid-wrap", grid_mode=True)
    levels = np.stack([gaussian_filter(seen, 1.2 * 2 ** (k / 3), mode="wrap") for k in range(8)])
    difference = np.abs(np.diff(levels, axis=0))
    peaks = (difference == maximum_filter(difference, 3)) & (difference > 0.04 / 3 * 255)
    return peaks[1:-1].sum() / (material.width_m * material.height_m)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["wall", "papered_wall", "feature_wall", "ceiling", "floor", "upholstery"])
def test_large_surfaces_have_keypoints(seed, name):
    assert keypoints_per_square_metre(getattr(Kit(seed), name), 1.5) > 5


def test_a_uniform_surface_has_no_keypoints():
    assert keypoints_per_square_metre(PLAIN, 2.0) == 0


@pytest.mark.parametrize("seed", FEW)
def test_light_is_baked_without_black_corners(seed):
    mesh = room(seed)
    floor = (np.abs(mesh.vertices[:, 1]) < 1e-6) & (mesh.texture_index[0] == 0)
    light = mesh.colours[floor].mean(axis=1)
    assert light.std() > 0.03
    seen = look_around(simulator(seed), standing_eyes(seed), rgb=True).rgb.mean(axis=-1)
    assert 80 < seen.mean() < 180
    assert (seen < 12).mean() < 0.02


@pytest.mark.parametrize(
    "surfaces",
    [
        box((1, 2, 0.5), (0, 1, 0), PLAIN, fit=(0, 0, 1, 1), pitch=0.4),
        box((0.2, 0.1, 0.3), (0, 1, 0), PLAIN, fit=(0, 0, 1, 1)),
    ],
    ids=["subdivided box", "small box"],
)
def test_normals_and_windings_of_boxes_agree_and_point_outwards(surfaces):
    check_outwards(surfaces, np.array([0, 1, 0]))


def test_normals_and_windings_of_round_shapes_agree_and_point_outwards():
    wood = Kit(0).wood
    check_outwards(cushion((0.6, 0.2, 0.4), (0, 1, 0), 0.05, wood, puff=0.02), np.array([0, 1, 0]))
    check_outwards(cylinder(0.2, 0.0, 0.6, (0, 0, 0), wood), np.array([0, 0.3, 0]))
    check_outwards(lathe([(0.1, 0.4), (0.2, 0.2), (0.1, 0.0)], (0, 0, 0), wood), np.array([0, 0.2, 0]))


def check_outwards(surfaces, inside):
    for surface in surfaces:
        corners = surface.vertices[surface.triangles]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("ij,ij->i", face, corners.mean(axis=1) - inside) >= -1e-12).all()
        assert (np.einsum("tj,tkj->tk", face, surface.normals[surface.triangles]) >= -1e-12).all()


def test_the_depth_in_front_of_a_wall_ends_at_the_notch_of_an_l_shaped_room():
    shell = Shell(((1, 0), (6, 0), (6, 4), (0, 4), (0, 3), (1, 3)), (0, 0, 1, 3), 2.5, ())
    north, east, south, west, step, inner = shell.walls
    assert shell.depth_at(north, 2.0) == 4
    assert shell.depth_at(east, 1.0) == 5
    assert shell.depth_at(east, 3.5) == 6
    assert shell.depth_at(south, 5.5) == 1
    assert shell.depth_at(south, 1.0) == 4
    assert (shell.depth_at(west, 0.5), shell.depth_at(step, 0.5), shell.depth_at(inner, 1.0)) == (6, 1, 5)


def test_noise_repeats_without_a_seam():
    field = fractal(Random(3), (64, 96), (4, 6))
    across = np.abs(np.diff(field, axis=1)).max()
    down = np.abs(np.diff(field, axis=0)).max()
    assert np.abs(field[:, 0] - field[:, -1]).max() <= 1.5 * across
    assert np.abs(field[0] - field[-1]).max() <= 1.5 * down


def test_the_largest_part_of_a_mask_is_found():
    mask = np.array([[1, 0, 1, 1], [1, 0, 0, 1], [0, 0, 1, 1]], dtype=bool)
    assert largest_part(mask).tolist() == [[0, 0, 1, 1], [0, 0, 0, 1], [0, 0, 1, 1]]


def test_random_numbers_shuffle_without_loss_and_depend_on_seed_and_stream():
    assert sorted(Random(1).shuffled(list(range(20)))) == list(range(20))
    streams = [tuple(Random(seed, stream).array(4)) for seed in (0, 1) for stream in (0, 1)]
    assert len(set(streams)) == 4
