from typing import Any

import numpy as np
import pytest
import rerun as rr
from corridor import Corridor
from rrd import chunks, verify

from avp_habitat import poses
from avp_habitat.poses import Intrinsics
from avp_sb3.rerun.room import log_room, room_points, room_poses

CAMERA = Intrinsics.from_hfov(24, 16, hfov_deg=80)


@pytest.fixture(scope="module")
def views():
    """Three views into the analytic corridor: pictures of random colours, depth and poses; no two look alike."""
    places = np.array([[0.6, 1.5, 0.9], [2.2, 1.2, 2.5], [5.0, 1.4, 1.1]])
    pose = poses.camera_to_world(places, yaw=np.array([-0.3, 1.9, -2.0]), pitch=np.array([-0.4, 0.2, 0.1]))
    depth = Corridor().render(pose, CAMERA, rgb=False).depth
    rgb = np.random.default_rng(0).integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
    return list(zip(rgb, depth, strict=True)), pose


def brute_force(frames, pose, voxel, far, top):
    """Pixel by pixel, with dictionaries and the projection that the tests of poses hold."""
    boxes = {}
    for (rgb, depth), camera in zip(frames, pose, strict=True):
        points = poses.unproject(depth, camera, CAMERA)
        for row in range(CAMERA.height):
            for column in range(CAMERA.width):
                point = points[row, column]
                if 0 < depth[row, column] <= far and point[1] <= top:
                    boxes.setdefault(tuple(np.floor(point / voxel).astype(int)), []).append([*point, *rgb[row, column]])
    means = np.array([np.mean(boxes[key], axis=0) for key in sorted(boxes)])
    return means[:, :3], means[:, 3:]


def test_points_are_the_means_of_the_pixels_in_each_voxel(views):
    frames, pose = views
    points, colours = room_points(frames, CAMERA, pose, voxel_m=0.3, max_depth_m=3.0, ceiling_m=0.2)
    assert points.dtype == np.float32
    assert colours.dtype == np.uint8
    expected, mean_colours = brute_force(frames, pose, 0.3, 3.0, pose[:, 1, 3].max() + 0.2)
    np.testing.assert_allclose(points, expected, atol=1e-5)
    np.testing.assert_allclose(colours, mean_colours, atol=0.51)


def test_points_lie_where_the_camera_saw_their_colour(views):
    frames, pose = views
    for index, (rgb, depth) in enumerate(frames):
        points, colours = room_points([(rgb, depth)], CAMERA, pose[index : index + 1], voxel_m=1e-4, ceiling_m=np.inf)
        assert len(points) == (depth > 0).sum() == depth.size
        pixel, distance = poses.project(points.astype(np.float64), pose[index : index + 1], CAMERA)
        column, row = np.floor(pixel[0]).astype(int).T
        np.testing.assert_allclose(distance[0], depth[row, column], atol=1e-4)
        np.testing.assert_array_equal(colours, rgb[row, column])


def test_pixels_without_depth_and_far_ones_are_left_out(views):
    frames, pose = views
    rgb, depth = frames[0]
    holed = depth.copy()
    holed[:, 12:] = 0
    holed[0, 0] = np.nan
    points, _ = room_points([(rgb, holed)], CAMERA, pose[:1], voxel_m=1e-4, ceiling_m=np.inf)
    assert len(points) == np.count_nonzero(holed > 0)
    near, _ = room_points([(rgb, depth)], CAMERA, pose[:1], voxel_m=1e-4, max_depth_m=0.9, ceiling_m=np.inf)
    assert 0 < len(near) == np.count_nonzero((depth > 0) & (depth <= 0.9)) < np.count_nonzero(depth > 0)
    nothing, colours = room_points([(rgb, np.zeros_like(depth))], CAMERA, pose[:1])
    assert nothing.shape == colours.shape == (0, 3)


def test_the_number_of_points_is_bounded_and_the_room_still_covered(views):
    frames, pose = views
    full, _ = room_points(frames, CAMERA, pose, voxel_m=0.01)
    for bound in (100, 7, 1):
        points, colours = room_points(frames, CAMERA, pose, voxel_m=0.01, at_most=bound)
        assert 0 < len(points) == len(colours) <= bound
    points, _ = room_points(frames, CAMERA, pose, voxel_m=0.01, at_most=100)
    nearest = np.linalg.norm(full[:, None] - points[None], axis=-1).min(axis=1)
    size = np.ptp(full, axis=0).max()
    assert nearest.max() < 0.25 * size


def test_the_same_frames_give_the_same_cloud_and_a_generator_will_do(views):
    frames, pose = views
    first, second = (room_points(iter(frames), CAMERA, pose) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_large_pictures_are_thinned_without_shifting_the_room():
    camera = Intrinsics.from_hfov(640, 400, hfov_deg=80)
    pose = poses.camera_to_world(np.array([[0.6, 1.5, 0.9]]), yaw=np.array([-0.3]), pitch=np.array([-0.4]))
    depth = Corridor().render(pose, camera, rgb=False).depth[0]
    points, _ = room_points(
        [(np.zeros((400, 640, 3), np.uint8), depth)], camera, pose, voxel_m=1e-5, at_most=1_000_000, ceiling_m=np.inf
    )
    assert 10_000 < len(points) <= 40_000
    pixel, distance = poses.project(points.astype(np.float64), pose, camera)
    column, row = np.floor(pixel[0]).astype(int).T
    np.testing.assert_allclose(distance[0], depth[row, column], atol=1e-4)


def test_the_room_is_static_in_the_recording(views, tmp_path):
    frames, pose = views
    points, colours = room_points(frames, CAMERA, pose)
    recording = rr.RecordingStream("avp")
    recording.save(tmp_path / "a.rrd")
    log_room(recording, "world/room", (points, colours))
    recording.disconnect()
    verify(tmp_path / "a.rrd")
    room = [chunk for chunk in chunks(tmp_path / "a.rrd") if chunk.entity_path == "/world/room"]
    assert room
    batch = room[0].to_record_batch()
    assert "step" not in batch.schema.names
    np.testing.assert_array_equal(np.array(batch.column("Points3D:positions").to_pylist()[0]), points)
    packed = np.array(batch.column("Points3D:colors").to_pylist()[0], dtype=np.uint32)
    unpacked = np.stack([packed >> 24, packed >> 16, packed >> 8], axis=1) & 255
    np.testing.assert_array_equal(unpacked, colours)


def test_views_of_a_room_stand_apart_where_an_agent_can_and_look_all_around():
    area: Any = Corridor().area
    pose = room_poses(area, 1.2, places=6)
    assert pose.shape == (18, 4, 4)
    assert all(poses.rigidity_fault(each) is None for each in pose)
    np.testing.assert_allclose(pose[:, 1, 3], 1.2)
    places = np.unique(pose[:, :3, 3], axis=0)
    assert len(places) == 6
    assert area.contains(places).all()
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[~np.eye(6, dtype=bool)]
    assert apart.min() > 1.0
    assert (places[:, 0] < 2.9).any()
    assert (places[:, 0] > 3.1).any()
    yaw, _ = poses.yaw_and_pitch(pose[:3])
    np.testing.assert_allclose(np.diff(np.sort(yaw)), 2 * np.pi / 3, atol=1e-9)
    np.testing.assert_array_equal(pose, room_poses(area, 1.2, places=6))
