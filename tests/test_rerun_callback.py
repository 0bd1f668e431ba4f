import io

import gymnasium
import numpy as np
import pytest
from PIL import Image
from rrd import entities, rows, verify
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from tracking import SmallEnv, ppo

from avp_habitat.errors import UsageError
from avp_habitat.images import DEPTH_UNIT_M
from avp_habitat.poses import Intrinsics
from avp_sb3 import RerunCallback
from avp_sb3.finished_episodes import MissingInfoError
from avp_sb3.rerun_callback import RecordingError
from avp_sb3.rerun_episode import spread_indices


class Notes(BaseCallback):
    """The trajectories as they end."""

    def __init__(self):
        super().__init__()
        self.trajectories, self.env_steps = [], []

    def _on_step(self):
        ended = [info["avp_trajectory"] for info in self.locals["infos"] if "avp_trajectory" in info]
        self.trajectories += ended
        self.env_steps += [self.num_timesteps] * len(ended)
        return True


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """One training with two environments, of which every third episode is recorded with four pictures."""
    path = tmp_path_factory.mktemp("rerun") / "train.rrd"
    notes = Notes()
    callback = RerunCallback(path, every=3, max_share=1, pictures=4, width=32, height=20)
    ppo(DummyVecEnv([SmallEnv, SmallEnv])).learn(128, callback=[notes, callback])
    return path, notes


def test_recording_passes_reruns_own_check(recorded):
    verify(recorded[0])


def test_recording_has_the_entities_of_the_layout(recorded):
    parts = {"coverage", "spread", "step", "collision", "redundancy", "stop", "sum"}
    world = {"floor", "path", "views", "agent", "camera", "camera/rgb", "camera/depth"}
    expected = {"/world", "/plots/coverage", "/plots/action"}
    expected |= {f"/world/{name}" for name in world} | {f"/plots/reward/{name}" for name in parts}
    assert entities(recorded[0]) == expected


