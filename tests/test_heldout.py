"""The held-out views: the standard ones never move, the observable ones show only what can be seen from elsewhere."""

import hashlib
import json

import numpy as np
import pytest
import trimesh

from avp_habitat import collect, command
from avp_habitat.errors import SceneError
from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.rollout.format import read_rollout
from avp_habitat.sight.heldout import heldout_poses, observable_poses
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TaskSettings

SETTINGS = TaskSettings()


@pytest.fixture(scope="module")
def room():
    return open_simulator(SimulatorChoice(), "builtin:0")


def pitches(poses):
    """Degrees, positive up: of the direction -Z of each camera."""
    return np.degrees(np.arcsin(-poses[:, 1, 2]))


def test_the_standard_views_are_the_ones_that_they_always_were(room):
    poses = heldout_poses(room, sensor_height_m=1.5)
    assert hashlib.sha256(np.round(poses, 6).tobytes()).hexdigest()[:16] == "a5a3403cff4bfd9b"
    assert np.abs(pitches(poses)).max() <= 20


def test_the_observable_views_are_the_same_always_and_look_up_and_down(room):
    poses = observable_poses(room, SETTINGS)
    again = observable_poses(open_simulator(SimulatorChoice(), "builtin:0"), SETTINGS)
    assert np.array_equal(poses, again)
    assert poses.shape == (20, 4, 4)
    assert np.abs(pitches(poses)).max() <= 45
    assert (np.abs(pitches(poses)) > 20).sum() >= 5


def test_trimesh_too_finds_that_observable_views_show_what_can_be_seen_from_elsewhere(room):
    mesh = room.surface_mesh()
    rays = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).ray
    eyes = room.area.centres[:: max(1, len(room.area.centres) // 40)] + [0, SETTINGS.sensor_height_m, 0]
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=90.0)
    poses = observable_poses(room, SETTINGS, views=6)
    depth = room.render(poses, camera, rgb=False).depth
    points = np.einsum("nij,nhwj->nhwi", poses[:, :3, :3], pixel_directions(camera) * depth[..., None])
    points = (points + poses[:, None, None, :3, 3])[depth > 0]
    times = np.zeros(len(points))
    for eye in eyes:
        ray = points - eye
        length = np.linalg.norm(ray, axis=1)
        found, which, _ = rays.intersects_location(
            np.tile(eye, (len(points), 1)), ray / length[:, None], multiple_hits=False
        )
        hit = np.full(len(points), np.inf)
        hit[which] = np.linalg.norm(found - eye, axis=1)
        times += (hit >= length - SETTINGS.tolerance_m) & (length <= SETTINGS.max_range_m)
    assert (times >= 1).mean() >= 0.95


def test_what_only_few_places_see_is_in_no_observable_view(room):
    # With a range of less than the room's height nothing is seen from elsewhere but what is near.
    with pytest.raises(SceneError, match="held-out views that show what can be seen from elsewhere too"):
        observable_poses(room, TaskSettings(max_range_m=0.4), views=2)


def test_a_rollout_says_which_kind_it_holds_and_holds_it(room, tmp_path):
    words = ["--scene", "builtin:0", "--policy", "spin", "--budget", "3", "--width", "32", "--height", "24"]
    for kind in ("standard", "observable"):
        out = tmp_path / kind
        assert command.run(collect.main, [*words, "--heldout", kind, "--out", str(out)]) == 0
        assert json.loads((out / "rollout.json").read_text())["heldout"]["kind"] == kind
        wanted = {
            "standard": heldout_poses(room, sensor_height_m=1.5),
            "observable": observable_poses(room, SETTINGS),
        }[kind]
        kept = np.stack([view.camera_to_world for view in read_rollout(out).heldout])
        assert np.allclose(kept, wanted, atol=1e-6)


def test_another_kind_is_refused(tmp_path, capsys):
    words = ["--scene", "builtin:0", "--policy", "spin", "--out", str(tmp_path / "r"), "--heldout", "some"]
    assert command.run(collect.main, words) == 2
    assert "heldout" in capsys.readouterr().err
