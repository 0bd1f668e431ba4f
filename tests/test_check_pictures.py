import re
import tempfile
from dataclasses import replace

import numpy as np
import pytest
from picture_walk import CAMERA, walk_poses, write_walk

from avp_habitat.errors import RolloutError
from avp_habitat.poses import camera_to_world, habitat_to_opencv, yaw_and_pitch
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_nerfstudio.check.pictures import matching
from avp_nerfstudio.check.pictures.evidence import check_pictures, judge
from avp_nerfstudio.check.pictures.matching import match_pictures
from avp_nerfstudio.check.pictures.rays import NEAREST_M, Stacked, ray_errors


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return write_walk(tmp_path_factory.mktemp("pictures") / "walk")


@pytest.fixture(scope="module")
def matches(walk):
    return match_pictures(walk, progress=False)


def figures(verdicts):
    return {name: value for verdict in verdicts for name, value in verdict.figures.items()}


def test_correct_poses_pass_with_errors_far_below_a_pixel_and_half_a_degree(walk, matches):
    verdicts = check_pictures(walk, matches=matches)
    assert [verdict.name for verdict in verdicts] == ["reprojection", "relative poses"]
    assert all(verdict.passed and verdict.cause is None for verdict in verdicts)
    found = figures(verdicts)
    assert found["mean_reprojection_px"] < 0.5
    assert found["points"] > 300
    assert found["track_length_mean"] > 3
    assert found["rotation_median_deg"] < 0.25
    assert found["direction_median_deg"] < 2
    assert abs(found["best_focal_factor"] - 1) < 0.003
    assert found["judged_frames"] == found["frames"] == 14


