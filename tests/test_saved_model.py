import os
import pickle
import re
import shutil
import struct
import sys
import zipfile
from collections import deque

import numpy as np
import pytest
import sb3_contrib
from corridor import Corridor
from mlflow import MlflowClient
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn, optim
from tracking import SETTINGS, SmallEnv, mlflow_home, ppo

from avp_habitat import collect, command
from avp_habitat.errors import PolicyError
from avp_habitat.policies.registry import described, load_model, make_policy, make_policy_env
from avp_habitat.policies.saved_model import check_harmless, statistics_of
from avp_sb3 import EvaluationCallback, MLflowCallback
from avp_sb3.callbacks.best_model import save_model

OBSERVATIONS = np.random.default_rng(0).normal(size=(40, 12)).astype(np.float32)


def normalised_ppo(**options):
    return ppo(VecNormalize(DummyVecEnv([SmallEnv] * 2)), n_steps=32, **options)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model of a normalised training beside its statistics, as `model.zip` and `statistics.pkl`."""
    folder = tmp_path_factory.mktemp("trained")
    model = normalised_ppo().learn(64)
    # Far from the observations, so that who ignores them acts otherwise.
    model.env.obs_rms.mean += 4.0
    model.save(folder / "model.zip")
    model.env.save(folder / "statistics.pkl")
    return folder


def put(trained, folder, model, statistics):
    for source, target in (("model.zip", model), ("statistics.pkl", statistics)):
        if target is not None:
            (folder / target).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(trained / source, folder / target)
    return folder / model


LAYOUTS = [
    ("norm2.zip", "norm2_vecnormalize.pkl"),
    ("ck/rl_model_6400_steps.zip", "ck/rl_model_vecnormalize_6400_steps.pkl"),
    ("ck/my_2_steps_600_steps.zip", "ck/my_2_steps_vecnormalize_600_steps.pkl"),
    ("logs/ppo/AVP-v0_1/AVP-v0.zip", "logs/ppo/AVP-v0_1/AVP-v0/vecnormalize.pkl"),
    ("logs/ppo/AVP-v0_12/best_model.zip", "logs/ppo/AVP-v0_12/AVP-v0/vecnormalize.pkl"),
    ("logs/ppo/my_1_env-v0_2_a3-f/rl_model_9_steps.zip", "logs/ppo/my_1_env-v0_2_a3-f/my_1_env-v0/vecnormalize.pkl"),
    ("hub/ppo-AVP-v0.zip", "hub/vec_normalize.pkl"),
    ("hub/ppo-AVP-v0.zip", "hub/vecnormalize.pkl"),
]


@pytest.mark.parametrize(("model", "statistics"), LAYOUTS)
def test_a_model_sees_observations_as_in_its_training(trained, tmp_path, model, statistics):
    path = put(trained, tmp_path, model, statistics)
    found = make_policy(str(path), SmallEnv(), 0).predict(OBSERVATIONS, deterministic=True)[0]
    alone = PPO.load(path, device="cpu")
    with (tmp_path / statistics).open("rb") as file:
        expected = alone.predict(pickle.load(file).normalize_obs(OBSERVATIONS), deterministic=True)[0]
    np.testing.assert_array_equal(found, expected)
    assert (found != alone.predict(OBSERVATIONS, deterministic=True)[0]).any()
    assert described(str(path)) == f"{path} with the statistics {tmp_path / statistics}"


def test_what_stable_baselines3_itself_writes_is_found(tmp_path):
    checkpoints = CheckpointCallback(32, str(tmp_path), name_prefix="walk", save_vecnormalize=True)
    normalised_ppo().learn(64, callback=checkpoints)
    assert statistics_of(tmp_path / "walk_64_steps.zip") == tmp_path / "walk_vecnormalize_64_steps.pkl"


def test_the_most_specific_statistics_are_used(trained, tmp_path):
    path = put(trained, tmp_path, "ck/rl_model_8_steps.zip", "ck/vec_normalize.pkl")
    put(trained, tmp_path, "ck/rl_model_8_steps.zip", "ck/rl_model_vecnormalize_8_steps.pkl")
    put(trained, tmp_path, "ck/rl_model_9_steps.zip", "ck/rl_model_vecnormalize_9_steps.pkl")
    assert statistics_of(path) == tmp_path / "ck/rl_model_vecnormalize_8_steps.pkl"


def test_missing_statistics_are_named_before_anything_is_made(trained, tmp_path, capfd):
    path = put(trained, tmp_path, "logs/AVP-v0_1/AVP-v0.zip", None)
    # Of another model, in a folder that is not this run's.
    put(trained, tmp_path, "logs/AVP-v0_1/AVP-v0.zip", "logs/AVP-v0_1/other/vecnormalize.pkl")
    words = ["--scene", "builtin:0", "--policy", str(path), "--out", str(tmp_path / "r")]
    assert command.run(collect.main, words) == 1
    error = capfd.readouterr().err
    assert "AVP-v0.zip: trained under VecNormalize" in error
    assert str(path.parent / "AVP-v0" / "vecnormalize.pkl") in error
    assert not (tmp_path / "r").exists()


def test_a_model_of_raw_observations_leaves_others_statistics_alone(trained, tmp_path):
    ppo().learn(64).save(tmp_path / "raw.zip")
    put(trained, tmp_path, "other.zip", "vec_normalize.pkl")
    assert statistics_of(tmp_path / "raw.zip") is None
    raw = PPO.load(tmp_path / "raw.zip", device="cpu").predict(OBSERVATIONS, deterministic=True)[0]
    policy = make_policy(str(tmp_path / "raw.zip"), SmallEnv(), 0)
    np.testing.assert_array_equal(policy.predict(OBSERVATIONS, deterministic=True)[0], raw)


def test_the_kind_of_observation_is_found_under_normalisation_too(tmp_path):
    ready = VecNormalize(DummyVecEnv([lambda: SmallEnv(observation="map")]))
    model = ppo(ready).learn(64)
    save_model(model, tmp_path / "map.zip")
    env, _ = make_policy_env(str(tmp_path / "map.zip"), Corridor(), SETTINGS)
    assert env.settings.observation == "map"
    (tmp_path / "map_vecnormalize.pkl").unlink()
    with pytest.raises(PolicyError, match=r"map\.zip: trained under VecNormalize"):
        make_policy_env(str(tmp_path / "map.zip"), Corridor(), SETTINGS)


def test_statistics_of_other_observations_are_refused(trained, tmp_path):
    path = put(trained, tmp_path, "m.zip", None)
    VecNormalize(DummyVecEnv([lambda: SmallEnv(observation="map")])).save(str(tmp_path / "m_vecnormalize.pkl"))
    with pytest.raises(PolicyError, match=r"m_vecnormalize\.pkl: .*for observations of shape \(12,\), found"):
        make_policy(str(path), SmallEnv(), 0)


@pytest.mark.parametrize("content", [b"", b"no pickle", pickle.dumps([1, 2]), pickle.dumps(np.ones(3))[:-9]])
def test_statistics_that_are_none_are_named(trained, tmp_path, content):
    path = put(trained, tmp_path, "m.zip", None)
    (tmp_path / "m_vecnormalize.pkl").write_bytes(content)
    with pytest.raises(PolicyError, match=r"m_vecnormalize\.pkl: expected the statistics of .*VecNormalize"):
        make_policy(str(path), SmallEnv(), 0)


def test_mlflow_keeps_the_statistics_with_the_model(tmp_path, monkeypatch):
    uri = mlflow_home(tmp_path, monkeypatch)
    callback = MLflowCallback()
    normalised_ppo().learn(64, callback=callback)
    path = MlflowClient(uri).download_artifacts(callback.run_id, "", str(tmp_path / "down"))
    assert statistics_of(tmp_path / "down" / "model.zip") == tmp_path / "down" / "model_vecnormalize.pkl"
    assert make_policy(f"{path}/model.zip", SmallEnv(), 0)


def test_the_best_model_of_an_evaluation_is_used_with_its_statistics(tmp_path):
    best = tmp_path / "best-now.zip"
    evaluation = EvaluationCallback(eval_env=DummyVecEnv([SmallEnv]), episodes=2, best_model=best)
    normalised_ppo().learn(64, callback=evaluation)
    assert statistics_of(best) == tmp_path / "best-now_vecnormalize.pkl"


class Runs:
    """Makes a folder when it is unpickled."""

    def __init__(self, path, how):
        self.path, self.how = path, how

    def __reduce__(self):
        if self.how == "eval":
            return eval, (f"__import__('os').mkdir({os.fspath(self.path)!r})",)
        return os.mkdir, (os.fspath(self.path),)


def with_lambda(path):
    return lambda progress: os.path.isdir(path) or 3e-4


@pytest.mark.parametrize("how", ["mkdir", "eval", "function"])
@pytest.mark.parametrize("where", ["_last_obs", "a_note"])
def test_a_model_that_would_run_code_is_not_opened(tmp_path, how, where):
    path, mark = tmp_path / "m.zip", tmp_path / "ran"
    model = ppo().learn(64)
    setattr(model, where, with_lambda(os.fspath(mark)) if how == "function" else Runs(mark, how))
    model.save(path)
    with pytest.raises(
        PolicyError, match=r"m\.zip: opening it would run code that it holds or names, found .*--trusted"
    ):
        make_policy(str(path), SmallEnv(), 0)
    assert not mark.exists()
    if how != "function":
        make_policy(str(path), SmallEnv(), 0, trusted=True)
        assert mark.exists()


@pytest.mark.parametrize("how", ["mkdir", "eval"])
def test_statistics_that_would_run_code_are_not_opened(trained, tmp_path, how):
    path, mark = put(trained, tmp_path, "m.zip", None), tmp_path / "ran"
    (tmp_path / "m_vecnormalize.pkl").write_bytes(pickle.dumps({"statistics": Runs(mark, how)}))
    with pytest.raises(PolicyError, match=r"m_vecnormalize\.pkl: opening it would run code"):
        make_policy(str(path), SmallEnv(), 0)
    assert not mark.exists()


@pytest.mark.parametrize("damage", ["bytes", "half", "list"])
def test_a_damaged_model_is_named(tmp_path, damage):
    model = ppo().learn(64)
    model.save(tmp_path / "whole.zip")
    with zipfile.ZipFile(tmp_path / "whole.zip") as whole, zipfile.ZipFile(tmp_path / "m.zip", "w") as changed:
        data = whole.read("data").decode()
        texts = {"bytes": data.replace('":serialized:": "', '":serialized:": "AAAA', 1), "half": data[: len(data) // 2]}
        for name in whole.namelist():
            changed.writestr(name, texts.get(damage, "[1]") if name == "data" else whole.read(name))
    with pytest.raises(PolicyError, match=r"m\.zip: expected a model of .*, could not load it"):
        make_policy(str(tmp_path / "m.zip"), SmallEnv(), 0)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"learning_rate": LinearSchedule(5e-4, 0.0, 1.0), "clip_range_vf": 0.2},
        {"policy_kwargs": {"net_arch": [8], "activation_fn": nn.ReLU}},
        {
            "policy_kwargs": {
                "activation_fn": nn.SELU,
                "optimizer_class": optim.NAdam,
                "net_arch": {"pi": [8], "vf": [8]},
            }
        },
        {"policy_kwargs": {"features_extractor_class": FlattenExtractor}},
        {"use_sde": False, "target_kl": 0.1, "stats_window_size": 5},
    ],
)
def test_models_as_trainings_write_them_are_opened(tmp_path, options):
    model = normalised_ppo(**options).learn(64)
    save_model(model, tmp_path / "m.zip")
    for name in ("m.zip", "m_vecnormalize.pkl"):
        check_harmless(tmp_path / name)
    assert make_policy(str(tmp_path / "m.zip"), SmallEnv(), 0)


def test_a_model_with_functions_as_schedules_acts_without_them(tmp_path):
    path, mark = tmp_path / "m.zip", tmp_path / "ran"
    model = ppo(clip_range=lambda progress: 0.2 * progress, clip_range_vf=lambda progress: 0.5)
    model.learn(64)
    model.learning_rate = model.lr_schedule = Runs(mark, "mkdir")
    model.save(path)
    found = make_policy(str(path), SmallEnv(), 0).predict(OBSERVATIONS, deterministic=True)[0]
    np.testing.assert_array_equal(found, model.predict(OBSERVATIONS, deterministic=True)[0])
    assert not mark.exists()
    # Who trains on needs them.
    with pytest.raises(PolicyError, match=r"m\.zip: opening it would run code"):
        load_model(path, env=model.env)
    assert not mark.exists()


class Forged:
    """Pickles as any call, and any state of what it returns."""

    def __init__(self, *how):
        self.how = how

    def __reduce__(self):
        return self.how


def addresses_as_objects():
    """An array of objects whose addresses are the pickle's own numbers: looking at one ends the process."""
    kind = Forged(np.dtype, ("O8", False, True), (3, "|", None, None, None, 8, 8, 0))
    content = struct.pack("<4Q", *[0x4141414141414141] * 4)
    array = Forged(np.ones(1).__reduce__()[0], (np.ndarray, (0,), b"b"), (1, (4,), kind, False, content))
    return pickle.dumps(Forged(deque, (array,)))


