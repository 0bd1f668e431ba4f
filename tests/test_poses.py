import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avp_habitat import poses
from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics

ANGLE = st.floats(-3.1, 3.1)
PITCH = st.floats(-1.5, 1.5)
METRES = st.floats(-50, 50)


def one_pose(x, y, z, yaw, pitch):
    return poses.camera_to_world(np.array([[x, y, z]]), yaw=np.array([yaw]), pitch=np.array([pitch]))[0]


def test_yaw_zero_looks_along_minus_z_with_x_to_the_right_and_y_up():
    np.testing.assert_allclose(one_pose(1, 2, 3, 0, 0)[:3, :3], np.eye(3), atol=1e-12)


def test_positive_yaw_turns_left_and_positive_pitch_looks_up():
    left = one_pose(0, 0, 0, np.pi / 2, 0)
    np.testing.assert_allclose(-left[:3, 2], [-1, 0, 0], atol=1e-12)
    up = one_pose(0, 0, 0, 0, np.pi / 6)
    np.testing.assert_allclose(-up[:3, 2], [0, 0.5, -np.sqrt(3) / 2], atol=1e-12)


def test_walking_goes_where_a_level_camera_looks():
    yaw = np.array([0.7])
    forward = -poses.camera_to_world(np.zeros((1, 3)), yaw=yaw, pitch=np.zeros(1))[0, :3, 2]
    np.testing.assert_allclose(poses.heading(yaw)[0], forward, atol=1e-12)


@given(METRES, METRES, METRES, ANGLE, PITCH)
def test_poses_are_rigid_and_give_their_angles_back(x, y, z, yaw, pitch):
    pose = one_pose(x, y, z, yaw, pitch)
    assert poses.rigidity_fault(pose) is None
    found_yaw, found_pitch = poses.yaw_and_pitch(pose[None])
    np.testing.assert_allclose([found_yaw[0], found_pitch[0]], [yaw, pitch], atol=1e-7)


@given(METRES, METRES, METRES, ANGLE, PITCH)
def test_every_conversion_comes_back(x, y, z, yaw, pitch):
    pose = one_pose(x, y, z, yaw, pitch)
    np.testing.assert_allclose(poses.opencv_to_habitat(poses.habitat_to_opencv(pose)), pose, atol=1e-12)
    np.testing.assert_allclose(poses.z_up_to_y_up(poses.y_up_to_z_up(pose)), pose, atol=1e-12)


def test_an_opencv_camera_looks_along_its_plus_z_with_y_down():
    pose = one_pose(0, 1.5, 0, 0.4, -0.3)
    opencv = poses.habitat_to_opencv(pose)
    np.testing.assert_allclose(opencv[:3, 2], -pose[:3, 2])
    np.testing.assert_allclose(opencv[:3, 1], -pose[:3, 1])
    np.testing.assert_allclose(opencv[:3, [0, 3]], pose[:3, [0, 3]])


def test_the_z_up_world_has_height_on_z_and_keeps_x():
    moved = poses.y_up_to_z_up(one_pose(1, 2, 3, 0, 0))
    np.testing.assert_allclose(moved[:3, 3], [1, -3, 2])
    assert poses.rigidity_fault(moved) is None


def opencv_projection(point, pose, camera):
    """Textbook K [R|t] with the matrix inverse, an independent way to the pixel."""
    local = np.linalg.inv(poses.habitat_to_opencv(pose)) @ np.append(point, 1)
    pixel = camera.matrix @ local[:3]
    return pixel[:2] / pixel[2], local[2]


@given(ANGLE, PITCH, st.floats(30, 150), st.integers(0, 10_000))
def test_projection_agrees_with_the_camera_matrix(yaw, pitch, hfov_deg, seed):
    rng = np.random.default_rng(seed)
    camera = Intrinsics.from_hfov(64, 36, hfov_deg=hfov_deg)
    pose = one_pose(*rng.normal(size=3), yaw, pitch)
    points = rng.normal(size=(5, 3)) * 4
    pixels, depth = poses.project(points, pose[None], camera)
    for k, point in enumerate(points):
        expected, expected_depth = opencv_projection(point, pose, camera)
        assert depth[0, k] == pytest.approx(expected_depth, abs=1e-9)
        if expected_depth > 0.05:
            np.testing.assert_allclose(pixels[0, k], expected, rtol=1e-7, atol=1e-6)


@given(ANGLE, PITCH, st.integers(0, 10_000))
def test_unprojected_pixels_project_to_their_centres(yaw, pitch, seed):
    camera = Intrinsics.from_hfov(7, 4, hfov_deg=70)
    depth = np.random.default_rng(seed).uniform(0.2, 8, size=(4, 7))
    pose = one_pose(1, 1.5, -2, yaw, pitch)
    points = poses.unproject(depth, pose, camera)
    pixels, found = poses.project(points.reshape(-1, 3), pose[None], camera)
    v, u = np.mgrid[0:4, 0:7] + 0.5
    np.testing.assert_allclose(pixels[0], np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-6)
    np.testing.assert_allclose(found[0], depth.ravel(), atol=1e-9)


def test_the_field_of_view_ends_at_the_image_border():
    camera = Intrinsics.from_hfov(640, 480, hfov_deg=90)
    assert (camera.fx, camera.cx, camera.cy) == (pytest.approx(320), 320, 240)


@pytest.mark.parametrize("hfov_deg", [0, 180, -20, float("nan"), float("inf"), "90"])
def test_an_impossible_field_of_view_is_refused(hfov_deg):
    with pytest.raises(UsageError, match=r"^hfov_deg: expected a number from 0.001 to 179, got"):
        Intrinsics.from_hfov(64, 48, hfov_deg=hfov_deg)


@pytest.mark.parametrize("width", [0, 2.5, 10**9, -8, True, float("nan"), None])
def test_an_impossible_image_size_is_refused(width):
    with pytest.raises(UsageError, match=r"^width: expected a whole number from 1 to 16,384, got"):
        Intrinsics.from_hfov(width, 48, hfov_deg=90)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda pose: np.diag([1, -1, 1, 1]) @ pose, "reflection"),
        (lambda pose: pose * 1.1, "last row"),
        (lambda pose: pose @ np.diag([1.1, 1.1, 1.1, 1]), "not orthonormal"),
        (lambda pose: np.where(np.eye(4) > 0, np.nan, pose), "NaN"),
        (lambda pose: pose[:3], "shape"),
    ],
)
def test_what_is_not_rigid_is_said_in_words(spoil, words):
    assert words in poses.rigidity_fault(spoil(one_pose(1, 2, 3, 0.3, 0.2)))


def test_wrapped_angles_stay_the_same_direction_within_half_a_turn():
    angles = np.linspace(-20, 20, 101)
    wrapped = poses.wrap_angle(angles)
    assert (np.abs(wrapped) <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-9)
