import dataclasses

import numpy as np
import pytest
from corridor import Corridor, hit_distance

from avp_habitat import poses
from avp_habitat.errors import UsageError
from avp_habitat.poses import pixel_directions
from avp_habitat.task.rewards import RewardConstants, StepFacts, find_reward, reward_parts
from avp_habitat.task.settings import (
    ACTION_NAMES,
    LOOK_DOWN,
    LOOK_UP,
    MOVE_FORWARD,
    STOP,
    TURN_LEFT,
    TURN_RIGHT,
    TaskSettings,
)
from avp_habitat.task.task import ViewpointTask
from avp_habitat.task.trajectory import episode_metrics

SIMULATOR = Corridor()
AREA = SIMULATOR.area
# Few and wide cells' worth of visits: large forward steps and turns would never come back to a place.
SETTINGS = TaskSettings(
    budget=40,
    width=16,
    height=12,
    forward_m=0.25,
    turn_deg=30.0,
    constants=RewardConstants(redundancy_distance_m=0.3, redundancy_angle_deg=31.0, stop_coverage=0.7),
)


class ByHand:
    """One agent of the task, in plain Python from the design's words."""

    def __init__(self, settings, position, yaw):
        self.s, self.p, self.yaw, self.pitch = settings, np.array(position), yaw, 0.0
        self.start = self.p.copy()
        self.visited, self.views, self.cells, self.seen, self.t = [self.p.copy()], [], [], {}, 0
        self.collided = False

    def look(self):
        pose = poses.camera_to_world(
            (self.p + [0, 1.5, 0])[None], yaw=np.array([self.yaw]), pitch=np.array([self.pitch])
        )
        local = pixel_directions(self.s.intrinsics).reshape(-1, 3)
        return pose[0], hit_distance(np.broadcast_to(pose[0, :3, 3], local.shape), local @ pose[0, :3, :3].T)

    def step(self, action):
        s, c = self.s, self.s.constants
        self.t += 1
        before = self.p.copy()
        if action == MOVE_FORWARD:
            self.p = AREA.slide(self.p[None], np.array([[-np.sin(self.yaw), 0, -np.cos(self.yaw)]]) * s.forward_m)[0]
        if action == TURN_LEFT:
            self.yaw += np.radians(s.turn_deg)
        if action == TURN_RIGHT:
            self.yaw -= np.radians(s.turn_deg)
        if action == LOOK_UP:
            self.pitch = min(self.pitch + np.radians(s.tilt_deg), np.radians(60))
        if action == LOOK_DOWN:
            self.pitch = max(self.pitch - np.radians(s.tilt_deg), -np.radians(60))
        moved = np.hypot(*(self.p - before)[[0, 2]])
        self.collided = bool(action == MOVE_FORWARD and moved < 0.05)
        cell = (int(np.floor(self.p[0] / 0.1 + 1e-9)), int(np.floor(self.p[2] / 0.1 + 1e-9)))
        visits = sum(1 for earlier in self.cells if earlier == cell)
        redundant = False
        for position, yaw, pitch in self.views:
            turned = abs((yaw - self.yaw + np.pi) % (2 * np.pi) - np.pi)
            tilted = abs(pitch - self.pitch)
            near = np.sqrt(((position - self.p) ** 2).sum()) < c.redundancy_distance_m
            redundant |= bool(near and max(turned, tilted) < np.radians(c.redundancy_angle_deg))
        self.cells.append(cell)
        self.views.append((self.p.copy(), self.yaw, self.pitch))
        self.visited.append(self.p.copy())
        new = self.observe()
        facts = StepFacts(
            new_cells=np.array([new]),
            new_surface=np.array([0.0]),
            earlier_visits=np.array([visits]),
            spread_m=np.array([self.spread()]),
            collided=np.array([self.collided]),
            redundant=np.array([redundant]),
            stop_chosen=np.array([action == STOP and s.reward == "proposed"]),
            coverage=np.array([self.coverage()]),
            steps_left=np.array([s.budget - self.t]),
        )
        return facts, {name: float(part[0]) for name, part in reward_parts(find_reward(s.reward), facts, c).items()}

    def observe(self):
        pose, _ = self.look()
        k = self.s.intrinsics.matrix
        new = 0
        for cell, point in enumerate(AREA.centres):
            local = np.linalg.inv(poses.habitat_to_opencv(pose)) @ np.append(point, 1)
            u, v, w = k @ local[:3]
            if cell in self.seen or w <= 0 or not (0 <= u / w < self.s.width and 0 <= v / w < self.s.height):
                continue
            ray = point - pose[:3, 3]
            length = np.linalg.norm(ray)
            if length <= 10 and hit_distance(pose[None, :3, 3], ray[None] / length)[0] >= length - 0.1:
                self.seen[cell] = self.t
                new += 1
        return new

    def coverage(self):
        return len(self.seen) / len(AREA.centres)

    def spread(self):
        mean = np.mean(self.visited, axis=0)
        return float(np.hypot(*(self.p - mean)[[0, 2]]))

    def observation(self):
        r = AREA.diameter_m
        _, depth = self.look()
        depth = np.minimum(depth, 10) / 10
        dx, _, dz = (self.p - self.start) / r
        return [
            self.t / self.s.budget, dx, dz, np.sin(self.yaw), np.cos(self.yaw), np.sin(self.pitch), np.cos(self.pitch),
            depth.min(), depth.mean(), self.coverage(), float(self.collided), self.spread() / r,
        ]  # fmt: skip


