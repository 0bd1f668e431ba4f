import dataclasses

import numpy as np
import pytest
from corridor import Corridor
from hypothesis import given
from hypothesis import strategies as st
from rrd import rows

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.capture import capture_step, publish_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.rewards import (
    REWARDS,
    RewardConstants,
    StepFacts,
    find_reward,
    has_stop,
    reward_parts,
    stops_episode,
)
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPVecEnv
from avp_sb3.callbacks.metrics import EpisodeWindow
from avp_sb3.rerun.rollout import read_steps, write_rollout_recording

# All different and none a special value, so that a swapped or forgotten constant changes a sum.
CONSTANTS = RewardConstants(
    alpha=0.13,
    alpha_proposed=0.71,
    alpha_surface=0.83,
    alpha_multiview=0.17,
    single_weight=0.35,
    beta=0.6,
    visit_decay=0.4,
    spread=0.17,
    spread_limit_m=1.9,
    step=0.031,
    collision=0.23,
    redundancy=0.37,
    redundancy_distance_m=0.21,
    redundancy_angle_deg=4.0,
    stop_bonus=5.3,
    stop_surface_bonus=2.9,
    stop_per_step_left=0.041,
    early_stop=0.59,
    stop_coverage=0.8,
)


def random_facts(seed, n=6):
    rng = np.random.default_rng(seed)
    return StepFacts(
        new_cells=rng.integers(0, 200, n),
        new_surface=rng.uniform(0, 150, n) * (rng.random(n) < 0.8),
        earlier_visits=rng.integers(0, 9, n),
        spread_m=rng.uniform(0, 4, n),
        collided=rng.random(n) < 0.5,
        redundant=rng.random(n) < 0.5,
        stop_chosen=rng.random(n) < 0.5,
        coverage=rng.uniform(0.6, 1.0, n),
        steps_left=rng.integers(0, 80, n),
        new_shown=rng.uniform(0, 150, n),
        new_shown_twice=rng.uniform(0, 90, n),
        surface=rng.uniform(0, 1, n),
        shown=rng.uniform(0, 1, n),
        shown_twice=rng.uniform(0, 1, n),
    )


def by_hand(name, facts, i):
    """The formulas of the design for one agent, in plain Python."""
    c = CONSTANTS
    collision = -c.collision if facts.collided[i] else 0.0
    spread = c.spread * min(float(facts.spread_m[i]), c.spread_limit_m)
    redundancy = -c.redundancy if facts.redundant[i] else 0.0
    if name == "coverage":
        return {"coverage": c.alpha * int(facts.new_cells[i]), "collision": collision}
    if name == "coverage_redundancy":
        linear = c.alpha * int(facts.new_cells[i])
        return {"coverage": linear, "collision": collision, "spread": spread, "redundancy": redundancy}
    stop = 0.0
    if facts.stop_chosen[i]:
        enough = facts.coverage[i] >= c.stop_coverage
        stop = c.stop_bonus + c.stop_per_step_left * int(facts.steps_left[i]) if enough else -c.early_stop
    discount = 1 + c.visit_decay * int(facts.earlier_visits[i])
    if name == "surface":
        new = {"surface": c.alpha_surface / discount * float(facts.new_surface[i]) ** c.beta}
        stop = c.stop_surface_bonus * float(facts.surface[i]) if facts.stop_chosen[i] else 0.0
    elif name == "multiview":
        w = c.single_weight
        grown = w * float(facts.new_shown[i]) + (1 - w) * float(facts.new_shown_twice[i])
        new = {"multiview": c.alpha_multiview * grown**c.beta}
        share = w * float(facts.shown[i]) + (1 - w) * float(facts.shown_twice[i])
        stop = c.stop_surface_bonus * share if facts.stop_chosen[i] else 0.0
    else:
        new = {"coverage": c.alpha_proposed / discount * int(facts.new_cells[i]) ** c.beta}
    return new | {"spread": spread, "step": -c.step, "collision": collision, "redundancy": redundancy, "stop": stop}


@pytest.mark.parametrize("name", REWARDS)
@given(seed=st.integers(0, 100_000))
def test_every_part_equals_the_formula_by_hand(name, seed):
    facts = random_facts(seed)
    parts = reward_parts(find_reward(name), facts, CONSTANTS)
    for i in range(len(facts.coverage)):
        expected = by_hand(name, facts, i)
        assert {part: values[i] for part, values in parts.items()} == pytest.approx(expected)


def test_only_the_papers_ablations_have_no_stop():
    assert [name for name in REWARDS if not has_stop(find_reward(name))] == ["coverage", "coverage_redundancy"]


def test_stopping_needs_the_choice_and_in_proposed_the_coverage():
    facts = dataclasses.replace(
        random_facts(0, 3), stop_chosen=np.array([True, True, False]), coverage=np.array([0.8, 0.79, 0.9])
    )
    ends = {name: stops_episode(find_reward(name), facts, CONSTANTS).tolist() for name in REWARDS}
    assert ends["proposed"] == [True, False, False]
    assert ends["surface"] == ends["multiview"] == [True, True, False]
    assert ends["coverage"] == [False] * 3


def test_the_default_constants_follow_the_design():
    defaults = RewardConstants()
    assert defaults.stop_coverage == 0.85
    assert defaults.visit_decay == 0.5
    assert defaults.beta < 1


def test_an_unknown_reward_names_the_nearest():
    with pytest.raises(UsageError, match=r"unknown reward 'covrage': .* did you mean 'coverage'"):
        TaskSettings(reward="covrage")