def test_every_third_episode_is_recorded_from_the_first(recorded):
    path, notes = recorded
    numbers = sorted({time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars", "episode")})
    assert numbers == list(range(1, len(notes.trajectories) + 1, 3))
    env_steps = sorted({time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars", "env_step")})
    assert env_steps == sorted(set(notes.env_steps[::3]))


def test_plots_hold_the_trajectories_one_after_the_other(recorded):
    path, notes = recorded
    kept = notes.trajectories[::3]
    for entity, values in {
        "/plots/coverage": np.concatenate([trajectory.coverage for trajectory in kept]),
        "/plots/action": np.concatenate([trajectory.action for trajectory in kept]),
        "/plots/reward/spread": np.concatenate([trajectory.reward_parts["spread"] for trajectory in kept]),
    }.items():
        found = rows(path, entity, "Scalars:scalars")
        assert [time for time, _ in found] == list(range(len(values)))
        np.testing.assert_allclose(np.concatenate([value for _, value in found]), values)


def test_camera_and_agent_stand_where_the_views_were_taken(recorded):
    path, notes = recorded
    poses = np.concatenate([trajectory.camera_to_world for trajectory in notes.trajectories[::3]])
    for entity in ("/world/agent", "/world/camera"):
        moved = rows(path, entity, "Transform3D:translation")
        turned = rows(path, entity, "Transform3D:mat3x3")
        assert len(moved) == len(turned) > 0
        for (time, position), (_, columns) in zip(moved, turned, strict=True):
            np.testing.assert_allclose(position, poses[time, :3, 3], atol=1e-6)
            np.testing.assert_allclose(columns.reshape(3, 3).T, poses[time, :3, :3], atol=1e-6)


def test_pinhole_has_the_pictures_size_and_habitats_axes(recorded):
    path, _ = recorded
    for entity in ("/world/agent", "/world/camera"):
        np.testing.assert_allclose(rows(path, entity, "Pinhole:resolution")[0][1], [32, 20])
        matrix = rows(path, entity, "Pinhole:image_from_camera")[0][1].reshape(3, 3).T
        np.testing.assert_allclose(matrix, Intrinsics.from_hfov(32, 20, hfov_deg=90).matrix)
        right, up, back = 3, 1, 6
        assert rows(path, entity, "Pinhole:camera_xyz")[0][1].tolist() == [right, up, back]


def test_floor_changes_with_what_was_seen(recorded):
    path, notes = recorded
    found = rows(path, "/world/floor", "Points3D:class_ids")
    first = notes.trajectories[0]
    mine = [(time, classes) for time, classes in found if time < len(first.action)]
    assert mine[0][0] == 0
    for time, classes in mine:
        assert classes.mean() == pytest.approx(first.coverage[time])
    assert mine[-1][1].tolist() == (first.first_seen > 0).tolist()
    assert len(rows(path, "/world/floor", "Points3D:positions")[0][1]) == 3 * len(first.first_seen)


def test_pictures_are_what_the_simulator_renders_at_those_poses(recorded):
    path, notes = recorded
    first = notes.trajectories[0]
    colour = [row for row in rows(path, "/world/camera/rgb", "EncodedImage:blob") if row[0] < len(first.action)]
    depth = [row for row in rows(path, "/world/camera/depth", "EncodedDepthImage:blob") if row[0] < len(first.action)]
    steps = spread_indices(len(first.action), 4)
    assert [time for time, _ in colour] == [time for time, _ in depth] == steps
    frames = SmallEnv().capture(first.camera_to_world[steps], Intrinsics.from_hfov(32, 20, hfov_deg=90))
    for index in range(len(steps)):
        rgb = np.asarray(Image.open(io.BytesIO(colour[index][1].astype(np.uint8).tobytes())))
        assert rgb.shape == (20, 32, 3)
        np.testing.assert_allclose(rgb, frames.rgb[index], atol=8)
        metres = np.asarray(Image.open(io.BytesIO(depth[index][1].astype(np.uint8).tobytes()))) * DEPTH_UNIT_M
        np.testing.assert_allclose(metres, frames.depth[index], atol=DEPTH_UNIT_M)


def test_a_full_file_takes_no_further_episode(tmp_path):
    path = tmp_path / "small.rrd"
    ppo().learn(64, callback=RerunCallback(path, every=1, max_share=1, pictures=0, max_bytes=1))
    verify(path)
    assert not rows(path, "/plots/coverage", "Scalars:scalars")


def test_a_second_training_writes_a_second_file(tmp_path):
    model, callback = ppo(), RerunCallback(tmp_path / "a.rrd", pictures=0)
    model.learn(64, callback=callback)
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert callback.path == tmp_path / "a-2.rrd"
    for name in ("a.rrd", "a-2.rrd"):
        assert rows(tmp_path / name, "/plots/coverage", "Scalars:scalars")


def test_an_existing_file_is_refused(tmp_path):
    (tmp_path / "a.rrd").write_text("mine")
    with pytest.raises(UsageError, match=r"a\.rrd: exists already"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd"))
    assert (tmp_path / "a.rrd").read_text() == "mine"


def test_an_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"file/a\.rrd: cannot write the recording there"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "file" / "a.rrd"))


def test_without_a_path_the_recording_lies_in_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = RerunCallback(pictures=0)
    ppo().learn(64, callback=callback)
    assert [str(path) for path in (tmp_path / "runs").glob("avp-*.rrd")] == [str(tmp_path / callback.path)]


@pytest.mark.parametrize(("option", "value"), [("every", 0), ("pictures", -1), ("width", 0)])
def test_numbers_that_cannot_be_right_are_refused(option, value):
    with pytest.raises(UsageError, match=rf"RerunCallback {option}: expected at least \d, got {value}"):
        RerunCallback(**{option: value})


def test_recording_keeps_to_its_share_of_the_time(tmp_path):
    path = tmp_path / "a.rrd"
    ppo().learn(128, callback=RerunCallback(path, every=1, max_share=1e-9, pictures=0))
    numbers = {time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars", "episode")}
    # The first episode is always recorded, and has used up the share for longer than this training takes.
    assert numbers == {1}
    with pytest.raises(UsageError, match=r"max_share: expected a number within \(0, 1\], got 0"):
        RerunCallback(max_share=0)


def test_an_environment_without_trajectories_is_named(tmp_path):
    with pytest.raises(MissingInfoError, match=r"RerunCallback: expected 'avp_trajectory' in info .*AVP-v0"):
        ppo(gymnasium.make("CartPole-v1")).learn(256, callback=RerunCallback(tmp_path / "a.rrd"))


@pytest.mark.parametrize(("count", "at_most", "chosen"), [(0, 3, []), (2, 3, [0, 1]), (5, 3, [0, 2, 4]), (5, 0, [])])
def test_indices_are_spread_from_the_first_to_the_last(count, at_most, chosen):
    assert spread_indices(count, at_most) == chosen
