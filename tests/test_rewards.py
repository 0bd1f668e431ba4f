import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avp_habitat.errors import UsageError
from avp_habitat.rewards import PARTS, REWARD_NAMES, RewardConstants, StepFacts, has_stop, reward_parts, stops_episode

# All different and none a special value, so that a swapped or forgotten constant changes a sum.
CONSTANTS = RewardConstants(
    alpha=0.13,
    alpha_proposed=0.71,
    alpha_surface=0.83,
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
    )


def by_hand(name, facts, i):
    """The formulas of the design for one agent, in plain Python."""
    c = CONSTANTS
    collision = -c.collision if facts.collided[i] else 0.0
    spread = c.spread * min(float(facts.spread_m[i]), c.spread_limit_m)
    redundancy = -c.redundancy if facts.redundant[i] else 0.0
    parts = dict.fromkeys(PARTS, 0.0)
    if name == "coverage":
        return parts | {"coverage": c.alpha * int(facts.new_cells[i]), "collision": collision}
    if name == "coverage_redundancy":
        linear = c.alpha * int(facts.new_cells[i])
        return parts | {"coverage": linear, "collision": collision, "spread": spread, "redundancy": redundancy}
    stop = 0.0
    if facts.stop_chosen[i]:
        enough = facts.coverage[i] >= c.stop_coverage
        stop = c.stop_bonus + c.stop_per_step_left * int(facts.steps_left[i]) if enough else -c.early_stop
    discount = 1 + c.visit_decay * int(facts.earlier_visits[i])
    if name == "surface":
        new = {"surface": c.alpha_surface / discount * float(facts.new_surface[i]) ** c.beta}
    else:
        new = {"coverage": c.alpha_proposed / discount * int(facts.new_cells[i]) ** c.beta}
    return (
        parts
        | new
        | {
            "spread": spread,
            "step": -c.step,
            "collision": collision,
            "redundancy": redundancy,
            "stop": stop,
        }
    )


@pytest.mark.parametrize("name", REWARD_NAMES)
@given(seed=st.integers(0, 100_000))
def test_every_part_equals_the_formula_by_hand(name, seed):
    facts = random_facts(seed)
    parts = reward_parts(name, facts, CONSTANTS)
    assert tuple(parts) == PARTS
    for i in range(len(facts.coverage)):
        expected = by_hand(name, facts, i)
        for part in PARTS:
            assert parts[part][i] == pytest.approx(expected[part]), (name, part)


def test_only_the_proposed_and_the_surface_reward_have_a_stop():
    assert [name for name in REWARD_NAMES if has_stop(name)] == ["proposed", "surface"]


def test_stopping_needs_the_choice_and_the_coverage():
    facts = dataclasses.replace(
        random_facts(0, 3), stop_chosen=np.array([True, True, False]), coverage=np.array([0.8, 0.79, 0.9])
    )
    assert stops_episode(facts, CONSTANTS).tolist() == [True, False, False]


def test_the_default_constants_follow_the_design():
    defaults = RewardConstants()
    assert defaults.stop_coverage == 0.85
    assert defaults.visit_decay == 0.5
    assert defaults.beta < 1


def test_an_unknown_reward_names_the_nearest():
    with pytest.raises(UsageError, match=r"unknown reward 'covrage': .* did you mean 'coverage'"):
        reward_parts("covrage", random_facts(0), CONSTANTS)
