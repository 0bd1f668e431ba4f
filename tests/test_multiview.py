"""Parallax quality, the reward `multiview`, and what the observation of a robot holds."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from corridor import Corridor, RayCorridor
from test_surface import SETTINGS as SURFACE
from test_surface import WALK, seen_by_hand

from avp_habitat.simulators.registry import make_simulator
from avp_habitat.surface.around import turn
from avp_habitat.surface.points import scene_surface
from avp_habitat.task.onboard import PARTS
from avp_habitat.task.settings import STOP, TaskSettings
from avp_habitat.task.task import ViewpointTask

SETTINGS = replace(SURFACE, reward="multiview", observation="onboard")
FEET, YAW = [100, 900], np.array([0.3, -2.0])


@pytest.fixture(scope="module")
def corridor():
    return Corridor()


def pairs_by_hand(points, qualities, eyes):
    """S of every point from all pairs of frames, as the definition says, without any shortcut."""
    best = np.zeros(len(points))
    for i, k in combinations(range(len(eyes)), 2):
        a, b = points - eyes[i], points - eyes[k]
        sine = np.linalg.norm(np.cross(a, b), axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        both = np.sqrt(qualities[i] * qualities[k]) * np.minimum(1, sine / np.sin(np.radians(10)))
        best = np.maximum(best, both)
    return best


@pytest.mark.parametrize("kind", [Corridor, RayCorridor])
def test_parallax_grows_by_the_best_pair_of_all_frames_so_far(kind):
    corridor = kind()
    task, surface = ViewpointTask(corridor, SETTINGS, agents=2), scene_surface(corridor, SETTINGS)
    shown, best_sum = surface.shown, (surface.shown * surface.best).sum()
    task.reset(range(2), corridor.area.centres[FEET], YAW)
    qualities, eyes, before, best = ([], []), ([], []), np.zeros(2), np.zeros(2)
    for t, action in enumerate(WALK):
        facts = task.step(np.array([action, WALK[-1 - t]])).facts
        for i in range(2):
            pose = task.camera_to_world[i]
            qualities[i].append(seen_by_hand(SETTINGS, corridor, surface, pose))
            eyes[i].append(pose[:3, 3])
            after = shown @ pairs_by_hand(surface.points, qualities[i], eyes[i])
            every = np.max(qualities[i], axis=0)
            single = shown @ every
            assert facts.new_shown_twice[i] == pytest.approx(after - before[i], abs=2e-3)
            assert facts.new_shown[i] == pytest.approx(single - best[i], abs=2e-3)
            assert facts.shown_twice[i] == pytest.approx(after / best_sum, abs=1e-4)
            assert facts.shown[i] == pytest.approx(single / best_sum, abs=1e-4)
            assert facts.surface[i] == pytest.approx(every.sum() / surface.best.sum(), abs=1e-4)
            before[i], best[i] = after, single
    assert (before > 4).all()


@pytest.mark.parametrize("budget", [20, 70])
def test_tables_and_rays_agree_on_parallax(budget):
    room, rng = make_simulator("raycast", "builtin:3"), np.random.default_rng(1)
    start, totals = room.area.random_points(rng, 3), []
    actions = rng.choice(5, size=(budget, 3), p=[0.4, 0.2, 0.2, 0.1, 0.1])
    for lookup in (False, True):
        task = ViewpointTask(room, TaskSettings(reward="multiview", budget=budget, lookup=lookup), agents=3)
        task.reset(range(3), start, np.zeros(3))
        facts = [task.step(action).facts for action in actions]
        totals.append([np.sum([each.new_shown_twice for each in facts], axis=0), facts[-1].shown_twice])
    np.testing.assert_allclose(totals[0], totals[1], rtol=0.01)
    assert totals[0][1].min() > 0.01


def test_the_reward_weighs_both_growths_and_stop_ends_the_episode_at_any_time(corridor):
    constants = replace(SETTINGS.constants, single_weight=0.35)
    task = ViewpointTask(corridor, replace(SETTINGS, constants=constants), agents=1)
    task.reset([0], corridor.area.centres[[100]], np.zeros(1))
    for action in (0, 1, 0):
        outcome = task.step(np.array([action]))
        facts = outcome.facts
        amount = (0.35 * facts.new_shown + 0.65 * facts.new_shown_twice) ** 0.9
        assert outcome.parts["multiview"] == pytest.approx(constants.alpha_multiview * amount)
        assert not outcome.terminated
    outcome = task.step(np.array([STOP]))
    share = 0.35 * outcome.facts.shown + 0.65 * outcome.facts.shown_twice
    assert outcome.terminated
    assert outcome.parts["stop"] == pytest.approx(constants.stop_surface_bonus * share)
    assert outcome.facts.coverage < 0.85


def parts_of(observation):
    return dict(zip(PARTS, np.split(observation, np.cumsum(list(PARTS.values()))[:-1], axis=1), strict=True))


def test_what_a_robot_does_not_know_changes_nothing(corridor):
    """The same pictures in a scene whose unseen part differs: floor and surface behind a wall that was never seen."""
    task = ViewpointTask(corridor, SETTINGS, agents=1)
    privileged = ViewpointTask(corridor, replace(SETTINGS, observation="privileged"), agents=1)
    seen = [each.reset([0], corridor.area.centres[[100]], np.zeros(1)) for each in (task, privileged)]
    for action in (0, 1, 1, 4):
        seen = [each.step(np.array([action])).observation for each in (task, privileged)]
    np.testing.assert_array_equal(seen[0], seen[1][:, : seen[0].shape[1]])
    assert seen[1][0, seen[0].shape[1]] == pytest.approx(privileged.coverage[0], abs=1e-6)
    unseen = task._rooms[0].surface.quality(0) == 0
    surface = scene_surface(corridor, SETTINGS)
    surface.points[unseen] += 0.3
    try:
        np.testing.assert_array_equal(task._observe(np.array([0]), *_shown(task)), seen[0])
    finally:
        surface.points[unseen] -= 0.3


def _shown(task):
    rows = np.array([0])
    shown = task._shown(rows, lambda room, there: room.sensor.look(task._views(there)))
    return shown, task._facts(np.array([0]), shown.new_cells, np.zeros((1, 2, 4))).spread_m


def test_a_robots_parts_say_what_they_are_called(corridor):
    task = ViewpointTask(corridor, SETTINGS, agents=2)
    parts = parts_of(task.reset(range(2), corridor.area.centres[FEET], YAW))
    assert not any(parts[name].any() for name in ("gains", "last action", "views from here", "views", "floor"))
    assert not parts["surface around"].any()
    for _ in range(2):
        parts = parts_of(task.step(np.array([1, 4])).observation)
    assert parts["last action"].argmax(axis=1).tolist() == [1, 4]
    here = parts["views from here"].reshape(2, 3, 12)
    # Two views level, ten degrees apart; two level and then twenty degrees down.
    assert (here[0, 1].sum(), here[1, 0].sum(), here[1, 1].sum()) == (0.5, 0.25, 0.25)
    assert parts["views"].sum(axis=1).tolist() == [0.5, 0.5]
    around = parts["surface around"].reshape(2, 2, 3, 36)
    ahead, behind = around[0, 0, 1, [34, 35, 0, 1, 2]], around[0, 0, 1, 14:23]
    assert ahead.min() > 0.2
    assert not behind.any()
    assert (parts["free"].reshape(2, 2, 24)[0, 0] == 1).all()  # nothing in the way is known yet
    for action in (4, 4, 4, 4, *[1] * 12):
        parts = parts_of(task.step(np.array([action, action])).observation)
    free = parts["free"].reshape(2, 2, 24)
    assert (free[:, 0].min(axis=1) < 0.9).all()
    assert (free[:, 1].max(axis=1) > 0.2).all()


def test_turns_are_those_of_the_arc_tangent():
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    found = np.array([turn(2 * np.cos(a), 2 * np.sin(a)) for a in angle])
    np.testing.assert_allclose(found, angle / (2 * np.pi), atol=1e-4)
