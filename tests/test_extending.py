"""What users bring from outside: the recipes of docs/extending.md as a distribution of their own, and bad ones."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor
from gymnasium.spaces import Box, Dict
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from avp_habitat import command, plugins
from avp_habitat.collect import main as collect
from avp_habitat.errors import UsageError
from avp_habitat.policies.registry import POLICIES, make_policy, make_policy_env
from avp_habitat.simulators.registry import SIMULATORS, SimulatorChoice, make_simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.observations import numbers
from avp_habitat.task.rewards import REWARDS
from avp_habitat.task.settings import OBSERVATIONS, TaskSettings
from avp_sb3 import AVPSubprocVecEnv, AVPVecEnv

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r'```python title="([^"]+)"\n(.*?)```', PAGE, re.DOTALL))
GROUPS = tomllib.loads(re.search(r"```toml\n(.*?)```", PAGE, re.DOTALL)[1])["project"]["entry-points"]
COMMANDS = [
    shlex.split(line.replace("\\\n", "")) for line in re.findall(r"^    \$ ((?:.*\\\n)*.*)$", PAGE, re.MULTILINE)
]
SMALL = {"budget": 8, "width": 24, "height": 16}
DRIVER = """
import json, runpy, sys
for words in json.loads(sys.argv[1]):
    if words[:2] == ["python", "-m"]:
        sys.argv = words[2:]
        try:
            runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        except SystemExit as end:
            assert not end.code, words
    else:
        sys.argv = words[1:]
        runpy.run_path(words[1], run_name="__main__")
"""


def write_distribution(folder, name, groups, files=()):
    for path, text in dict(files).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    info = folder / f"{name.replace('-', '_')}-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    texts = [f"[{group}]\n" + "\n".join(map(" = ".join, each.items())) for group, each in groups.items()]
    (info / "entry_points.txt").write_text("\n".join(texts))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The distribution of the page, outside of the repository."""
    folder = tmp_path_factory.mktemp("site")
    write_distribution(folder, "my-avp", GROUPS, {name: text for name, text in FILES.items() if "/" in name})
    return folder


@pytest.fixture
def installed(site, monkeypatch):
    """The same in this process."""
    monkeypatch.syspath_prepend(site)
    plugins._registered.cache_clear()
    yield site
    plugins._registered.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_avp"]:
        del sys.modules[name]


