import json
import math

import numpy as np
import pytest
from nerfstudio_room import picture, write_room

from avp_habitat import command
from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics, camera_to_world, rigidity_fault, y_up_to_z_up, yaw_and_pitch
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_nerfstudio.camera_path import CameraPath, camera_path, main, smooth_path

CAMERA = Intrinsics.from_hfov(32, 24, hfov_deg=80.0)


def l_shaped_walk():
    """2 m ahead, a quarter turn to the left on the spot, 1 m ahead; looking down, then up."""
    yaw = np.radians(np.concatenate([np.zeros(9), np.arange(10, 91, 10), np.full(4, 90)]))
    position = np.zeros((len(yaw), 3))
    position[:, 1] = 1.5
    position[:9, 2] = -0.25 * np.arange(9)
    position[9:, 2] = -2.0
    position[18:, 0] = -0.25 * np.arange(1, 5)
    return camera_to_world(position, yaw=yaw, pitch=np.linspace(-0.4, 0.2, len(yaw)))


def write_walk(folder, poses):
    with RolloutWriter(folder, CAMERA) as writer:
        for pose in poses:
            writer.add_frame(*picture(pose, CAMERA), pose)
        writer.publish({"scene": "a formula"})
    return folder


def distance_to_walk(points, walk):
    """Of `(m, 3)` points from the polyline through `(n, 3)` ones."""
    shares = np.linspace(0, 1, 50)[:, None, None]
    dense = (walk[:-1] * (1 - shares) + walk[1:] * shares).reshape(-1, 3)
    return np.linalg.norm(points[:, None] - dense, axis=-1).min(axis=1)


def speeds(poses):
    """Actions' worth of movement between neighbours."""
    yaw, pitch = yaw_and_pitch(poses)
    moves = np.column_stack([poses[:, :3, 3] / 0.25, np.unwrap(yaw) / np.radians(10), pitch / np.radians(10)])
    return np.linalg.norm(np.diff(moves, axis=0), axis=1)


def test_the_path_begins_and_ends_like_the_walk_and_stays_by_it():
    walk = l_shaped_walk()
    path = smooth_path(walk, 200)
    np.testing.assert_allclose(path[[0, -1]], walk[[0, -1]], atol=1e-9)
    assert distance_to_walk(path[:, :3, 3], walk[:, :3, 3]).max() < 0.1
    assert np.ptp(path[:, 1, 3]) < 1e-9


def test_the_camera_moves_at_constant_speed_and_without_jerks():
    path = smooth_path(l_shaped_walk(), 200)
    speed = speeds(path)
    assert speed.max() / speed.min() < 1.02
    turns = np.diff(np.unwrap(yaw_and_pitch(path)[0]))
    raw = np.diff(np.unwrap(yaw_and_pitch(l_shaped_walk())[0])).max()
    assert np.abs(np.diff(turns)).max() < 0.02 * raw


def test_the_camera_stays_upright_and_rigid():
    path = smooth_path(l_shaped_walk(), 50)
    assert np.abs(path[:, 1, 0]).max() < 1e-12
    assert all(rigidity_fault(pose) is None for pose in path)


def test_a_full_turn_goes_the_way_of_the_walk():
    yaw = np.radians(np.arange(0, 361, 10))
    path = smooth_path(camera_to_world(np.tile([0.0, 1.5, 0.0], (37, 1)), yaw=yaw, pitch=np.zeros(37)), 100)
    assert (np.diff(np.unwrap(yaw_and_pitch(path)[0])) > 0).all()


