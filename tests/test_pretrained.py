import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import sb3_contrib
import torch
from corridor import Corridor
from gymnasium.spaces import Box, Dict
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn
from tracking import SETTINGS, SmallEnv, ppo

from avp_experiment.configuration import chosen_methods
from avp_habitat import collect, command
from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.policies import weights
from avp_habitat.policies.registry import described, make_policy, make_policy_env
from avp_habitat.policies.weights.format import write_weights
from avp_habitat.policies.weights.policy import PretrainedPolicy
from avp_habitat.rollout.format import read_rollout
from avp_sb3 import AVPVecEnv, export, pretrained
from avp_sb3.callbacks.best_model import save_model
from avp_sb3.evaluation.batch import run_batch
from avp_sb3.exchange.sb3 import note_training, started_ppo, weights_of
from avp_sb3.train import Train

OBSERVATIONS = SmallEnv().observation_space
DRAWN = np.random.default_rng(0).uniform(OBSERVATIONS.low, OBSERVATIONS.high, (200, 12)).astype(np.float32)


def normalised(**options):
    model = ppo(VecNormalize(DummyVecEnv([SmallEnv] * 2)), n_steps=32, **options).learn(64)
    # Statistics that nothing can be mistaken for, one of them of a number that never changed.
    model.env.obs_rms.mean = np.linspace(-0.5, 0.5, 12)
    model.env.obs_rms.var = np.append(np.linspace(0.01, 2, 11), 0.0)
    model.env.obs_rms.count = 640.5
    return model


def shaped(net_arch, activation):
    # Far from SB3's start, where all actions are nearly alike.
    model = A2C(
        "MlpPolicy", SmallEnv(), device="cpu", policy_kwargs={"net_arch": net_arch, "activation_fn": activation}
    )
    with torch.no_grad():
        model.policy.action_net.weight.mul_(100)
    return model


MODELS = {
    "ppo": ppo,
    "normalised": normalised,
    "silu": lambda: shaped({"pi": [20, 10], "vf": [7]}, nn.SiLU),
    "elu": lambda: shaped([16], nn.ELU),
    "leaky": lambda: shaped([16, 8], nn.LeakyReLU),
    "linear": lambda: shaped([], nn.ReLU),
}


def logits_of(model, observations):
    """The network's own, before the distribution is normalised."""
    if (seen := model.get_vec_normalize_env()) is not None:
        observations = seen.normalize_obs(observations)
    with torch.no_grad():
        latent = model.policy.mlp_extractor.forward_actor(torch.as_tensor(observations))
        return model.policy.action_net(latent).numpy()


def exported(model, folder, *words):
    save_model(model, folder / "m.zip")
    assert command.run(export.main, [str(folder / "m.zip"), "--out", str(folder / "out"), *words]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The exported normalised model; `m.zip` lies above."""
    return exported(normalised(), tmp_path_factory.mktemp("exported"))


@pytest.mark.parametrize("kind", MODELS)
def test_numpy_and_onnx_give_the_models_own_logits_and_actions(kind, tmp_path):
    model = MODELS[kind]()
    out, expected = exported(model, tmp_path, "--onnx"), logits_of(model, DRAWN)
    policy = make_policy(str(out), SmallEnv(), 0)
    np.testing.assert_allclose(policy.logits(DRAWN), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(policy.predict(DRAWN, deterministic=True)[0], expected.argmax(axis=1))
    one, state = policy.predict(DRAWN[3], "kept", deterministic=True)
    assert (one.shape, int(one), state) == ((), expected[3].argmax(), "kept")
    session = onnxruntime.InferenceSession(str(out / "m.onnx"), providers=["CPUExecutionProvider"])
    for batch in (DRAWN, DRAWN[:1]):
        found = session.run(["logits"], {"observation": batch})[0]
        np.testing.assert_allclose(found, logits_of(model, batch), rtol=1e-5, atol=1e-5)


def test_the_files_act_where_pickle_and_torch_are_forbidden(folder):
    code = f"""
import pickle, sys
def forbidden(*_, **__): raise AssertionError("pickle")
pickle.load = pickle.loads = pickle.Unpickler = pickle._Unpickler = forbidden
sys.modules["torch"] = sys.modules["stable_baselines3"] = None
import numpy as np
from avp_habitat.policies.weights.format import write_weights
from avp_habitat.policies.weights.policy import PretrainedPolicy
print(PretrainedPolicy.load({str(folder)!r}).predict(np.zeros((4, 12)), deterministic=True)[0].tolist())
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    expected = PretrainedPolicy.load(str(folder)).predict(np.zeros((4, 12)), deterministic=True)[0]
    assert json.loads(ran.stdout) == expected.tolist()


def test_sampled_actions_are_as_likely_as_the_logits_say_and_repeat_by_seed(tmp_path):
    policy = PretrainedPolicy(weights_of(shaped([8], nn.Tanh), "m"), seed=5)
    many = np.repeat(DRAWN[:1], 20_000, axis=0)
    first = policy.predict(many)[0]
    likely = np.exp(policy.logits(many[:1])[0].astype(float))
    np.testing.assert_allclose(np.bincount(first, minlength=6) / len(many), likely / likely.sum(), atol=0.02)
    policy.set_random_seed(5)
    np.testing.assert_array_equal(policy.predict(many)[0], first)


def changed(path, **facts):
    path.write_text(json.dumps(json.loads(path.read_text()) | facts))


def tampered(path):
    numbers = path.with_suffix(".safetensors")
    content = bytearray(numbers.read_bytes())
    content[-1] ^= 1
    numbers.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: changed(path, format=2), r"m\.json: expected format 1 .*, found 2"),
        (tampered, r"m\.safetensors: expected the SHA-256 \w{64} of m\.json, found \w{64}"),
        (
            lambda path: changed(path, actor=[{"inputs": 12, "outputs": 6, "activation": None}]),
            "actor.0.weight of shape",
        ),
        (
            lambda path: changed(path, observation={"kind": "numbers", "shape": [13]}),
            r"actor\.0\.weight of shape \(64, 13\), found \(64, 12\)",
        ),
        (lambda path: path.with_suffix(".safetensors").unlink(), "expected one NAME.json .* found none"),
        (lambda path: path.write_text("{}"), r"m\.json: expected a policy as `python -m avp_sb3.export` writes it"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, damage, message):
    out = exported(ppo(), tmp_path)
    damage(out / "m.json")
    with pytest.raises(PolicyError, match=message) as error:
        make_policy(str(out), SmallEnv(), 0)
    assert "\n" not in str(error.value)


