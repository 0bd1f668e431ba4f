import itertools

import numpy as np
import pytest
from corridor import RayCorridor
from hypothesis import given, settings
from hypothesis import strategies as st

from avp_habitat.errors import UsageError
from avp_habitat.policies.oracle.places import scene_places, views_from
from avp_habitat.policies.oracle.policy import OraclePolicy, make_plan, planned_coverage
from avp_habitat.policies.oracle.search import (
    all_poses,
    beam_search,
    covering_tour,
    greedy_cover,
    start_state,
)
from avp_habitat.policies.reactive import RandomPolicy
from avp_habitat.sight.bits import pack, unpack
from avp_habitat.sight.rules import candidates
from avp_habitat.task.agent_view import agent_views
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.motion import act, sensor_poses
from avp_habitat.task.settings import STOP, TaskSettings

SMALL = {"width": 32, "height": 24, "reward": "coverage"}
NARROW = 50


@pytest.fixture(scope="module")
def corridor():
    return RayCorridor()


@pytest.fixture(scope="module")
def room():
    return AVPEnv("builtin:3", **SMALL).simulator


def play(env, policy, *, seed):
    observation, _ = env.reset(seed=seed)
    coverage, actions, done = [], [], False
    while not done:
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = env.step(int(action))
        coverage.append(info["coverage"])
        actions.append(int(action))
        done = terminated or truncated
    return np.array(coverage), actions


def start_of(view):
    return start_state(view, len(view.observed))


@pytest.mark.parametrize("scene", ["corridor", "room"])
def test_planned_coverage_is_what_the_environment_measures(scene, request):
    env = AVPEnv(simulator=request.getfixturevalue(scene), **SMALL)
    policy = OraclePolicy(lambda: agent_views(env), width=NARROW)
    measured, actions = play(env, policy, seed=5)
    np.testing.assert_allclose(measured, policy.planner(0).plan.coverage, atol=0.01)
    assert STOP not in actions
    assert len(actions) == 80


def test_the_tables_foresee_the_coverage_of_a_plan(room):
    env = AVPEnv(simulator=room, **SMALL)
    env.reset(seed=8)
    view, places = env.agent_view, scene_places(room, env.settings)
    tour = covering_tour(places, env.settings, start_of(view), 80)
    state, foreseen = (view.position[None], np.array([view.yaw]), np.array([view.pitch])), set()
    for action in tour:
        state = act(room.area, env.settings, np.array([action]), *state)
        foreseen |= set(np.flatnonzero(unpack(views_from(places, env.settings, *state), len(view.observed))))
    true = planned_coverage(view, tour)[-1]
    assert len(foreseen) / len(view.observed) == pytest.approx(true, abs=0.01)


def test_the_oracle_beats_the_random_policy_clearly(room):
    env = AVPEnv(simulator=room, **SMALL)
    oracle, _ = play(env, OraclePolicy.for_env(env), seed=1)
    random, _ = play(env, RandomPolicy(0), seed=1)
    assert oracle.mean() > 2 * random.mean()
    assert oracle[-1] > 0.95


def test_the_oracle_is_at_least_as_good_as_its_covering_tour(room):
    env = AVPEnv(simulator=room, **SMALL)
    env.reset(seed=2)
    view = env.agent_view
    tour = covering_tour(scene_places(room, env.settings), env.settings, start_of(view), 80)
    alone = planned_coverage(view, tour)
    assert make_plan(view).coverage.mean() >= alone.mean()
    assert alone[-1] > 0.7


def test_beam_search_finds_the_best_of_all_short_sequences(corridor):
    env = AVPEnv(simulator=corridor, **SMALL, budget=4, turn_deg=40.0, tilt_deg=20.0, forward_m=0.6)
    env.reset(seed=0)
    view, places = env.agent_view, scene_places(corridor, env.settings)
    found = beam_search(places, env.settings, start_of(view), 4, 1000)
    every = [np.array(actions) for actions in itertools.product(range(5), repeat=4)]
    values = [planned_coverage(view, actions).mean() for actions in every]
    assert planned_coverage(view, found).mean() >= max(values) - 0.005
    assert np.quantile(values, 0.99) < max(values) - 0.005


def test_visible_sets_of_the_places_follow_the_rule_of_the_task(corridor):
    task = TaskSettings(width=32, height=20)
    places = scene_places(corridor, task)
    poses = all_poses(places, task, yaw=0.123)
    position = places.position[poses.place]
    sensor = sensor_poses(task, position, poses.yaw, poses.pitch)
    points = corridor.area.centres
    everything = np.ones((len(sensor), len(points)), dtype=bool)
    pairs = candidates(sensor, task.intrinsics, points, everything, max_range_m=task.max_range_m)
    reached = corridor.visible(sensor, task.intrinsics, points, pairs, tolerance_m=task.tolerance_m)
    expected = np.zeros_like(everything)
    expected[tuple(pairs[reached].T)] = True
    assert len(np.unique(poses.pitch)) == 3
    assert 0 < expected.mean() < 0.5
    np.testing.assert_array_equal(unpack(poses.sets, len(points)), expected)