def outside(site, folder, *words, timeout=500):
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])}
    env = {name: value for name, value in env.items() if not name.startswith("MLFLOW_")}
    done = subprocess.run([*words], env=env, cwd=folder, capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_recipes_are_short():
    assert {name: len(text.splitlines()) for name, text in FILES.items() if len(text.splitlines()) > 25} == {}


def test_the_page_and_the_manifest_name_all_groups():
    manifest = tomllib.loads((ROOT / "plugins.toml").read_text(encoding="utf-8"))
    assert [each["name"] for each in manifest["group"]] == list(plugins.KINDS)
    assert set(GROUPS) <= set(plugins.KINDS)


def test_the_commands_of_the_page_run_as_written_from_outside(site, tmp_path):
    (tmp_path / "try_it.py").write_text(FILES["try_it.py"])
    lines = [words for words in COMMANDS if words[0] == "python" and "avp_sb3.train" not in words]
    assert len(lines) == 7
    lines.sort(key=lambda words: "own.zip" in words)
    said = outside(site, tmp_path, sys.executable, "-c", DRIVER, json.dumps(lines))
    assert re.search(r"\|    new floor +\| [\d.]+ ", said)
    rollouts = {
        name: json.loads((tmp_path / "runs" / name / "rollout.json").read_text()) for name in ("r1", "r2", "r3")
    }
    assert (rollouts["r1"]["reward"], rollouts["r2"]["policy"]["name"]) == ("thrifty", "wanderer")
    assert rollouts["r3"]["simulator"] == {"name": "hall", "version": "1"}
    assert re.search(r"own\.zip +\| wanderer", said)
    assert "turned_deg" in (tmp_path / "runs" / "r4" / "rollout.json").read_text()
    header = (tmp_path / "runs" / "r1" / "steps.csv").read_text().splitlines()[0]
    assert {"reward_new floor", "reward_seen before", "reward_time", "reward_end"} <= set(header.split(","))


@pytest.mark.slow
def test_trainings_of_the_page_run_as_written_from_outside(site, tmp_path):
    lines = [words for words in COMMANDS if "avp_sb3.train" in words]
    outside(site, tmp_path, sys.executable, "-c", DRIVER, json.dumps(lines))
    zoo = next(words for words in COMMANDS if words[0] == "rl_zoo3")
    outside(site, tmp_path, sys.executable, "-m", "rl_zoo3.cli", *zoo[1:])


def test_a_model_finds_the_kind_of_observation_that_is_registered(installed, tmp_path):
    from stable_baselines3 import PPO

    env = AVPVecEnv(
        simulator=Corridor(), agents=2, settings=TaskSettings(observation="numbers_and_map", lookup=False, **SMALL)
    )
    PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu").learn(16).save(tmp_path / "m.zip")
    found, policy = make_policy_env(str(tmp_path / "m.zip"), Corridor(), TaskSettings(**SMALL))
    assert found.settings.observation == "numbers_and_map"
    assert policy.predict(found.reset(seed=0)[0])[0].shape == ()


def test_a_dict_of_observations_passes_the_checkers(installed):
    env = AVPEnv(simulator=Corridor(), observation="my_avp.observations:NumbersAndMap", **SMALL)
    check_env(env, skip_render_check=True)
    sb3_check_env(env)


@pytest.mark.parametrize("kind", ["random", "heuristic", "frontier", "wanderer"])
def test_policies_that_look_at_the_scene_act_on_any_observation(installed, kind):
    settings = TaskSettings(observation="numbers_and_map", **SMALL)
    single, batch = (
        AVPEnv(simulator=Corridor(), settings=settings),
        AVPVecEnv(simulator=Corridor(), agents=3, settings=settings),
    )
    actions, _ = make_policy(kind, single, 0).predict(single.reset(seed=0)[0])
    assert np.size(actions) == 1
    actions, _ = make_policy(kind, batch, 0).predict(batch.reset())  # type: ignore[arg-type]
    assert actions.shape == (3,)


def play(env, steps=10):
    """Observations, those at the ends of episodes, and rewards."""
    seen, ends, rewards = [env.reset()], [], []
    for step in range(steps):
        observation, reward, _, infos = env.step(np.arange(env.num_envs) * step % 3)
        seen.append({part: values.copy() for part, values in observation.items()})
        ends += [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        rewards.append(reward)
    env.close()
    return seen, ends, rewards


def test_workers_give_the_same_dicts_and_rewards_as_one_process(installed):
    options = {"agents": 3, "seed": 5, "simulator": "hall"}
    settings = TaskSettings(reward="my_avp.rewards:thrifty", observation="numbers_and_map", **SMALL)
    both = [play(kind(["a", "b"], settings=settings, **options)) for kind in (AVPVecEnv, AVPSubprocVecEnv)]
    for one, other in zip(*both, strict=True):
        assert len(one) == len(other) > 0
        for first, second in zip(one, other, strict=True):
            pairs = zip(first.values(), second.values(), strict=True) if isinstance(first, dict) else [(first, second)]
            for left, right in pairs:
                np.testing.assert_array_equal(left, right)


# Bad input.

KNOWN = {"reward": REWARDS, "observation": OBSERVATIONS, "policy": POLICIES, "simulator": SIMULATORS}
USERS = """
class Kind: pass
def made(one, two, three): pass
def predict(): pass
number = 3
"""


@pytest.fixture
def users(tmp_path, monkeypatch):
    """A module in the current folder, which `python -m` would find."""
    (tmp_path / "users_module.py").write_text(USERS)
    (tmp_path / "users_broken.py").write_text("import surely_nothing\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield
    for name in ("users_module", "users_broken"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(("group", "kind"), plugins.KINDS.items())
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("users_modul:Kind", "got ModuleNotFoundError: No module named 'users_modul'; did you mean 'users_module'?"),
        ("users_broken:Kind", "got ModuleNotFoundError: No module named 'surely_nothing'"),
        ("users_module:Kint", "users_module has no 'Kint'; did you mean 'Kind'?"),
        ("users_module:Kind.of", "users_module has no 'Kind.of'"),
        (":Kind", "expected a module that can be imported, got ValueError"),
        ("nothing", "expected "),
    ],
)
def test_a_name_behind_which_there_is_nothing_is_one_line(users, group, kind, name, message):
    with pytest.raises(UsageError) as error:
        plugins.find(group, name, KNOWN.get(kind, {}))
    text = str(error.value)
    assert re.search(rf"\b{kind} '{name}'", text)
    assert message in text
    assert "\n" not in text


def test_two_distributions_with_one_name_are_both_named(installed, tmp_path):
    sys.path.insert(0, str(tmp_path))
    write_distribution(tmp_path, "other-avp", {"avp.rewards": {"thrifty": "a:b", "proposed": "a:c"}})
    plugins._registered.cache_clear()
    with pytest.raises(UsageError, match=r"reward 'thrifty': .* found (other|my)-avp .* and (other|my)-avp"):
        TaskSettings(reward="thrifty")
    with pytest.raises(UsageError, match=r"reward 'proposed': .* avp-suite \(built in\) and other-avp \(a:c\)"):
        TaskSettings(reward="proposed")


class Kind:
    """Observations whose space and values are given."""

    def __init__(self, values, space):
        self.values, self.space = values, space

    def __call__(self, agents):
        return self.values


FRACTION = Box(0, 1, (2,), np.float32)


@pytest.mark.parametrize(
    ("values", "space", "message"),
    [
        (np.array([[0.5, 1.5]]), FRACTION, r"expected values within Box\(0.0, 1.0, .*, got 1.5"),
        (np.array([[0.5, np.nan]]), FRACTION, r"expected values within Box\(0.0, 1.0, .*, got nan"),
        (np.array([0.5, 0.5]), FRACTION, r"expected float32 of shape \(1, 2\), got float64 of shape \(2,\)"),
        ([["a", "b"]], FRACTION, r"expected float32 of shape \(1, 2\), got <U1"),
        (np.zeros((1, 2)), Box(0, 9, (2,), np.int64), r"expected int64 of shape \(1, 2\), got float64"),
        (
            {"a": np.zeros((1, 2))},
            Dict(a=FRACTION, b=FRACTION),
            r"expected arrays by the names \['a', 'b'\], got \['a'\]",
        ),
        ({"a": np.full((1, 2), 2)}, Dict(a=FRACTION), r": a: expected float32 of shape|: a: expected values within"),
        (None, "twelve", "expected a gymnasium space as its `space`, got 'twelve'"),
    ],
)
def test_an_observation_outside_of_its_space_is_one_line(values, space, message):
    with pytest.raises(UsageError, match=rf"observation 'test_extending:Kind': ?.*{message}"):
        AVPEnv(simulator=Corridor(), observation=Kind(values, space), **SMALL).reset(seed=0)


def test_whatever_fits_the_space_is_observed_with_its_type():
    env = AVPEnv(simulator=Corridor(), observation=Kind(np.array([[0.25, 1.0]]), FRACTION), **SMALL)
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert observation.tolist() == [0.25, 1.0]
    assert env.settings.facts()["observation"] == "test_extending:Kind"


def test_surface_maps_have_to_be_declared():
    class Undeclared:
        space = Box(0, 1, (8, 10, 10))

        def __call__(self, agents):
            return agents.surface_maps()

    with pytest.raises(UsageError, match=r"surface_maps: .* needs_surface = True"):
        AVPEnv(simulator=Corridor(), observation=Undeclared(), **SMALL).reset(seed=0)
    Undeclared.needs_surface = True
    assert AVPEnv(simulator=Corridor(), observation=Undeclared(), **SMALL).reset(seed=0)[0].shape == (8, 10, 10)


def test_agents_of_several_scenes_are_observed_in_their_order():
    class Pictures:
        space = Dict(depth=Box(0, np.inf, (16, 24)), where=Box(-1, 1, (12,)), known=Box(0, 1, ()))

        def __call__(self, agents):
            known = agents.joined([(scene.first_seen > 0).mean(axis=1) for scene in agents.scenes])
            return {"depth": agents.images().depth, "where": numbers(agents), "known": known}

    settings = TaskSettings(observation=Pictures(), **SMALL)
    batch = AVPVecEnv(simulator=[Corridor(), Corridor()], agents=3, settings=settings, seed=1)
    together, (moved, *_) = batch.reset(), batch.step(np.zeros(3, int))
    for agent in range(3):
        alone = AVPVecEnv(simulator=Corridor(), agents=1, settings=settings, seed=1 + agent)
        for found, expected in ((together, alone.reset()), (moved, alone.step(np.zeros(1, int))[0])):
            for part, values in found.items():
                np.testing.assert_allclose(values[agent], expected[part][0], atol=1e-6)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("users_module:Kind", r"'users_module:Kind': .* \(env, seed\) that gives one: .*takes no arguments|too many"),
        ("users_module:made", r"'users_module:made': .*missing a required argument: 'three'"),
        ("users_module:number", r"'users_module:number': expected something with `predict`"),
        (lambda env, seed: 3, r"that gives one, got int"),
    ],
)
def test_what_is_no_policy_is_one_line(users, policy, message):
    with pytest.raises(UsageError, match=message):
        make_policy(policy, AVPEnv(simulator=Corridor(), **SMALL), 0)


