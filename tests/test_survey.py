import numpy as np
import pytest

from avp_habitat.errors import UsageError
from avp_habitat.policies.oracle.places import SURFACE_SPACING_M, scene_places, surface_points
from avp_habitat.policies.oracle.policy import OraclePolicy, SurveyPolicy, make_plan
from avp_habitat.policies.reactive import RandomPolicy
from avp_habitat.sight.rules import candidates
from avp_habitat.task.agent_view import agent_views
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.motion import sensor_poses

NARROW = 50


@pytest.fixture(scope="module")
def env():
    return AVPEnv("builtin:3", width=32, height=24, reward="coverage", budget=50)


def share_of_surfaces_seen(env, policy):
    """Play an episode and cast a true ray to every surface point in each of its views."""
    observation, _ = env.reset(seed=4)
    points, view = surface_points(env.simulator, env.settings), agent_views(env)[0]
    seen, done, info = np.zeros(len(points), bool), False, {}
    while not done:
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = env.step(int(action))
        done = terminated or truncated
        view = agent_views(env)[0]
        pose = sensor_poses(env.settings, view.position[None], np.array([view.yaw]), np.array([view.pitch]))
        camera = env.settings.intrinsics
        pairs = candidates(pose, camera, points, ~seen[None], max_range_m=10.0)
        seen[pairs[env.simulator.visible(pose, camera, points, pairs, tolerance_m=0.1), 1]] = True
    return seen.mean(), info["coverage"]


def test_the_survey_sees_more_surfaces_than_the_oracle_and_more_floor_than_chance(env):
    survey, its_floor = share_of_surfaces_seen(env, SurveyPolicy(lambda: agent_views(env), width=NARROW))
    oracle, _ = share_of_surfaces_seen(env, OraclePolicy(lambda: agent_views(env), width=NARROW))
    random, random_floor = share_of_surfaces_seen(env, RandomPolicy.for_env(env, seed=0))
    assert survey > max(oracle, random) + 0.1
    assert its_floor > random_floor + 0.1


def test_surface_points_lie_on_surfaces_off_the_floor_and_apart(env):
    points = surface_points(env.simulator, env.settings)
    cubes = np.floor(points / SURFACE_SPACING_M).astype(int)
    assert len(np.unique(cubes, axis=0)) == len(points) > 100
    assert np.abs(points[:, 1] - env.simulator.area.centres[0, 1]).min() > 0.04
    origin = env.simulator.area.centres[:1] + [0.0, 1.5, 0.0]
    offset = points - origin
    length = np.linalg.norm(offset, axis=1)
    reached = env.simulator.distance(np.repeat(origin, len(points), axis=0), offset / length[:, None])
    assert (reached < length + 0.05).all()


def test_other_ways_of_counting_coverage_are_refused():
    other = AVPEnv("builtin:3", width=32, height=24, coverage_mode="over")
    other.reset(seed=0)
    with pytest.raises(UsageError, match="policy survey: plans for coverage_mode 'visible'"):
        SurveyPolicy.for_env(other).predict(np.zeros(12))


def looks_at_points(env, actions):
    """By brute force: how many points of the plan for two looks are seen, and how many along rays 10° apart."""
    env.reset(seed=4)
    places, first, second = scene_places(env.simulator, env.settings, surfaces=True, sparse=True), {}, set()
    for action in actions:
        env.step(int(action))
        pose = env.camera_to_world[None]
        pairs = candidates(
            pose, env.settings.intrinsics, places.points, np.ones((1, len(places.points)), bool), max_range_m=10
        )
        seen = env.simulator.visible(pose, env.settings.intrinsics, places.points, pairs, tolerance_m=0.1)
        for point in pairs[seen, 1]:
            ray = pose[0, :3, 3] - places.points[point]
            ray /= np.linalg.norm(ray)
            if ray @ first.setdefault(point, ray) <= np.cos(np.radians(10)):
                second.add(point)
    return len(first), len(second)


def test_the_survey_for_multiview_gets_second_looks_from_other_directions(env):
    env.reset(seed=4)
    view = agent_views(env)[0]
    plans = [make_plan(view, objective=objective, width=NARROW).actions for objective in ("surface", "multiview")]
    once, twice = (looks_at_points(env, actions) for actions in plans)
    assert twice[1] > 1.1 * once[1], (once, twice)
    assert twice[0] > 0.85 * once[0], (once, twice)