def test_a_range_limits_what_the_places_see(corridor):
    task = TaskSettings(max_range_m=2.5)
    places = scene_places(corridor, task)
    far = np.linalg.norm((places.points[None] - places.position[:, None])[..., [0, 2]], axis=-1) > 2.0001
    sees = unpack(places.sees, len(places.points))
    assert not (sees & far).any()
    assert sees.any(axis=1).all()


def test_reach_counts_the_steps_around_the_wall(corridor):
    places = scene_places(corridor, TaskSettings())
    at = places.nearest(np.array([[2.55, 0.0, 0.25]]))[0]
    cell = places.nearest(np.array([[3.45, 0.0, 0.25]]))[0]
    behind_wall, in_sight = places.reach[at, cell], places.reach[at, at - 10]
    assert in_sight <= 2 * 1.0 / 0.25 + 1
    # The way to a view past the wall's end at z = 1.8 m is at least 1.2 m long.
    assert 2 * 1.2 / 0.25 <= behind_wall <= 2 * 3.0 / 0.25


def test_few_table_entries_give_a_coarser_grid_of_places_in_the_same_scene(corridor):
    task = TaskSettings()
    fine, coarse = scene_places(corridor, task), scene_places(corridor, task, entries=200_000)
    assert len(coarse.position) * len(coarse.points) <= 200_000 < len(fine.position) * len(fine.points)
    assert set(map(tuple, coarse.position)) <= set(map(tuple, fine.position))
    assert unpack(coarse.wanted[None], len(coarse.points)).all()


@given(st.lists(st.lists(st.booleans(), min_size=9, max_size=9), min_size=1, max_size=7), st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_greedy_cover_follows_the_definition_and_keeps_its_guarantee(rows, limit):
    members = np.array(rows)
    chosen = greedy_cover(pack(members), pack(np.ones((1, 9), dtype=bool))[0])[:limit]
    covered, expected = np.zeros(9, dtype=bool), []
    for _ in range(limit):
        gain = [(row & ~covered).sum() for row in members]
        if max(gain) == 0:
            break
        expected.append(int(np.argmax(gain)))
        covered |= members[expected[-1]]
    assert chosen == expected
    best = max(
        members[list(some)].any(axis=0).sum()
        for some in itertools.combinations(range(len(rows)), min(limit, len(rows)))
    )
    assert covered.sum() >= (1 - 1 / np.e) * best


@given(st.integers(1, 200), st.integers(1, 5), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_unpack_undoes_pack(count, rows, seed):
    members = np.random.default_rng(seed).random((rows, count)) < 0.5
    np.testing.assert_array_equal(unpack(pack(members), count), members)


def test_an_episode_taken_over_in_the_middle_is_planned_from_there(corridor):
    env = AVPEnv(simulator=corridor, **SMALL, budget=30)
    observation, _ = env.reset(seed=4)
    for action in (0, 1, 1):
        observation, *_ = env.step(action)
    policy = OraclePolicy(lambda: agent_views(env), width=NARROW)
    measured = []
    for _ in range(27):
        observation, _, _, _, info = env.step(int(policy.predict(observation)[0]))
        measured.append(info["coverage"])
    np.testing.assert_allclose(measured, policy.planner(0).plan.coverage, atol=0.01)


def test_every_agent_of_a_vector_environment_follows_its_own_plan(corridor):
    vec_env = pytest.importorskip("avp_sb3.vec_env.batched").AVPVecEnv(
        "corridor", simulator=corridor, agents=2, settings=TaskSettings(**SMALL, budget=6), seed=3
    )
    policy = OraclePolicy.for_env(vec_env, 0)
    observations, ends = vec_env.reset(), []
    for step in range(12):
        actions, _ = policy.predict(observations)
        assert actions.shape == (2,)
        plans = [policy.planner(agent).plan.coverage for agent in range(2)]
        observations, _, _, infos = vec_env.step(actions)
        for info, plan in zip(infos, plans, strict=True):
            assert info["coverage"] == pytest.approx(plan[step % 6], abs=0.01)
            ends.append(plan[-1])
    assert len(set(ends)) == 4


def test_the_wide_reading_of_coverage_is_refused(corridor):
    env = AVPEnv(simulator=corridor, **SMALL, coverage_mode="over")
    observation, _ = env.reset(seed=0)
    with pytest.raises(UsageError, match="plans for coverage_mode 'visible', got 'over'"):
        OraclePolicy.for_env(env).predict(observation)
