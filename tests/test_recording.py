import hashlib
from contextlib import suppress

import gymnasium
import numpy as np
import pytest

from avp_habitat import command
from avp_habitat.collect import main as collect
from avp_habitat.errors import UsageError
from avp_habitat.policies.reactive import RandomPolicy
from avp_habitat.rollout.capture import RecordRollout
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.env import AVPEnv

SMALL = {"width": 16, "height": 12}


def make(**options):
    return gymnasium.make("avp_habitat:AVP-v0", scene="builtin:0", budget=4, **SMALL, **options)


def run(env, *, seed=None, steps=4):
    policy = RandomPolicy(0)
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        observation, *_ = env.step(int(policy.predict(observation)[0]))


def pictures(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "rollout.json"
    }


def test_a_recorded_episode_is_the_folder_that_collect_writes(tmp_path):
    run(make(record=tmp_path / "recorded", record_options=SMALL), seed=0)
    words = ["--scene", "builtin:0", "--policy", "random", "--budget", "4", "--width", "16", "--height", "12"]
    assert command.run(collect, [*words, "--out", str(tmp_path / "collected")]) == 0
    assert pictures(tmp_path / "recorded") == pictures(tmp_path / "collected")
    recorded, collected = (read_rollout(tmp_path / name).meta for name in ("recorded", "collected"))
    for key in ("scene", "reward", "budget", "metrics", "camera", "coverage", "seed", "counts"):
        assert recorded[key] == collected[key]


def test_recording_changes_nothing_else(tmp_path):
    plain, recorded = make(), make(record=tmp_path / "r", record_options={**SMALL, "heldout": 0})
    np.testing.assert_array_equal(plain.reset(seed=3)[0], recorded.reset(seed=3)[0])
    for action in (1, 0, 4, 0):
        ours, theirs = plain.step(action), recorded.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:4] == theirs[1:4]


def test_later_episodes_have_numbered_folders_and_the_rest_is_not_recorded(tmp_path, capsys):
    env = make(record=tmp_path / "r", record_options={**SMALL, "heldout": 1, "episodes": 2, "policy": "mine"})
    for _ in range(3):
        run(env)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r", "r-2"]
    meta = read_rollout(tmp_path / "r-2").meta
    assert (meta["policy"], meta["seed"]) == ({"name": "mine"}, None)
    assert "r-2: 4 views, coverage" in capsys.readouterr().out


@pytest.mark.parametrize("leave", [lambda env: env.close(), lambda env: None], ids=["closed", "forgotten"])
def test_an_abandoned_episode_leaves_no_folder(tmp_path, leave):
    env = make(record=tmp_path / "r", record_options={**SMALL})
    run(env, steps=2)
    assert [path.name.startswith(".r.partial") for path in tmp_path.iterdir()] == [True]
    leave(env)
    del env
    assert list(tmp_path.iterdir()) == []


def test_a_failing_disk_is_one_error_and_leaves_nothing(tmp_path, monkeypatch):
    env = make(record=tmp_path / "r", record_options={**SMALL})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("avp_habitat.rollout.images.write_rgb", full)
    # Pictures are written in threads: one of the next steps reports the error, the last one at the latest.
    with pytest.raises(Exception, match="r: cannot write there: No space left"):
        run(env)
    assert list(tmp_path.iterdir()) == []


def test_wrong_recordings_are_refused_before_any_episode(tmp_path):
    (tmp_path / "there").mkdir()
    for options, words in (
        ({"record": tmp_path / "there"}, "there: exists already"),
        ({"record": tmp_path / "r", "record_options": {"episodes": 0}}, "episodes: expected at least 1, got 0"),
        ({"record_options": {"episodes": 2}}, "expected a folder as `record`"),
    ):
        with pytest.raises(UsageError, match=words):
            make(**options)
    with pytest.raises(UsageError, match="expected an AVPEnv, got CartPole"):
        RecordRollout(gymnasium.make("CartPole-v1"), tmp_path / "r")


def test_gymnasium_still_knows_the_render_modes_and_the_environment():
    env = make(render_mode="rgb_array")
    assert isinstance(env.unwrapped, AVPEnv)
    env.reset(seed=0)
    assert env.render().dtype == np.uint8
    # Gymnasium wraps an environment for a window only where it knows that it renders pictures.
    with pytest.warns(UserWarning, match="HumanRendering"), suppress(gymnasium.error.DependencyNotInstalled):
        make(render_mode="human")