def test_a_policy_for_other_observations_or_that_is_not_there_is_refused(folder, tmp_path, monkeypatch):
    with pytest.raises(
        PolicyError, match=r"made for the observation 'numbers' of shape \(12,\), .* 'map' of \(1213,\)"
    ):
        make_policy_env(str(folder), Corridor(), SETTINGS, observation="map")
    with pytest.raises(PolicyError, match=r"expected one NAME\.json"):
        make_policy(str(tmp_path), SmallEnv(), 0)
    with pytest.raises(UsageError, match="no such file or folder"):
        make_policy(str(tmp_path / "none"), SmallEnv(), 0)
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(UsageError, match="this copy of avp-suite has none"):
        make_policy("pretrained", SmallEnv(), 0)
    monkeypatch.setattr(weights, "FOLDER", folder)
    (near := folder / "m.json").rename(folder / "homes.json")
    try:
        with pytest.raises(UsageError, match="did you mean 'homes'"):
            make_policy("pretrained:home", SmallEnv(), 0)
    finally:
        (folder / "homes.json").rename(near)


def test_a_policy_in_another_body_acts_with_a_warning_that_says_what_differs(recwarn):
    make_policy_env("pretrained", Corridor(), SETTINGS)
    assert not recwarn
    with pytest.warns(UserWarning, match=r"policy pretrained: made for other settings .*: turn_deg 10\.0, here 15\.0$"):
        make_policy_env("pretrained", Corridor(), replace(SETTINGS, turn_deg=15.0))


def test_a_policy_of_unknown_settings_acts(tmp_path, recwarn):
    write_weights(weights_of(ppo(SmallEnv()), "plain"), tmp_path)
    assert make_policy(str(tmp_path), SmallEnv(), 0).weights.settings == {}
    assert not [each for each in recwarn if "other settings" in str(each.message)]


def test_a_file_chooses_no_module_to_import(tmp_path):
    out = exported(ppo(), tmp_path)
    changed(out / "m.json", observation={"kind": "evil:Kind", "shape": [12]})
    with pytest.raises(PolicyError, match="give --observation evil:Kind"):
        make_policy_env(str(out), Corridor(), SETTINGS)