def another_class_attribute():
    return b"\x80\x04cstable_baselines3.common.utils\nLinearSchedule\nN}X\x04\x00\x00\x00evilK\x01s\x86b."


@pytest.mark.parametrize("make", [addresses_as_objects, another_class_attribute])
def test_looking_at_a_forged_pickle_makes_nothing(tmp_path, make):
    (tmp_path / "s.pkl").write_bytes(make())
    with pytest.raises(PolicyError, match=r"s\.pkl: expected the statistics"):
        check_harmless(tmp_path / "s.pkl")
    assert not hasattr(LinearSchedule, "evil")


OFF_POLICY = {"buffer_size": 64, "learning_starts": 8}


@pytest.mark.parametrize(
    ("kind", "policy", "options"),
    [
        (A2C, "MlpPolicy", {}),
        (DQN, "MlpPolicy", OFF_POLICY),
        (sb3_contrib.QRDQN, "MlpPolicy", OFF_POLICY),
        (sb3_contrib.TRPO, "MlpPolicy", {"n_steps": 8, "batch_size": 8}),
        (sb3_contrib.RecurrentPPO, "MlpLstmPolicy", {"n_steps": 8}),
        (sb3_contrib.ARS, "LinearPolicy", {"n_delta": 1}),
    ],
)
def test_a_model_of_each_algorithm_acts_as_it_was_saved(tmp_path, kind, policy, options):
    model = kind(policy, SmallEnv(), device="cpu", seed=0, **options).learn(16)
    model.save(tmp_path / "m.zip")
    loaded = make_policy(str(tmp_path / "m.zip"), SmallEnv(), 0)
    assert type(loaded) is kind
    found, expected = (each.predict(OBSERVATIONS, deterministic=True)[0] for each in (loaded, model))
    np.testing.assert_array_equal(found, expected)