def test_nerfstudio_reads_the_path_as_the_dataparser_gives_the_poses(tmp_path):
    pytest.importorskip("nerfstudio")
    from nerfstudio.cameras.camera_paths import get_path_from_json

    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    walk = write_walk(tmp_path / "walk", l_shaped_walk())
    for scale in (1.0, 0.5):
        film = CameraPath(walk, tmp_path, seconds=2, fps=10, width=64, height=48, scale=scale)
        cameras = get_path_from_json(json.loads(json.dumps(camera_path(film))))
        given = AVPDataParserConfig(data=walk, scale=scale).setup().get_dataparser_outputs("train").cameras
        assert len(cameras) == 20
        for index in (0, -1):
            np.testing.assert_allclose(cameras.camera_to_worlds[index], given.camera_to_worlds[index], atol=1e-6)
        # Twice the pixels of the rollout's camera, so twice its focal length.
        assert cameras.fx.numpy() == pytest.approx(2 * float(given.fx[0]))
        assert cameras.fy.numpy() == pytest.approx(2 * float(given.fy[0]))
        assert (int(cameras.width[0]), int(cameras.height[0])) == (64, 48)


def test_another_shape_of_picture_keeps_the_vertical_field_of_view(tmp_path):
    walk = write_walk(tmp_path / "walk", l_shaped_walk())
    path = camera_path(CameraPath(walk, tmp_path, width=100, height=40))
    assert path["camera_path"][0]["fov"] == pytest.approx(math.degrees(2 * math.atan(12 / CAMERA.fy)))
    assert path["camera_path"][0]["aspect"] == 2.5


def test_the_command_writes_the_path_and_prints_what_renders_it(tmp_path, capsys):
    walk = write_walk(tmp_path / "walk", l_shaped_walk())
    out = tmp_path / "new folder" / "path.json"
    options = ["--seconds", "1.5", "--fps", "20", "--width", "320", "--height", "240"]
    assert command.run(main, [str(walk), "--out", str(out), *options]) == 0
    path = json.loads(out.read_text())
    assert (path["seconds"], path["fps"], path["render_width"], path["render_height"]) == (1.5, 20, 320, 240)
    matrices = np.array([camera["camera_to_world"] for camera in path["camera_path"]]).reshape(-1, 4, 4)
    assert len(matrices) == 30
    np.testing.assert_allclose(matrices[-1], y_up_to_z_up(read_rollout(walk).frames[-1].camera_to_world), atol=1e-6)
    printed = capsys.readouterr().out
    assert f"{out}: 30 cameras, 1.5 s at 20 pictures per second" in printed
    assert f"ns-render camera-path --load-config CONFIG --camera-path-filename '{out}' --output-path" in printed


@pytest.mark.parametrize("poses", [[], l_shaped_walk()[:1], [l_shaped_walk()[0]] * 3], ids=["none", "one", "the same"])
def test_a_camera_that_never_moves_has_no_path(tmp_path, poses):
    walk = write_walk(tmp_path / "walk", poses)
    with pytest.raises(RolloutError, match=rf"walk: expected frames from at least two places.*\({len(poses)} frames\)"):
        camera_path(CameraPath(walk, tmp_path))


@pytest.mark.parametrize(
    ("options", "code", "text"),
    [
        (["--seconds", "0"], 2, "--seconds: expected at least two pictures' worth"),
        (["--seconds", "nan"], 2, "--seconds: expected a number from 0 to 3,600"),
        (["--seconds", "0.01"], 2, "--seconds: expected"),
        (["--fps", "0"], 2, "--fps: expected a whole number from 1 to 240"),
        (["--width", "4"], 2, "--width: expected a whole number from 8 to 8,192, got 4"),
        (["--scale", "-1"], 2, "--scale: expected a number from 1e-06"),
        (["--out", "{room}/rollout.json"], 2, "rollout.json: exists already"),
        (["--out", "{room}/rollout.json/path.json"], 2, "path.json: cannot write there"),
    ],
)
def test_impossible_options_end_in_one_line(tmp_path, capsys, options, code, text):
    room = write_room(tmp_path / "room", frames=2, heldout=0)
    words = [str(room), "--out", str(tmp_path / "a.json"), *(word.format(room=room) for word in options)]
    assert command.run(main, words) == code
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.json").exists()


def test_a_rollout_that_is_none_is_named(tmp_path, capsys):
    assert command.run(main, [str(tmp_path / "nothing"), "--out", str(tmp_path / "a.json")]) == 1
    assert "nothing: expected a rollout folder" in capsys.readouterr().err