def transposed(poses):
    turned = poses.copy()
    turned[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return turned


def exchanged(poses, first, second):
    changed = poses.copy()
    changed[[first, second]] = poses[[second, first]]
    return changed


def moved(poses, frame, offset):
    changed = poses.copy()
    changed[frame, :3, 3] += offset
    return changed


def pitch_in_degrees(poses):
    yaw, pitch = yaw_and_pitch(poses)
    return camera_to_world(poses[:, :3, 3], yaw=yaw, pitch=np.degrees(pitch))


POSES = walk_poses()
FAULTS = {
    "flip": (habitat_to_opencv(POSES), CAMERA, "y and z flipped"),
    "transposed": (transposed(POSES), CAMERA, "rotations look transposed"),
    "inverse": (np.linalg.inv(POSES), CAMERA, "look like world_to_camera: expected"),
    "long focal length": (POSES, replace(CAMERA, fx=164.8, fy=164.8), r"focal length is [23]\.\d % too long"),
    "short focal length": (POSES, replace(CAMERA, fx=155.2, fy=155.2), r"focal length is [23]\.\d % too short"),
    "sides swapped": (POSES, replace(CAMERA, cx=CAMERA.cy, cy=CAMERA.cx), "width and height look swapped"),
    "sides and focal length": (POSES, replace(CAMERA, fx=120, fy=120, cx=120, cy=160), "width and height look swapped"),
    "two exchanged": (exchanged(POSES, 4, 9), CAMERA, "frames 4 and 9 look exchanged"),
    "neighbours exchanged": (exchanged(POSES, 9, 10), CAMERA, "frames 9 and 10 look exchanged"),
    "5 cm": (moved(POSES, 6, [0.03, 0, 0.04]), CAMERA, r"pose of frame 6 looks [45]\.\d cm and 0\.\d degrees off"),
    "shift": (np.concatenate([POSES[1:], POSES[-1:]]), CAMERA, "each frame has the pose of the next one"),
    "shift back": (np.concatenate([POSES[:1], POSES[:-1]]), CAMERA, "each frame has the pose of the previous one"),
    "pitch": (pitch_in_degrees(POSES), CAMERA, "pitch in degrees was taken for radians"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_seen_and_named(matches, fault):
    poses, camera, words = FAULTS[fault]
    reprojection, _ = judge(matches, poses, camera)
    assert not reprojection.passed
    assert re.search(words, str(reprojection.cause)), reprojection.cause


def test_a_fault_of_all_poses_fails_both_verdicts_with_its_cause(matches):
    verdicts = judge(matches, np.linalg.inv(POSES), CAMERA)
    assert [verdict.passed for verdict in verdicts] == [False, False]
    assert all("world_to_camera" in str(verdict.cause) for verdict in verdicts)


def test_a_fault_of_one_frame_fails_and_names_it(matches):
    reprojection, _ = judge(matches, moved(POSES, 6, [0.0, 0.05, 0.0]), CAMERA)
    assert not reprojection.passed
    assert "worst frame 6" in reprojection.text
    assert reprojection.figures["worst_frame"] == 6


def test_pictures_cannot_tell_the_scale(matches):
    larger = POSES.copy()
    larger[:, :3, 3] *= 1.1
    assert all(verdict.passed for verdict in judge(matches, larger, CAMERA))


def test_a_ray_error_is_the_smallest_angle_to_any_depth_along_the_ray():
    rng = np.random.default_rng(0)
    poses = camera_to_world(rng.normal(size=(2, 3)) * 0.3, yaw=rng.normal(size=2), pitch=rng.normal(size=2) * 0.3)
    pixels = rng.uniform([0, 0], [320, 240], size=(2, 30, 2))
    one = np.array([0])
    stacked = Stacked(np.zeros(30, int), one, one + 1, np.array([0, 30]), np.array([30]), pixels)
    camera = habitat_to_opencv(poses)
    depths = NEAREST_M * np.geomspace(1, 1e6, 20000)

    def ray(index, pixel):
        local = np.array([(pixel[0] - CAMERA.cx) / CAMERA.fx, (pixel[1] - CAMERA.cy) / CAMERA.fy, 1.0])
        return camera[index, :3, :3] @ (local / np.linalg.norm(local))

    expected = []
    for first, second in zip(*pixels, strict=True):
        points = camera[0, :3, 3] + depths[:, None] * ray(0, first) - camera[1, :3, 3]
        cosine = points @ ray(1, second) / np.linalg.norm(points, axis=1)
        expected.append(np.arccos(cosine.max()) * CAMERA.fx)
    np.testing.assert_allclose(ray_errors(stacked, poses, CAMERA), expected, atol=0.02)


def test_pictures_without_texture_pass_as_not_judged(tmp_path):
    with RolloutWriter(tmp_path / "grey", CAMERA) as writer:
        for pose in walk_poses()[:4]:
            writer.add_frame(np.full((240, 320, 3), 128, np.uint8), np.ones((240, 320)), pose)
        writer.publish({"scene": "grey"})
    verdicts = check_pictures(read_rollout(tmp_path / "grey"), progress=False)
    assert [verdict.passed for verdict in verdicts] == [True, True]
    assert all("could not be judged: 4 pictures with 0 features" in verdict.text for verdict in verdicts)


def test_a_damaged_picture_is_named(tmp_path):
    with RolloutWriter(tmp_path / "broken", CAMERA) as writer:
        for pose in walk_poses()[:2]:
            writer.add_frame(np.full((240, 320, 3), 128, np.uint8), np.ones((240, 320)), pose)
        writer.publish({"scene": "grey"})
    path = tmp_path / "broken" / "images" / "frame_00001.png"
    content = path.read_bytes()
    path.write_bytes(content[:45] + bytes(len(content) - 65) + content[-20:])
    with pytest.raises(RolloutError, match=r"frame_00001\.png: expected an undamaged PNG"):
        check_pictures(read_rollout(tmp_path / "broken"), progress=False)


def test_the_temporary_files_are_removed(walk, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    check_pictures(replace(walk, frames=walk.frames[:3]), progress=False)
    assert list(tmp_path.iterdir()) == []


def test_the_work_on_a_long_rollout_is_bounded():
    frames = matching._choose_frames(10_000)
    assert len(frames) <= matching.MAX_FRAMES
    assert frames[0] == 0
    assert frames[-1] == 9_999
    pairs = matching._candidates(len(frames))
    exhaustive = matching.EXHAUSTIVE_FRAMES * (matching.EXHAUSTIVE_FRAMES - 1) // 2
    assert len(pairs) <= exhaustive + matching.NEIGHBOURS * len(frames)
    assert all((i, i + 1) in set(pairs) for i in range(len(frames) - 1))