@pytest.mark.parametrize("reward", ["coverage", "coverage_redundancy", "proposed"])
def test_three_agents_at_once_do_what_one_does_by_hand(reward):
    settings = dataclasses.replace(SETTINGS, reward=reward)
    rng = np.random.default_rng(5)
    position, yaw = AREA.random_points(rng, 3), rng.uniform(-3, 3, 3)
    task = ViewpointTask(SIMULATOR, settings, agents=3)
    by_hand = [ByHand(settings, position[i], yaw[i]) for i in range(3)]
    first = task.reset([0, 1, 2], position, yaw)
    np.testing.assert_allclose(first, [agent.observation() for agent in by_hand], atol=1e-5)
    # Mostly forward, so that walls are met; the seed is checked below to meet every case.
    actions = rng.choice(6, size=(25, 3), p=[0.4, 0.15, 0.1, 0.1, 0.15, 0.1])
    met = {"collided": 0, "redundant": 0, "stop": 0, "visits": 0}
    for row in actions:
        outcome = task.step(row)
        for i, agent in enumerate(by_hand):
            facts, parts = agent.step(row[i])
            np.testing.assert_allclose(task.position[i], agent.p, atol=1e-9)
            assert outcome.facts.new_cells[i] == facts.new_cells[0]
            assert outcome.facts.earlier_visits[i] == facts.earlier_visits[0]
            assert outcome.facts.redundant[i] == facts.redundant[0]
            assert outcome.facts.collided[i] == facts.collided[0]
            assert {name: values[i] for name, values in outcome.parts.items()} == pytest.approx(parts)
            assert outcome.reward[i] == pytest.approx(sum(parts.values()))
            met["collided"] += bool(facts.collided[0])
            met["redundant"] += bool(facts.redundant[0])
            met["stop"] += bool(facts.stop_chosen[0])
            met["visits"] += int(facts.earlier_visits[0])
        np.testing.assert_allclose(outcome.observation, [agent.observation() for agent in by_hand], atol=1e-5)
    for i, agent in enumerate(by_hand):
        assert {cell: step for cell, step in enumerate(task.first_seen(i)) if step} == agent.seen
    assert met["collided"]
    assert met["redundant"]
    assert met["visits"]
    assert bool(met["stop"]) == (reward == "proposed")


