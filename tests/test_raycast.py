import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avp_habitat.poses import Intrinsics, camera_to_world, pixel_directions, project
from avp_habitat.scenes.loader import Scene, load_scene
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.simulators.raycast import RaycastSimulator

CAMERA = Intrinsics(64, 40, 30.0, 34.0, 31.0, 22.0)
LOW, HIGH = np.array([-2.0, 0.0, -3.0]), np.array([4.0, 2.5, 1.0])
SIDES = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]


def plain(vertices, triangles, colours=None) -> TexturedMesh:
    vertices, triangles = np.asarray(vertices, np.float32), np.asarray(triangles, np.int32)
    if colours is None:
        colours = np.ones((len(vertices), 3))
    uv, index = np.zeros((len(vertices), 2), np.float32), np.full(len(triangles), -1, np.int32)
    return TexturedMesh(vertices, triangles, uv, np.asarray(colours, np.float32), index)


def box(low=LOW, high=HIGH) -> TexturedMesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    triangles = [half for a, b, c, d in SIDES for half in ((a, b, c), (a, c, d))]
    return plain(low + corners * (high - low), triangles)


def simulator(mesh: TexturedMesh) -> RaycastSimulator:
    return RaycastSimulator(Scene("test", "0" * 64, mesh))


def wall(picture: np.ndarray, *, repeat: float = 1.0, colours=None) -> TexturedMesh:
    """A picture on a wall 2 m wide and 1 m high in the plane z = -1, as someone who looks along -Z sees it upright."""
    vertices = np.array([[-1, 1, -1], [1, 1, -1], [1, 0, -1], [-1, 0, -1]], np.float32)
    uv = np.array([[0, 0], [repeat, 0], [repeat, repeat], [0, repeat]], np.float32)
    colours = np.ones((4, 3), np.float32) if colours is None else np.asarray(colours, np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TexturedMesh(vertices, triangles, uv, colours, np.zeros(2, np.int32), [picture])


def facing(position, *, yaw=0.0, pitch=0.0):
    return camera_to_world(np.array([position]), yaw=np.array([yaw]), pitch=np.array([pitch]))


def exact_box_depth(pose, intrinsics):
    """Planar depth from inside the box: the nearest of the six planes along each ray."""
    directions = pixel_directions(intrinsics) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        limits = np.where(directions > 0, HIGH - pose[:3, 3], LOW - pose[:3, 3]) / directions
    return limits.min(axis=-1)


poses = st.builds(
    lambda x, y, z, yaw, pitch: facing([x, y, z], yaw=yaw, pitch=pitch),
    st.floats(-1.9, 3.9),
    st.floats(0.1, 2.4),
    st.floats(-2.9, 0.9),
    st.floats(-3.1, 3.1),
    st.floats(-1.0, 1.0),
)


@pytest.fixture(scope="module")
def room() -> RaycastSimulator:
    return simulator(box())


@settings(max_examples=40, deadline=None)
@given(poses)
def test_depth_in_a_box_is_the_distance_of_its_planes(room, pose):
    depth = room.render(pose, CAMERA, rgb=False).depth[0]
    np.testing.assert_allclose(depth, exact_box_depth(pose[0], CAMERA), rtol=1e-5, atol=1e-5)


def test_many_cameras_at_once_see_what_each_sees_alone(room, monkeypatch):
    rng = np.random.default_rng(0)
    many = camera_to_world(rng.uniform(LOW, HIGH, (7, 3)), yaw=rng.uniform(-3, 3, 7), pitch=rng.uniform(-1, 1, 7))
    together = room.render(many, CAMERA, rgb=True)
    monkeypatch.setattr("avp_habitat.simulators.raycast._RAYS_PER_CALL", 3 * CAMERA.width * CAMERA.height)
    chunked = room.render(many, CAMERA, rgb=True)
    alone = [room.render(pose[None], CAMERA, rgb=True) for pose in many]
    for frames in (chunked.depth, np.concatenate([f.depth for f in alone])):
        assert np.array_equal(frames, together.depth)
    for frames in (chunked.rgb, np.concatenate([f.rgb for f in alone])):
        assert np.array_equal(frames, together.rgb)


def test_depth_is_zero_and_colour_black_where_nothing_is_hit():
    frames = simulator(wall(np.full((1, 1, 3), 200, np.uint8))).render(facing([0, 0.5, 4]), CAMERA, rgb=True)
    hit = frames.depth[0] > 0
    assert 0 < hit.sum() < hit.size
    np.testing.assert_allclose(frames.depth[0][hit], 5, atol=1e-5)
    assert (frames.rgb[0][hit] == 200).all()
    assert (frames.rgb[0][~hit] == 0).all()


@settings(max_examples=40, deadline=None)
@given(st.floats(-1, 1), st.floats(-0.6, 0.6), st.floats(-1.2, 1.2), st.floats(1.5, 4))
def test_a_known_point_lands_on_its_pixel_within_half_a_pixel(right, up, yaw, distance):
    pose = facing([0.3, 1.5, -0.2], yaw=yaw, pitch=-0.2)
    point = pose[0] @ np.array([right, up, -distance, 1.0])
    side = 0.25 * distance  # the marker is large enough to be seen and its centre is the point
    shape = np.array([[-1, -1, 0, 0], [1, -1, 0, 0], [1, 1, 0, 0], [-1, 1, 0, 0]]) * side
    marker = plain((point + shape @ pose[0].T)[:, :3], [[0, 1, 2], [0, 2, 3]])
    depth = simulator(marker).render(pose, Intrinsics.from_hfov(401, 301, hfov_deg=90), rgb=False).depth[0]
    rows, columns = np.nonzero(depth)
    pixel, expected_depth = project(point[None, :3], pose, Intrinsics.from_hfov(401, 301, hfov_deg=90))
    assert abs(columns.mean() + 0.5 - pixel[0, 0, 0]) <= 0.5
    assert abs(rows.mean() + 0.5 - pixel[0, 0, 1]) <= 0.5
    np.testing.assert_allclose(depth[depth > 0], expected_depth[0, 0], rtol=1e-4)


def test_a_picture_hangs_upright_and_unmirrored():
    picture = np.zeros((2, 3, 3), np.uint8)
    picture[0] = [[250, 0, 0], [0, 250, 0], [0, 0, 250]]
    picture[1] = [[250, 250, 0], [0, 250, 250], [250, 0, 250]]
    # The wall fills the image: 2 m at 1 m distance are 60 pixels, 1 m are 30.
    camera = Intrinsics(60, 30, 30.0, 30.0, 30.0, 15.0)
    rgb = simulator(wall(picture)).render(facing([0, 0.5, 0]), camera, rgb=True).rgb[0]
    np.testing.assert_allclose(rgb[7, [10, 30, 50]], picture[0], atol=25)
    np.testing.assert_allclose(rgb[22, [10, 30, 50]], picture[1], atol=25)


def test_a_magnified_picture_equals_a_bilinear_reference():
    picture = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    camera = Intrinsics(60, 30, 30.0, 30.0, 30.0, 15.0)
    rgb = simulator(wall(picture)).render(facing([0, 0.5, 0]), camera, rgb=True).rgb[0]
    x = (np.arange(60) + 0.5) / 60 * 7 - 0.5
    y = (np.arange(30) + 0.5) / 30 * 5 - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[None, :, None], (y - top)[:, None, None]

    def at(row, column):
        return picture[np.ix_(row % 5, column % 7)].astype(float)

    upper = at(top, left) * (1 - fx) + at(top, left + 1) * fx
    lower = at(top + 1, left) * (1 - fx) + at(top + 1, left + 1) * fx
    np.testing.assert_allclose(rgb, upper * (1 - fy) + lower * fy, atol=0.51)


def test_texture_times_vertex_colour_is_multiplied_as_stored():
    colours = [[0, 1, 0.5], [1, 1, 0.5], [1, 1, 0.5], [0, 1, 0.5]]
    camera = Intrinsics(60, 30, 30.0, 30.0, 30.0, 15.0)
    mesh = wall(np.full((4, 4, 3), 200, np.uint8), colours=colours)
    rgb = simulator(mesh).render(facing([0, 0.5, 0]), camera, rgb=True).rgb[0]
    np.testing.assert_allclose(rgb[..., 0], np.tile((np.arange(60) + 0.5) / 60 * 200, (30, 1)), atol=0.51)
    assert (rgb[..., 1] == 200).all()
    assert (rgb[..., 2] == 100).all()


def test_a_fine_pattern_far_away_averages_instead_of_speckling():
    board = ((np.indices((64, 64)).sum(axis=0) % 2) * 255).astype(np.uint8)
    mesh = wall(np.repeat(board[..., None], 3, axis=2), repeat=9.37)
    rgb = simulator(mesh).render(facing([0.013, 0.507, 1]), Intrinsics(20, 10, 20.0, 20.0, 10.0, 5.0), rgb=True).rgb[0]
    np.testing.assert_allclose(rgb, 127.5, atol=2)


def grazing_view(picture: np.ndarray) -> np.ndarray:
    """Rows of a floor's picture, 2 m wide, seen from 0.4 m above it; row 65 is about 6 m away."""
    corners = np.array([[-4, 0, 0], [4, 0, 0], [4, 0, -16], [-4, 0, -16]], np.float32)
    uv = np.array([[0, 8], [4, 8], [4, 0], [0, 0]], np.float32)
    triangles, index = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros(2, np.int32)
    floor = TexturedMesh(corners, triangles, uv, np.ones((4, 3), np.float32), index, [picture])
    camera = Intrinsics(160, 120, 80.0, 80.0, 80.0, 60.0)
    return simulator(floor).render(facing([0.5, 0.4, 0]), camera, rgb=True).rgb[0, :, 40:120, 0].astype(int)


def test_a_grazing_view_keeps_stripes_along_the_view_sharp():
    stripes = np.zeros((256, 256, 3), np.uint8)
    stripes[:, 128:] = 255
    row = grazing_view(stripes)[65]
    assert row.max() - row.min() > 240


def test_a_grazing_view_averages_stripes_across_the_view():
    stripes = np.zeros((256, 256, 3), np.uint8)
    stripes[(np.arange(256) // 16) % 2 == 1] = 255
    assert np.abs(grazing_view(stripes)[65:70] - 127).max() < 25


def test_surfaces_are_seen_from_both_sides():
    sim = simulator(wall(np.full((1, 1, 3), 90, np.uint8)))
    poses = np.concatenate([facing([0, 0.5, 0]), facing([0, 0.5, -2], yaw=np.pi)])
    frames = sim.render(poses, Intrinsics(4, 4, 20.0, 20.0, 2.0, 2.0), rgb=True)
    np.testing.assert_allclose(frames.depth, 1.0, atol=1e-5)
    assert (frames.rgb == 90).all()


def test_degenerate_triangles_are_harmless():
    mesh = box()
    vertices = np.concatenate([mesh.vertices, [[0, 1, -1], [1, 1, -1], [2, 1, -1]]])
    bad = plain(vertices, np.concatenate([mesh.triangles, [[8, 8, 8], [8, 9, 10], [0, 0, 5]]]))
    pose = facing([0.5, 1, 0.5])
    frames = simulator(bad).render(pose, CAMERA, rgb=True)
    np.testing.assert_allclose(frames.depth[0], exact_box_depth(pose[0], CAMERA), rtol=1e-5)
    assert (frames.rgb == 255).all()


def test_a_texture_pinched_to_a_point_is_still_a_colour():
    mesh = wall(np.full((8, 8, 3), 77, np.uint8))
    for uv in (np.zeros((4, 2)), np.full((4, 2), 1e6), np.array([[0, 0], [1e12, 0], [1e12, 1e12], [0, 1e12]])):
        pinched = TexturedMesh(
            mesh.vertices, mesh.triangles, uv.astype(np.float32), mesh.colours, mesh.texture_index, mesh.textures
        )
        rgb = simulator(pinched).render(facing([0, 0.5, 0]), Intrinsics(4, 4, 20.0, 20.0, 2.0, 2.0), rgb=True).rgb
        assert (rgb == 77).all()


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf])
def test_a_texture_at_no_place_at_all_is_not_read_beside_the_picture(place):
    mesh = wall(np.full((8, 8, 3), 77, np.uint8))
    uv = np.full((4, 2), place, np.float32)
    nowhere = TexturedMesh(mesh.vertices, mesh.triangles, uv, mesh.colours, mesh.texture_index, mesh.textures)
    frames = simulator(nowhere).render(facing([0, 0.5, 0]), Intrinsics(4, 4, 20.0, 20.0, 2.0, 2.0), rgb=True)
    np.testing.assert_allclose(frames.depth, 1.0, atol=1e-5)


def brute_force_nearest(origins, directions, mesh):
    """Smallest t > 0 at which each ray meets any triangle, by Cramer's rule in float64."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    nearest = np.full(len(origins), np.inf)
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        matrices = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=-1)
        regular = np.abs(np.linalg.det(matrices)) > 1e-14
        u, v, t = np.linalg.solve(matrices[regular], (origin - a[regular])[..., None])[..., 0].T
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest[i] = t[inside].min(initial=np.inf)
    return nearest


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_visibility_and_depth_agree_with_brute_force(seed):
    rng = np.random.default_rng(seed)
    mesh = plain(rng.uniform(-2, 2, (60, 3)), np.arange(60).reshape(-1, 3))
    eyes = rng.uniform(-2, 2, (5, 3))
    points = rng.uniform(-3, 3, (40, 3))
    pairs = rng.integers(0, [5, 40], (100, 2))
    origin, offset = eyes[pairs[:, 0]], points[pairs[:, 1]] - eyes[pairs[:, 0]]
    distance = np.linalg.norm(offset, axis=1)
    nearest = brute_force_nearest(origin, offset / distance[:, None], mesh)
    clear = np.abs(nearest - (distance - 0.1)) > 1e-4
    visible = simulator(mesh).reached(eyes, points, pairs, tolerance_m=0.1)
    assert 0 < visible.sum() < len(visible)
    assert np.array_equal(visible[clear], (nearest >= distance - 0.1)[clear])


def test_a_hit_within_the_tolerance_still_reaches_the_point():
    sim = simulator(wall(np.full((1, 1, 3), 90, np.uint8)))
    points = np.array([[0, 0.5, -1.09], [0, 0.5, -1.11], [0, 0.5, -0.5], [0, 0.5, -0.01], [0, 0.5, 0]])
    pairs = np.stack([np.zeros(5, int), np.arange(5)], axis=1)
    reached = sim.reached(np.array([[0, 0.5, 0]]), points, pairs, tolerance_m=0.1)
    assert reached.tolist() == [True, False, True, True, True]


def test_no_pairs_give_no_answers(room):
    points, none = np.zeros((3, 3)), np.zeros((0, 2), int)
    assert room.visible(facing([0, 1, 0]), CAMERA, points, none, tolerance_m=0.1).shape == (0,)
    assert room.reached(np.zeros((1, 3)), points, none, tolerance_m=0.1).shape == (0,)


def test_no_cameras_give_no_frames(room):
    frames = room.render(np.zeros((0, 4, 4)), CAMERA, rgb=True)
    assert frames.depth.shape == (0, 40, 64)
    assert frames.rgb.shape == (0, 40, 64, 3)


def test_the_surface_below_is_the_first_one_straight_down():
    table = box(np.array([0, 0.2, -1]), np.array([1, 0.7, 0]))
    ground = box()
    mesh = plain(
        np.concatenate([ground.vertices, table.vertices]), np.concatenate([ground.triangles, table.triangles + 8])
    )
    points = np.array([[0.5, 2, -0.3], [0.5, 0.6, -0.3], [0.5, 0.1, -0.3], [3, 2, 0.5], [9, 2, 0]])
    np.testing.assert_allclose(simulator(mesh).surface_below(points), [0.7, 0.2, 0, 0, np.nan], atol=1e-6)


def test_a_simulator_tells_what_it_shows(room):
    assert (room.name, room.scene, room.scene_digest) == ("raycast", "test", "0" * 64)
    assert room.version.startswith("open3d ")


DIGEST = """
import hashlib, tempfile, numpy as np
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.scenes.loader import Scene
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.simulators.raycast import RaycastSimulator
rng = np.random.default_rng(0)
n = 4000
centres = rng.uniform(-3, 3, (n, 1, 3))
vertices = (centres + rng.normal(0, 0.3, (n, 3, 3))).reshape(-1, 3).astype(np.float32)
triangles = np.concatenate([np.arange(3 * n).reshape(-1, 3)] * 2).astype(np.int32)  # twice: every hit is a tie
uv, colours = rng.random((3 * n, 2)).astype(np.float32), np.ones((3 * n, 3), np.float32)
textures = [rng.integers(0, 256, (64, 48, 3), dtype=np.uint8), rng.integers(0, 256, (3, 5, 3), dtype=np.uint8)]
mesh = TexturedMesh(vertices, triangles, uv, colours, rng.integers(-1, 2, 2 * n).astype(np.int32), textures)
poses = camera_to_world(rng.uniform(-2, 2, (4, 3)), yaw=rng.uniform(-3, 3, 4), pitch=np.zeros(4))
camera = Intrinsics.from_hfov(320, 240, hfov_deg=90)
frames = RaycastSimulator(Scene("x", "x", mesh)).render(poses, camera, rgb=True)
digest = hashlib.sha256(frames.rgb.tobytes() + frames.depth.tobytes())
with tempfile.TemporaryDirectory() as folder, RolloutWriter(folder + "/r", camera) as writer:
    for rgb, depth, pose in zip(frames.rgb, frames.depth, poses):
        writer.add_frame(rgb, depth, pose)
    for view in writer.views(heldout=False):
        digest.update(view.image.read_bytes() + view.depth.read_bytes())
print(digest.hexdigest())
"""


def test_every_run_gives_the_same_bytes_on_any_number_of_threads():
    limit = "import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])\n"
    runs = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        for code in (DIGEST, limit + DIGEST)
    ]
    assert runs[0] == runs[1]


def test_importing_the_simulator_is_cheap():
    code = "import avp_habitat.simulators.raycast, sys; print([m for m in ('open3d', 'numba') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_the_white_room_shows_white_furniture_on_a_wooden_floor(shared):
    sim = RaycastSimulator(load_scene(str(shared / "scenes" / "white_room.glb")))
    camera = Intrinsics.from_hfov(160, 120, hfov_deg=90)
    frames = sim.render(facing([-0.716662, 1.5, 4.5], pitch=-0.2), camera, rgb=True)
    assert (frames.depth > 0).all()
    red, green, blue = frames.rgb[0].reshape(-1, 3).T.astype(int)
    wooden = (red > green + 15) & (green > blue + 10)
    white = (red > 200) & (abs(red - blue) < 25)
    assert wooden.mean() > 0.1
    assert white.mean() > 0.1
