import io
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import rerun as rr
from corridor import ROOM, WALL
from PIL import Image
from rerun.chunk import RrdReader
from rrd import chunks, entities, rows, verify
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from tracking import SmallEnv, ppo

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.images import DEPTH_UNIT_M
from avp_sb3 import RerunCallback
from avp_sb3.callbacks.base import MissingInfoError
from avp_sb3.callbacks.rerun import RecordingError
from avp_sb3.rerun.episode import RecordedEpisode, log_episode, spread_indices


class Notes(BaseCallback):
    """The trajectories as they end."""

    def __init__(self):
        super().__init__()
        self.trajectories, self.episodes, self.env_steps = [], [], []

    def _on_step(self):
        ended = [info["avp_trajectory"] for info in self.locals["infos"] if "avp_trajectory" in info]
        self.trajectories += ended
        self.episodes += [info["avp_episode"] for info in self.locals["infos"] if "avp_episode" in info]
        self.env_steps += [self.num_timesteps] * len(ended)
        return True


def static(path, entity, component):
    """The only value that an entity has at all times."""
    found = []
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names and "step" not in batch.schema.names:
            found += batch.column(component).to_pylist()
    assert len(found) == 1
    return np.array(found[0])


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
    parts = {"coverage", "spread", "step", "collision", "redundancy", "stop"}
    world = {"room", "floor", "path", "views", "agent", "camera", "camera/rgb", "camera/depth"}
    expected = {"/world", "/plots/coverage", "/plots/action", "/plots/reward/sum"}
    expected |= {f"/world/{name}" for name in world} | {f"/plots/reward/{name}" for name in parts}
    figures = {"coverage", "views", "annd_m", "ei", "path_length_m", "collisions", "redundant_views", "stopped"}
    expected |= {f"/metrics/{name}" for name in figures} | {f"/metrics/return/{name}" for name in parts}
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
        np.testing.assert_allclose(static(path, entity, "Pinhole:resolution").ravel(), [32, 20])
        matrix = static(path, entity, "Pinhole:image_from_camera").reshape(3, 3).T
        np.testing.assert_allclose(matrix, Intrinsics.from_hfov(32, 20, hfov_deg=90).matrix)
        right, up, back = 3, 1, 6
        assert static(path, entity, "Pinhole:camera_xyz").ravel().tolist() == [right, up, back]


def test_the_world_is_right_handed_with_y_up(recorded):
    right, up, back = 3, 1, 6
    assert static(recorded[0], "/world", "ViewCoordinates:xyz").ravel().tolist() == [right, up, back]


def test_floor_changes_with_what_was_seen(recorded):
    path, notes = recorded
    found = rows(path, "/world/floor", "Points3D:colors")
    first = notes.trajectories[0]
    mine = [(time, colours == 0x35B779FF) for time, colours in found if time < len(first.action)]
    assert mine[0][0] == 0
    for time, observed in mine:
        assert observed.mean() == pytest.approx(first.coverage[time])
    assert mine[-1][1].tolist() == (first.first_seen > 0).tolist()
    np.testing.assert_allclose(static(path, "/world/floor", "Points3D:positions"), SmallEnv().area.centres, atol=1e-6)


def test_the_room_lies_on_the_corridors_walls_and_floor(recorded):
    points = static(recorded[0], "/world/room", "Points3D:positions")
    assert len(points) > 1000
    faces = np.abs(np.concatenate([points[..., None] - ROOM.T, points[..., None] - WALL.T], axis=-1))
    assert np.quantile(faces.min(axis=(1, 2)), 0.99) < 0.05
    # Both sides of the dividing wall and its whole length are there, the ceiling is not.
    assert np.ptp(points, axis=0) == pytest.approx([6, 1.8, 3], abs=0.15)


def test_figures_of_every_episode_are_curves(recorded):
    path, notes = recorded
    for name, key in (("coverage", "coverage"), ("views", "views"), ("return/spread", "return_spread")):
        found = rows(path, f"/metrics/{name}", "Scalars:scalars", "episode")
        assert [time for time, _ in found] == list(range(1, len(notes.episodes) + 1))
        np.testing.assert_allclose([value[0] for _, value in found], [episode[key] for episode in notes.episodes])
    env_steps = [time for time, _ in rows(path, "/metrics/coverage", "Scalars:scalars", "env_step")]
    assert env_steps == notes.env_steps
    # On the time line of the recorded steps stand the recorded episodes, at their last view.
    ends = np.cumsum([len(trajectory.action) for trajectory in notes.trajectories[::3]]) - 1
    found = rows(path, "/metrics/coverage", "Scalars:scalars", "step")
    assert [time for time, _ in found if time is not None] == ends.tolist()