class DictEnv(SmallEnv):
    def __init__(self):
        super().__init__()
        self.observation_space = Dict({"numbers": Box(0, 1, (3,))})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DQN("MlpPolicy", SmallEnv(), buffer_size=10, device="cpu"), "found the DQNPolicy of DQN"),
        (lambda: sb3_contrib.RecurrentPPO("MlpLstmPolicy", SmallEnv(), device="cpu"), "RecurrentActorCriticPolicy"),
        (lambda: PPO("MultiInputPolicy", DictEnv(), device="cpu"), "MultiInputActorCriticPolicy"),
        (lambda: shaped([8], nn.Softplus), "activations Tanh, ReLU, .* found Softplus"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_the_format_cannot_hold_is_named(make, message):
    with pytest.raises(PolicyError, match=message):
        weights_of(make(), "m")


def test_export_without_onnx_runtime_says_so(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    words = [str(folder.parent / "m.zip"), "--out", str(tmp_path / "out"), "--onnx"]
    assert command.run(export.main, words) == 2
    assert "pip install 'avp-suite[onnx]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_training_starts_from_actor_critic_and_statistics(folder):
    before = PPO.load(folder.parent / "m.zip", device="cpu")
    model = started_ppo(str(folder), DummyVecEnv([SmallEnv] * 2), n_steps=32, batch_size=64)
    for name, tensor in before.policy.state_dict().items():
        np.testing.assert_array_equal(model.policy.state_dict()[name], tensor, err_msg=name)
    assert model.env.obs_rms.count == 640.5
    np.testing.assert_allclose(logits_of(model, DRAWN), PretrainedPolicy.load(str(folder)).logits(DRAWN), atol=1e-5)
    note_training(model, replace(SETTINGS, reward="surface"), ["room"])
    model.learn(64)
    made = weights_of(model, "next", statistics=model.get_vec_normalize_env())
    assert made.settings["reward"] == "surface"
    assert made.training["start"]["name"] == "m"
    assert (made.training["scenes"], made.training["steps"]) == (["room"], 64)
    assert not np.array_equal(made.actor[0].weight, before.policy.mlp_extractor.policy_net[0].weight.detach())


def test_a_training_takes_observation_and_reward_of_its_start(folder):
    assert Train(start=str(folder)).observation == "numbers"
    packaged = Train(start="pretrained")
    assert (packaged.observation, packaged.reward) == ("onboard", "multiview")
    assert Train(start="pretrained", reward="surface").reward == "surface"
    assert Train().reward == "proposed"
    with pytest.raises(UsageError, match="was made for numbers, got map"):
        Train(start=str(folder), observation="map")
    with pytest.raises(UsageError, match="expected one of --start and --resume"):
        Train(start=str(folder), resume="m.zip")
    with pytest.raises(UsageError, match=r"expected a policy without pickles, got m\.zip"):
        Train(start="m.zip")


def test_collect_takes_an_exported_policy(folder, tmp_path):
    words = ["--scene", "builtin:0", "--policy", str(folder), "--out", str(tmp_path / "rollout"), "--budget", "3"]
    options = command.parse(collect.Collect, [*words, "--width", "32", "--height", "24"])
    collect.collect(options, heldout=2)
    assert read_rollout(tmp_path / "rollout").meta["policy"]["name"] == "out"


def test_the_packages_weights_are_listed_and_choose_their_observation(tmp_path, monkeypatch, capsys):
    env = SmallEnv(observation="map")
    save_model(ppo(env), tmp_path / "m.zip")
    monkeypatch.setattr(weights, "FOLDER", tmp_path / "weights")
    words = [str(tmp_path / "m.zip"), "--out", str(weights.FOLDER), "--name", weights.DEFAULT, "--version", "4"]
    assert command.run(export.main, words) == 0
    capsys.readouterr()
    assert command.run(pretrained.main, []) == 0
    line = capsys.readouterr().out.splitlines()[1].split()
    assert line[:3] == [f"pretrained:{weights.DEFAULT}", "(=", "pretrained)"]
    assert line[3:6] == ["4", "map", "1213"]
    made, _ = make_policy_env("pretrained", Corridor(), SETTINGS)
    assert made.settings.observation == "map"
    assert described("pretrained") == f"pretrained ({weights.DEFAULT}, version 4)"


def test_the_batched_evaluation_takes_it(folder):
    env = AVPVecEnv(agents=2, simulator=Corridor(), settings=SETTINGS, seed=0)
    found = run_batch(PretrainedPolicy.load(str(folder)), env, 3, seed=1, deterministic=True)
    assert [len(episodes) for episodes in found.values()] == [3]


def test_the_experiment_takes_it_with_the_reward_it_learned_from(folder, tmp_path):
    shutil.copytree(folder, own := tmp_path / "own")
    changed(own / "m.json", settings={"reward": "surface"})
    (method, other) = chosen_methods([str(own), "random"])[::-1]
    assert (method.spec, method.reward, method.learned) == (str(own), "surface", False)
    assert "/" not in method.name
    assert other.reward == "coverage"
    changed(own / "m.json", settings={"reward": "evil:reward"})
    assert method.reward == "coverage"
    with pytest.raises(UsageError, match="unknown method"):
        chosen_methods(["heuristc"])


def test_the_package_has_its_default_weights():
    there = weights.available()
    if not there:
        pytest.skip("no weights in this copy")
    assert weights.DEFAULT in there
    assert sum(path.stat().st_size for path in weights.FOLDER.iterdir() if path.is_file()) < 10e6