def test_a_file_that_does_not_tell_its_algorithm_is_opened_by_its_name(tmp_path):
    ppo().learn(64).save(tmp_path / "whole.zip")
    with zipfile.ZipFile(tmp_path / "whole.zip") as whole, zipfile.ZipFile(tmp_path / "m.zip", "w") as changed:
        for name in whole.namelist():
            text = whole.read(name)
            changed.writestr(name, re.sub(rb'"(clip_range|gae_lambda)"', rb'"x_\1"', text) if name == "data" else text)
    with pytest.raises(PolicyError, match=r"m\.zip: .*found one of stable_baselines3.*if it is, say which, as PPO:"):
        make_policy(str(tmp_path / "m.zip"), SmallEnv(), 0)
    assert type(make_policy(f"PPO:{tmp_path}/m.zip", SmallEnv(), 0)) is PPO


def test_statistics_beside_an_off_policy_model_are_its_own(tmp_path):
    ready = VecNormalize(DummyVecEnv([SmallEnv]))
    DQN("MlpPolicy", ready, device="cpu", **OFF_POLICY).learn(16).save(tmp_path / "m.zip")
    assert statistics_of(tmp_path / "m.zip") is None
    ready.save(str(tmp_path / "m_vecnormalize.pkl"))
    assert statistics_of(tmp_path / "m.zip") == tmp_path / "m_vecnormalize.pkl"


def test_the_package_that_a_model_needs_is_named(tmp_path, monkeypatch):
    sb3_contrib.TRPO("MlpPolicy", SmallEnv(), device="cpu", n_steps=8, batch_size=8).save(tmp_path / "m.zip")
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(PolicyError, match=r"m\.zip: TRPO needs sb3_contrib; .* `pip install sb3-contrib`"):
        make_policy(str(tmp_path / "m.zip"), SmallEnv(), 0)