def run_one(task, actions, position=(1.0, 0.0, 1.5), yaw=-1.2):
    task.reset([0], np.array([position]), np.array([yaw]))
    return [task.step(np.array([action])) for action in actions]


def test_the_start_is_not_a_view():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=1)
    observation = task.reset([0], np.array([[1.0, 0, 1.5]]), np.array([0.3]))
    assert observation[0, 9] == 0.0
    assert task.coverage[0] == 0.0


def test_pitch_stays_within_sixty_degrees_both_ways():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=1)
    run_one(task, [LOOK_UP] * 9)
    assert np.degrees(task.pitch[0]) == pytest.approx(60)
    for _ in range(15):
        task.step(np.array([LOOK_DOWN]))
    assert np.degrees(task.pitch[0]) == pytest.approx(-60)


def test_stop_without_enough_coverage_costs_and_goes_on():
    outcome = run_one(ViewpointTask(SIMULATOR, SETTINGS, agents=1), [STOP])[0]
    assert not outcome.terminated[0]
    assert outcome.parts["stop"][0] == -SETTINGS.constants.early_stop


def test_stop_with_enough_coverage_terminates_with_the_saved_steps_rewarded():
    easy = dataclasses.replace(SETTINGS, constants=RewardConstants(stop_coverage=0.002))
    outcomes = run_one(ViewpointTask(SIMULATOR, easy, agents=1), [LOOK_DOWN, STOP])
    assert outcomes[1].terminated.tolist() == [True]
    assert not outcomes[1].truncated[0]
    constants = easy.constants
    assert outcomes[1].parts["stop"][0] == pytest.approx(constants.stop_bonus + constants.stop_per_step_left * 38)


@pytest.mark.parametrize("reward", ["coverage", "coverage_redundancy"])
def test_without_a_stop_in_the_reward_stop_is_no_movement_and_never_ends(reward):
    easy = dataclasses.replace(SETTINGS, reward=reward, constants=RewardConstants(stop_coverage=0.0))
    task = ViewpointTask(SIMULATOR, easy, agents=1)
    outcomes = run_one(task, [STOP, STOP])
    np.testing.assert_array_equal(task.position[0], [1.0, 0, 1.5])
    assert not any(outcome.terminated[0] for outcome in outcomes)
    assert "stop" not in outcomes[1].parts
    assert task.steps[0] == 2


def test_the_budget_truncates():
    outcomes = run_one(ViewpointTask(SIMULATOR, SETTINGS, agents=1), [TURN_LEFT] * 40)
    assert [outcome.truncated[0] for outcome in outcomes] == [False] * 39 + [True]


def test_a_second_episode_remembers_nothing_and_leaves_other_agents_alone():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=2)
    start = np.array([[1.0, 0, 1.5], [4.0, 0, 2.0]])
    task.reset([0, 1], start, np.array([0.1, 2.0]))
    first = [task.step(np.array([action, action])) for action in (0, 1, 0)]
    seen = task.first_seen(1).copy()
    task.reset([0], start[:1], np.array([0.1]))
    np.testing.assert_array_equal(task.first_seen(1), seen)
    assert task.steps.tolist() == [0, 3]
    again = [task.step(np.array([action, STOP])) for action in (0, 1, 0)]
    for old, new in zip(first, again, strict=True):
        np.testing.assert_array_equal(old.observation[0], new.observation[0])
        assert old.reward[0] == new.reward[0]