def of_ones_own(facts, constants):
    """Parts under names that no reward of the suite has: one for all agents, and one that some steps leave out."""
    parts = {"look, around": 0.1 * facts.new_cells, "time": -0.25}
    return parts | ({"blocked/twice": -2.0 * facts.collided} if facts.collided.any() else {})


@pytest.fixture
def own_reward():
    return TaskSettings(reward=of_ones_own, budget=12, width=16, height=12)


WALK_INTO_A_WALL = [0] * 11 + [1]


def test_a_reward_is_the_sum_of_what_its_function_returns(own_reward):
    env = AVPEnv(simulator=Corridor(), settings=own_reward)
    env.reset(seed=4)
    for action in WALK_INTO_A_WALL:
        _, reward, _, _, info = env.step(action)
        expected = 0.1 * info["new_cells"] - 0.25 - 2.0 * info["collided"]
        assert reward == pytest.approx(expected)
        assert sum(info["reward_parts"].values()) == pytest.approx(expected)
    trajectory, figures = info["avp_trajectory"], info["avp_episode"]
    assert trajectory.collided.any()
    assert figures["return_blocked/twice"] == -2.0 * figures["collisions"]
    assert figures["return_time"] == pytest.approx(-0.25 * 12)
    np.testing.assert_allclose(sum(trajectory.reward_parts.values()), trajectory.reward)


def test_agents_of_a_batch_have_the_same_parts_as_one_alone(own_reward):
    batch = AVPVecEnv(simulator=Corridor(), agents=3, settings=own_reward, seed=4)
    batch.reset()
    sums = np.zeros(3)
    for action in WALK_INTO_A_WALL:
        _, rewards, dones, infos = batch.step(np.full(3, action))
        sums += rewards
    assert dones.all()
    for total, info in zip(sums, infos, strict=True):
        returns = {name: value for name, value in info["avp_episode"].items() if name.startswith("return_")}
        assert sum(returns.values()) == pytest.approx(total, abs=1e-5)


def test_a_rollout_holds_the_parts_by_their_names_also_those_of_later_steps_only(own_reward, tmp_path):
    env = AVPEnv(simulator=Corridor(), settings=own_reward)
    camera = Intrinsics.from_hfov(24, 16, hfov_deg=90)
    env.reset(seed=4)
    with RolloutWriter(tmp_path / "r", camera) as writer:
        for action in WALK_INTO_A_WALL:
            _, reward, _, _, info = env.step(action)
            capture_step(env, writer, action, reward, info)
        publish_rollout(env, writer, info, policy={"name": "a list"}, seed=0, heldout=0)
    plots, _ = read_steps(tmp_path / "r" / "steps.csv", frames=12)
    parts = {name.removeprefix("reward/"): values for name, values in plots.items() if name.startswith("reward/")}
    total = parts.pop("sum")
    assert set(parts) == {"look, around", "time", "blocked/twice"}
    np.testing.assert_allclose(sum(parts.values()), total, atol=1e-6)
    assert parts["blocked/twice"][0] == 0
    rrd = write_rollout_recording([tmp_path / "r"], tmp_path / "r.rrd")
    recorded = rows(rrd, "/r/plots/reward/blocked/twice", "Scalars:scalars")
    assert np.concatenate([value for _, value in recorded]).tolist() == parts["blocked/twice"].tolist()
    assert rows(rrd, r"/r/plots/reward/look\,\ around", "Scalars:scalars")


def test_metrics_of_a_training_hold_each_part_also_one_that_shows_up_later(own_reward):
    window = EpisodeWindow(4)
    first = {"coverage": 0.5, "views": 4.0, "annd_m": 0.2, "ei": 0.1, "stopped": 0.0, "collisions": 0.0}
    first |= {"redundant_views": 0.0, "return_time": -1.0}
    window.add(first)
    window.add(first | {"return_blocked/twice": -6.0})
    means = window.means()
    assert means["reward/blocked/twice"] == pytest.approx(-3.0)
    assert means["reward/time"] == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"pair": np.zeros((6, 2))}, r"part 'pair': expected one number for each of 6 agents, got shape \(6, 2\)"),
        ({"few": np.zeros(5)}, r"part 'few': expected one number for each of 6 agents, got shape \(5,\)"),
        ({"time": None}, "part 'time': expected finite numbers, got None"),
        ({"time": np.array([0, np.nan, 0, 0, 0, 0])}, "part 'time': expected finite numbers"),
        ({"time": np.inf}, "part 'time': expected finite numbers, got inf"),
        ({"time": "much"}, "part 'time': could not convert string to float: 'much'"),
        ({"time": [[1], [1, 2]]}, "part 'time': setting an array element with a sequence"),
        (np.ones(6), "expected parts by name, .*, got ndarray"),
        ({}, "expected parts by name, .*, got none"),
    ],
)
def test_what_cannot_be_added_up_is_named(parts, message):
    def own(facts, constants):
        return parts

    with pytest.raises(UsageError, match=rf"reward test_rewards:.*own: {message}"):
        reward_parts(own, random_facts(0), CONSTANTS)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (lambda facts: {}, "expected a function of .facts, constants., got .*: too many positional arguments"),
        (3, "reward 'builtins:int': expected a function"),
    ],
)
def test_what_is_no_reward_is_refused_before_a_scene_is_opened(own, message):
    with pytest.raises(UsageError, match=message):
        TaskSettings(reward=own)