def test_pictures_are_what_the_simulator_renders_at_those_poses(recorded):
    path, notes = recorded
    first = notes.trajectories[0]
    colour = [row for row in rows(path, "/world/camera/rgb", "EncodedImage:blob") if row[0] < len(first.action)]
    depth = [row for row in rows(path, "/world/camera/depth", "EncodedDepthImage:blob") if row[0] < len(first.action)]
    steps = spread_indices(len(first.action), 4)
    assert [time for time, _ in colour] == [time for time, _ in depth] == steps
    frames = SmallEnv().capture(first.camera_to_world[steps], Intrinsics.from_hfov(32, 20, hfov_deg=90))
    assert frames.rgb is not None
    for index in range(len(steps)):
        rgb = np.asarray(Image.open(io.BytesIO(colour[index][1].astype(np.uint8).tobytes())))
        assert rgb.shape == (20, 32, 3)
        np.testing.assert_allclose(rgb, frames.rgb[index], atol=8)
        metres = np.asarray(Image.open(io.BytesIO(depth[index][1].astype(np.uint8).tobytes()))) * DEPTH_UNIT_M
        np.testing.assert_allclose(metres, frames.depth[index], atol=DEPTH_UNIT_M)


def test_a_file_stays_within_its_size_and_says_so_once(tmp_path, capsys):
    path, bound = tmp_path / "small.rrd", 600_000
    ppo().learn(256, callback=RerunCallback(path, every=1, max_share=1, max_bytes=bound))
    verify(path)
    assert 1 < len({time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars", "episode")}) < 32
    assert 0.5 * bound < path.stat().st_size <= 1.25 * bound
    said = capsys.readouterr().err
    assert said.count(f"small.rrd: has reached max_bytes ({bound}); nothing further is recorded") == 1


def test_a_file_without_room_takes_no_episode(tmp_path):
    path = tmp_path / "small.rrd"
    ppo().learn(64, callback=RerunCallback(path, every=1, max_share=1, pictures=0, max_bytes=1))
    verify(path)
    assert entities(path) == set()


def test_a_second_training_writes_a_second_file(tmp_path):
    model, callback = ppo(), RerunCallback(tmp_path / "a.rrd", pictures=0)
    model.learn(64, callback=callback)
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert callback.path == tmp_path / "a-2.rrd"
    for name in ("a.rrd", "a-2.rrd"):
        assert rows(tmp_path / name, "/plots/coverage", "Scalars:scalars")
    # With equal ids, a viewer that opens both would show them as one.
    ids = {RrdReader(tmp_path / name).recordings()[0].recording_id for name in ("a.rrd", "a-2.rrd")}
    assert len(ids) == 2


def test_an_existing_file_is_refused(tmp_path):
    (tmp_path / "a.rrd").write_text("mine")
    with pytest.raises(UsageError, match=r"a\.rrd: exists already"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd"))
    assert (tmp_path / "a.rrd").read_text() == "mine"


def test_an_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"file/a\.rrd: cannot write there"):
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


class Bare(gymnasium.Wrapper):
    """An environment of somebody else, which reports trajectories and nothing else."""

    def __init__(self, env, hidden=("area", "capture", "scene_name", "settings"), figures=True):
        super().__init__(env)
        self.hidden, self.figures = hidden, figures

    def get_wrapper_attr(self, name):
        if name in self.hidden:
            raise AttributeError(name)
        return super().get_wrapper_attr(name)

    def step(self, action):
        *outcome, info = self.env.step(action)
        if not self.figures:
            info.pop("avp_episode", None)
        return *outcome, info


@pytest.mark.parametrize(
    ("hidden", "lost", "said"),
    [
        (("area", "capture", "scene_name", "settings"), {"room", "floor", "camera"}, ("'area'", "'capture'")),
        (("capture",), {"room", "camera"}, ("'capture'",)),
        (("area",), {"room", "floor"}, ("'area'",)),
    ],
)
def test_environments_without_area_or_pictures_are_recorded_without_them(tmp_path, capsys, hidden, lost, said):
    path = tmp_path / "a.rrd"
    callback = RerunCallback(path, every=1, max_share=1, pictures=1, width=16, height=12)
    ppo(Bare(SmallEnv(), hidden)).learn(64, callback=callback)
    verify(path)
    world = {entity.split("/")[2] for entity in entities(path) if entity.startswith("/world/")}
    assert world == {"room", "floor", "camera", "path", "views", "agent"} - lost
    lines = [line for line in capsys.readouterr().err.splitlines() if "the environment has no" in line]
    assert [name for name in ("'area'", "'capture'") if any(name in line for line in lines)] == sorted(said)
    assert len(lines) == len(said)


def test_environments_without_figures_are_recorded_without_curves(tmp_path, capsys):
    path = tmp_path / "a.rrd"
    ppo(Bare(SmallEnv(), (), figures=False)).learn(64, callback=RerunCallback(path, pictures=0))
    assert rows(path, "/plots/coverage", "Scalars:scalars")
    assert not [entity for entity in entities(path) if entity.startswith("/metrics")]
    assert capsys.readouterr().err.count("no 'avp_episode' in info at the end of an episode") == 1


class OtherScene(SmallEnv):
    @property
    def scene_name(self):
        return "other (2)"


def test_each_of_several_scenes_has_its_own_room(tmp_path):
    path = tmp_path / "a.rrd"
    envs = DummyVecEnv([SmallEnv, OtherScene])
    callback = RerunCallback(path, every=1, max_share=1, pictures=1, width=16, height=12)
    ppo(envs).learn(128, callback=callback)
    verify(path)
    names = {f"/{rr.escape_entity_path_part(name)}" for name in envs.get_attr("scene_name")}
    assert len(names) == 2
    assert {entity.rpartition("/world/room")[0] for entity in entities(path) if "room" in entity} == names
    numbers = [{time for time, _ in rows(path, f"{name}/plots/coverage", "Scalars:scalars")} for name in names]
    assert not numbers[0] & numbers[1]
    assert sorted(numbers[0] | numbers[1]) == list(range(len(numbers[0] | numbers[1])))


class After90Steps(BaseCallback):
    def __init__(self, action):
        super().__init__()
        self.action = action

    def _on_step(self):
        if self.n_calls == 90:
            self.action()
        return True


def recorder(path):
    return RerunCallback(path, every=1, max_share=1, pictures=1, width=32, height=24)


def recorded_episodes(path, entity="/plots/coverage"):
    return {time for time, _ in rows(path, entity, "Scalars:scalars", "episode")}


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_during_a_training_the_file_has_the_episodes_before(tmp_path):
    path, copy = tmp_path / "a.rrd", tmp_path / "copy.rrd"
    ppo().learn(128, callback=[recorder(path), After90Steps(lambda: shutil.copy(path, copy))])
    numbers = recorded_episodes(copy)
    # 90 steps are eleven episodes of at most 8 steps, all of them recorded.
    assert numbers == set(range(1, len(numbers) + 1))
    assert 11 <= len(numbers) < len(recorded_episodes(path))


def test_an_interrupted_training_is_finished_by_closing_the_callback(tmp_path):
    path = tmp_path / "a.rrd"
    callback = recorder(path)

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ppo().learn(128, callback=[callback, After90Steps(interrupt)])
    callback.close()
    verify(path)
    assert recorded_episodes(path) == recorded_episodes(path, "/metrics/coverage") != set()


def run_training(path, how):
    """A training in a process of its own, in the way of `how`; what it printed."""
    command = [sys.executable, "-c", _TRAINING, str(path), how]
    return subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=300)


_TRAINING = """
import os, signal, sys
from stable_baselines3.common.callbacks import BaseCallback
from tracking import ppo
from avp_sb3 import RerunCallback

path, how = sys.argv[1:]

class End(BaseCallback):
    def _on_step(self):
        if self.n_calls == 90 and how == "SIGKILL":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.n_calls == 90 and how == "Ctrl-C":
            raise KeyboardInterrupt
        return True

recorder = RerunCallback(path, every=1, max_share=1, pictures=1, width=32, height=24)
ppo().learn(400, callback=[recorder, End()])
print("done")
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_killed_training_leaves_a_file_with_the_episodes_before(tmp_path):
    path = tmp_path / "a.rrd"
    assert run_training(path, "SIGKILL").returncode == -signal.SIGKILL
    steps = [time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars")]
    # 90 steps are eleven episodes of at most 8 steps, all of them recorded.
    episodes = {time for time, _ in rows(path, "/plots/coverage", "Scalars:scalars", "episode")}
    assert episodes == set(range(1, len(episodes) + 1))
    assert len(episodes) >= 11
    assert steps == list(range(len(steps)))
    assert len(steps) > 90 - 8


@pytest.mark.slow
def test_an_interrupted_training_leaves_a_whole_file(tmp_path):
    path = tmp_path / "a.rrd"
    assert "KeyboardInterrupt" in run_training(path, "Ctrl-C").stderr
    verify(path)
    episodes = [
        {time for time, _ in rows(path, name, "Scalars:scalars", "episode")}
        for name in ("/plots/coverage", "/metrics/coverage")
    ]
    assert episodes[0] == episodes[1] != set()


def test_a_disk_that_is_nearly_full_is_left_alone_and_the_training_goes_on(tmp_path, monkeypatch, capsys):
    left = iter([10**9] * 6)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(left, 10**7)))
    ppo().learn(128, callback=recorder(tmp_path / "a.rrd"))
    verify(tmp_path / "a.rrd")
    episodes = recorded_episodes(tmp_path / "a.rrd")
    assert episodes == set(range(1, len(episodes) + 1)) != set()
    assert len(episodes) < 8
    assert capsys.readouterr().err.count("a.rrd: the disk has less than 100 MB left; nothing is recorded") == 1


def test_on_a_large_floor_the_colours_change_less_often():
    cells, steps = 50_000, 80
    first_seen = np.arange(cells) % (steps + 1)
    poses = np.tile(np.eye(4), (steps, 1, 1))
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=90)
    episode = RecordedEpisode(poses, poses[:, :3, 3], camera, {}, {}, np.zeros((cells, 3)), first_seen)
    recording = rr.RecordingStream("avp", recording_id="large")
    memory = recording.memory_recording()
    log_episode(recording, "", episode, times={"episode": 1})
    assert len(memory.drain_as_bytes()) < 2_000_000