def test_the_trajectory_and_its_figures_belong_together():
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=1)
    outcomes = run_one(task, [0, 0, 1, 0, 5])
    trajectory = task.trajectory(0)
    figures = episode_metrics(trajectory, stopped=False)
    assert figures["views"] == 5
    assert figures["coverage"] == pytest.approx(np.count_nonzero(trajectory.first_seen) / len(AREA.centres))
    assert figures["ei"] == pytest.approx(figures["coverage"] / 5)
    assert figures["path_length_m"] == pytest.approx(0.75)
    np.testing.assert_allclose(trajectory.coverage, [o.facts.coverage[0] for o in outcomes])
    for name in outcomes[0].parts:
        np.testing.assert_allclose(trajectory.reward_parts[name], [o.parts[name][0] for o in outcomes])
    assert sum(figures[f"return_{name}"] for name in outcomes[0].parts) == pytest.approx(
        sum(o.reward[0] for o in outcomes)
    )
    np.testing.assert_allclose(trajectory.camera_to_world[:, 1, 3], 1.5)


def test_wide_coverage_counts_at_least_what_is_visible():
    wide = dataclasses.replace(SETTINGS, coverage_mode="over")
    actions = [0, 1, 0, 2, 4]
    narrow_run = run_one(ViewpointTask(SIMULATOR, SETTINGS, agents=1), actions)[-1]
    wide_run = run_one(ViewpointTask(SIMULATOR, wide, agents=1), actions)[-1]
    assert wide_run.facts.coverage[0] > narrow_run.facts.coverage[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reward": "propsed"}, "unknown reward 'propsed'.*did you mean 'proposed'"),
        ({"budget": 0}, "budget: expected a whole number from 1 to 32,767, got 0"),
        ({"hfov_deg": 190}, "hfov_deg"),
        ({"pitch_limit_deg": 90}, "pitch_limit_deg"),
        ({"coverage_mode": "visble"}, "unknown coverage_mode 'visble'.*did you mean 'visible'"),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(change, words):
    with pytest.raises(UsageError, match=words):
        TaskSettings(**change)


def test_the_numbers_of_the_actions_are_those_of_the_design():
    names = ("move_forward", "turn_left", "turn_right", "look_up", "look_down", "stop")
    assert names == ACTION_NAMES
    task = ViewpointTask(SIMULATOR, SETTINGS, agents=6)
    task.reset(range(6), np.tile([1.0, 0, 1.5], (6, 1)), np.zeros(6))
    task.step(np.arange(6))
    # Looking along -Z, forward decreases z; left is a positive yaw, up a positive pitch.
    np.testing.assert_allclose(task.position[:, 2], [1.25, 1.5, 1.5, 1.5, 1.5, 1.5], atol=1e-6)
    np.testing.assert_allclose(np.degrees(task.yaw), [0, 30, -30, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(task.pitch), [0, 0, 0, 10, -10, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("actions", "redundant"),
    [
        ([TURN_LEFT, TURN_RIGHT], [False, False]),
        ([TURN_LEFT, TURN_RIGHT, TURN_LEFT], [False, False, True]),
        ([STOP, LOOK_DOWN], [False, False]),
        ([LOOK_DOWN, LOOK_UP, LOOK_DOWN, TURN_LEFT], [False, False, True, False]),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, np.pi - 0.01])
def test_a_view_is_redundant_only_when_place_yaw_and_pitch_all_come_back(actions, redundant, yaw):
    # Also across the half turn, where yaw jumps from +180 to -180 degrees.
    narrow = dataclasses.replace(SETTINGS, turn_deg=10.0, constants=RewardConstants(redundancy_angle_deg=5.0))
    task = ViewpointTask(SIMULATOR, narrow, agents=1)
    assert [bool(o.facts.redundant[0]) for o in run_one(task, actions, yaw=yaw)] == redundant


def test_angles_that_differ_across_the_half_turn_are_close():
    wide = dataclasses.replace(SETTINGS, turn_deg=10.0, constants=RewardConstants(redundancy_angle_deg=11.0))
    outcomes = run_one(ViewpointTask(SIMULATOR, wide, agents=1), [STOP, TURN_LEFT], yaw=np.pi - 0.05)
    assert outcomes[1].facts.redundant.tolist() == [True]