def test_what_is_no_simulator_is_one_line(users, capsys, tmp_path):
    with pytest.raises(UsageError, match=r"simulator 'users_module:made': .*missing a required argument: 'two'"):
        make_simulator("users_module:made", "a")
    with pytest.raises(UsageError, match=r"Kind has no name, version, scene, scene_digest, .*render, visible, close"):
        make_simulator(lambda scene: type("Kind", (), {})(), "a")
    with pytest.raises(
        UsageError, match=r"navmesh: is of the simulator 'raycast' or 'habitat', but 'users_module:made'"
    ):
        SimulatorChoice("users_module:made", navmesh=Path("a.navmesh"))
    with pytest.raises(UsageError, match=r"simulator 'users_module:number': expected a factory of .*, got 3"):
        SimulatorChoice("users_module:number")
    with pytest.raises(UsageError, match=r"unknown simulator 'raycats': .* did you mean 'raycast'"):
        SimulatorChoice("raycats")
    words = ["--scene", "a", "--policy", "random", "--simulator", "users_modul:made", "--out", "r"]
    assert command.run(collect, words) == 2
    assert capsys.readouterr().err.count("\n") == 1


class Colourless(Corridor):
    def render(self, camera_to_world, intrinsics, *, rgb):
        return super().render(camera_to_world, intrinsics, rgb=False)


def test_a_simulator_without_colour_trains_and_says_so_when_a_picture_is_needed():
    env = AVPEnv(simulator=Colourless(), render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(Exception, match="corridor: expected pictures, but the simulator corridor shows no colour"):
        env.render()
