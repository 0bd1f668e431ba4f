import itertools
from dataclasses import replace

import numpy as np
import pytest
from corridor import Corridor

from avp_habitat.policies.frontier import (
    FrontierPlanner,
    FrontierPolicy,
    find_frontiers,
    route_to,
    shortest_walks,
    walkable,
)
from avp_habitat.policies.greedy import GreedyPlanner, Start, expected_cells, search
from avp_habitat.policies.predicted_views import (
    BLOCKED,
    FREE,
    OBSERVED,
    UNKNOWN,
    KnownMap,
    Memory,
    in_view,
    known_map,
    looking_down,
    make_lens,
)
from avp_habitat.policies.reactive import SpinPlanner
from avp_habitat.policies.registry import make_policy
from avp_habitat.poses import camera_to_world, project
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.agent_view import AgentView, agent_views
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import MOVE_FORWARD, STOP, TURN_LEFT, TURN_RIGHT, TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv

SETTINGS = TaskSettings(reward="coverage", width=32, height=24)
PLANNERS = ("spin", "frontier", "greedy")


@pytest.fixture(scope="module")
def room():
    return make_simulator("raycast", "builtin:0")


def make_env(simulator, **changes):
    return AVPEnv(simulator=simulator, settings=replace(SETTINGS, **changes))


def play(env, policy, seed, steps):
    """Views before each action, the actions, and the coverage in the end."""
    observation, info = env.reset(seed=seed)
    views, actions = [], []
    for _ in range(steps):
        views += agent_views(env)
        action, _ = policy.predict(observation)
        actions.append(int(action))
        observation, _, _, _, info = env.step(actions[-1])
    return views, actions, info["coverage"]


def grid(*rows):
    """A known map from a drawing: space unknown, f free, o observed, # blocked."""
    codes = {" ": UNKNOWN, "f": FREE, "o": OBSERVED, "#": BLOCKED}
    state = np.array([[codes[letter] for letter in row] for row in rows], dtype=np.uint8)
    return KnownMap(state, np.zeros(2, dtype=np.int64), 0.1, np.zeros(2))


def view_at(simulator, x, z, *, yaw=0.0, pitch=0.0, observed=None, depth=5.0, **changes):
    if observed is None:
        observed = np.zeros(len(simulator.area.centres), dtype=bool)
    state = AgentView(SETTINGS, simulator, np.array([x, 0.0, z]), yaw, pitch, 0, observed, depth, False)
    return replace(state, **changes)


# What an agent knows.


def test_the_known_map_holds_observed_cells_their_neighbours_and_the_floor_around_the_body_only():
    area = Corridor().area
    observed = np.zeros(len(area.centres), dtype=bool)
    cell = area.cell_of(area.centres)
    observed[(cell == [15, 27]).all(axis=1)] = True  # beside the dividing wall, whose cells begin at column 28
    view = view_at(Corridor(), 1.0, 1.0, observed=observed)
    known = known_map(view, view.position[None])
    state = {tuple(at + known.first): int(known.state[tuple(at)]) for at in np.argwhere(known.state != UNKNOWN)}
    assert state[15, 27] == OBSERVED
    assert {state[15, 28], state[14, 28], state[16, 28]} == {BLOCKED}
    assert {state[14, 27], state[16, 27], state[15, 26]} == {FREE}
    body = [at for at in state if at[1] < 20]
    assert state[10, 10] == FREE
    assert max(np.hypot(row - 10, column - 10) for row, column in body) <= 3
    assert len(state) == 9 + len(body)


@pytest.mark.parametrize("name", PLANNERS)
def test_decisions_do_not_depend_on_floor_that_was_not_observed(name, room):
    env = make_env(room)
    policy = make_policy(name, env, 0)
    views, actions, _ = play(env, policy, 3, 40)
    rng = np.random.default_rng(0)
    known = np.zeros(room.area.mask.shape, dtype=bool)
    stood = room.area.cell_of(np.array([view.position for view in views]))
    for row, column in np.concatenate([room.area.cell_of(room.area.centres[views[-1].observed]), stood]):
        known[max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5] = True
    mask = np.where(known, room.area.mask, rng.random(known.shape) < 0.5)
    mask = np.pad(mask, ((0, 30), (0, 20)), constant_values=True)
    heights = np.pad(room.area.heights, ((0, 30), (0, 20)))
    other = replace(room.area, mask=mask, heights=heights)
    assert len(other.centres) != len(room.area.centres)

    class Changed:
        area = other

    place = np.zeros(mask.shape, dtype=bool)
    planner = type(policy)(lambda: [], 0).make_planner(np.random.default_rng(0))
    again = []
    for view in views:
        place[:] = False
        place[tuple(room.area.cell_of(room.area.centres[view.observed]).T)] = True
        again.append(planner.act(replace(view, simulator=Changed(), observed=place[mask])))
    assert again == actions


def test_cells_that_a_view_should_have_shown_are_counted_as_missed_until_they_are_observed():
    observed = np.zeros(len(Corridor().area.centres), dtype=bool)
    view = view_at(Corridor(), 1.0, 1.5, yaw=-np.pi / 2, pitch=np.radians(-50), observed=observed)
    memory = Memory()
    _, misses = memory.update(view)
    assert misses.max() == 0  # the first observation is not a captured view
    for count in (1, 2):
        known, misses = memory.update(replace(view, steps=count))
        row, column = known.at(np.array([1.55, 0.0, 1.55])).astype(int)
        assert misses[row, column] == count
        row, column = known.at(np.array([0.45, 0.0, 1.55])).astype(int)
        assert misses[row, column] == 0  # behind the agent


# Sight, routes and the search.


def test_expected_views_are_those_of_the_cameras_projection_and_lines_without_obstacles():
    rng = np.random.default_rng(1)
    state = np.where(rng.random((60, 70)) < 0.03, BLOCKED, UNKNOWN).astype(np.uint8)
    cells = np.argwhere(state == UNKNOWN)
    settings = replace(SETTINGS, max_range_m=3.0)
    yaw, pitch, turn = 0.7, np.radians(-30), np.radians(settings.turn_deg)
    points = np.stack([cells[:, 1] + 0.5, np.zeros(len(cells)), cells[:, 0] + 0.5], axis=1) * 0.1
    yaws = yaw + turn * np.arange(-4, 5)
    found = np.array([in_view(state, cells, 30.3, 20.6, yaw, pitch, make_lens(settings, 0.1)) for yaw in yaws])
    camera = np.tile([2.06, 1.5, 3.03], (9, 1))
    pixel, depth = project(points, camera_to_world(camera, yaw=yaws, pitch=np.full(9, pitch)), settings.intrinsics)
    inside = (depth > 0) & (pixel >= 0).all(axis=-1) & (pixel <= [settings.width, settings.height]).all(axis=-1)
    inside &= np.linalg.norm(points - camera[0], axis=1) <= 3.0
    clear = []
    for cell in cells + 0.5:
        steps = int(np.ceil(np.abs(cell - [30.3, 20.6]).max()))
        line = [30.3, 20.6] + (cell - [30.3, 20.6]) * np.arange(1, steps)[:, None] / max(steps, 1)
        clear.append(not (state[tuple(line.astype(int).T)] == BLOCKED).any())
    assert found.sum() > 1000
    np.testing.assert_array_equal(found, inside & np.array(clear))


def test_the_gain_of_the_best_moves_is_the_brute_force_count_and_close_to_the_greatest_of_all_moves():
    # One cell wide, so that forward moves along it are the only places.
    state = np.full((60, 60), UNKNOWN, dtype=np.uint8)
    state[10:41, 30] = OBSERVED
    state[20:25, 36:38] = BLOCKED
    cells = np.argwhere(state == UNKNOWN)
    cells = cells[np.random.default_rng(2).random(len(cells)) < 0.4]
    settings = replace(SETTINGS, max_range_m=2.5)
    lens, turn, discount = make_lens(settings, 0.1), np.radians(20), 0.9
    start = Start(40.5, 30.5, 0.0, np.radians(-20), turn, 2.5)

    def gain_of(moves):
        row, column, yaw, seen, total = start.row, start.column, start.yaw, np.zeros(len(cells), dtype=bool), 0.0
        for number, move in enumerate(moves):
            if move == MOVE_FORWARD:
                to = row - 2.5 * np.cos(yaw), column - 2.5 * np.sin(yaw)
                if not walkable(state == OBSERVED, row, column, *to):
                    return -1.0
                row, column = to
            else:
                yaw += turn if move == TURN_LEFT else -turn
            now = in_view(state, cells, row, column, yaw, start.pitch, lens)
            total += discount**number * np.count_nonzero(now & ~seen)
            seen |= now
        return total

    moves, gain = search(state, cells, start, lens, horizon=4, discount=discount)
    assert gain == pytest.approx(gain_of(moves))
    best = max(gain_of(way) for way in itertools.product((MOVE_FORWARD, TURN_LEFT, TURN_RIGHT), repeat=4))
    # Turning back to a pose that fewer moves reach is left out, which may cost a little.
    assert 0.9 * best < gain <= best + 1e-9
    assert search(state, cells[:0], start, lens, horizon=4, discount=discount) == ([], 0.0)


def test_the_search_walks_through_known_navigable_cells_only():
    known = grid(*["##########", "#        #", "#ffffffff#", "#ffffffff#", "#        #", "##########"])
    start = Start(3.0, 2.5, -np.pi / 2, np.radians(-50), np.radians(10), 2.5)  # looks along the free rows
    lens = make_lens(SETTINGS, 0.1)
    far = np.array([[2, 8], [3, 8]])
    behind = np.array([[0, 2], [5, 2]])
    moves, gain = search(known.state, far, start._replace(yaw=np.pi / 2), lens, horizon=30, discount=1.0)
    assert gain == 2
    moves, _ = search(known.state, behind, start._replace(yaw=0.0), lens, horizon=12, discount=1.0)
    assert MOVE_FORWARD not in moves


def test_unknown_floor_is_expected_near_free_floor_but_not_beyond_obstacles():
    known = grid("  #          ", "  #ooof      ", "  #          ", "  ###########")
    expected = expected_cells(known, np.zeros_like(known.state))
    assert np.argwhere(expected[1]).ravel().tolist() == [6, 7, 8, 9, 10, 11]
    assert not expected[:, :3].any()
    assert not expected_cells(known, np.full_like(known.state, 9)).any()


def test_walks_are_the_shortest_and_do_not_cut_corners():
    navigable = np.ones((5, 5), dtype=bool)
    navigable[0:4, 2] = False
    length, before = shortest_walks(navigable, 0, 0)
    route = route_to(before, np.array([0, 4]))
    # Diagonally to row 4 and back costs more: two diagonal steps beside the wall would cut its corner.
    assert length[0, 4] == pytest.approx(4 + 4 + 4 - 2 * (2 - np.sqrt(2)))
    assert navigable[tuple(route.T)].all()
    assert route[-1].tolist() == [0, 4]
    assert np.isinf(length[0, 2])


# The baselines.


def test_frontiers_are_observed_cells_beside_unobserved_navigable_ones():
    known = grid("#########", "#fooooof#", "#fooooof#", "#ooooooo#", "#fooooo##", "####f####")
    found = find_frontiers(known, np.zeros_like(known.state))
    # The one on the left has 4 cells; the lower middle's 3 touch it; the right has 3.
    by_hand = np.zeros(known.state.shape, dtype=bool)
    for row, column in np.argwhere(known.state == OBSERVED):
        by_hand[row, column] = (known.state[row - 1 : row + 2, column - 1 : column + 2] == FREE).any()
    cells = np.concatenate([frontier.cells for frontier in found])
    assert sorted(map(tuple, cells)) == sorted(map(tuple, np.argwhere(by_hand)))
    edges = np.concatenate([frontier.edge for frontier in found])
    assert {tuple(edge) for edge in edges} == {tuple(cell) for cell in np.argwhere(known.state == FREE)}
    assert find_frontiers(known, np.full_like(known.state, 8)) == []


def test_the_frontier_baseline_walks_over_known_floor_only_and_towards_a_frontier(room):
    env = make_env(room)
    views, actions, coverage = play(env, FrontierPolicy.for_env(env, 0), 5, 80)
    stood = np.array([view.position for view in views])
    walks = 0
    for number in np.flatnonzero(np.array(actions) == MOVE_FORWARD):
        view = views[number]
        known = known_map(view, stood[: number + 1])
        ahead = view.position - SETTINGS.forward_m * np.array([np.sin(view.yaw), 0.0, np.cos(view.yaw)])
        assert walkable(known.state != UNKNOWN, *known.at(view.position), *known.at(ahead))
        length, _ = shortest_walks(known.navigable, *known.at(view.position).astype(int))
        frontiers = find_frontiers(known, np.zeros_like(known.state))
        assert any(np.isfinite(length[tuple(frontier.cells.T)]).any() for frontier in frontiers)
        walks += 1
    assert walks > 5
    assert coverage > 0.4


def test_without_a_frontier_the_planners_turn_in_place():
    corridor = Corridor()
    everything = np.ones(len(corridor.area.centres), dtype=bool)
    for planner in (FrontierPlanner(), GreedyPlanner()):
        view = view_at(corridor, 1.0, 1.0, pitch=looking_down(SETTINGS), observed=everything)
        assert [planner.act(replace(view, steps=step)) for step in (1, 2, 3)] == [TURN_LEFT] * 3


@pytest.mark.parametrize(("x", "action"), [(1.0, TURN_RIGHT), (5.0, TURN_LEFT)])
def test_planners_turn_to_the_nearer_side(x, action):
    # The agent looks along -Z; all is observed but a strip at x = 2.1 m, or at x = 3.9 m.
    corridor = Corridor()
    gap = corridor.area.cell_of(corridor.area.centres)[:, 1] == (21 if x < 3 else 39)
    view = view_at(corridor, x, 2.5, yaw=0.0, pitch=looking_down(SETTINGS), observed=~gap, steps=1)
    assert FrontierPlanner().act(view) == action
    assert GreedyPlanner().act(view) == action


def test_looking_down_closes_the_gap_before_the_body():
    assert np.degrees(looking_down(TaskSettings())) == pytest.approx(-50)
    assert np.degrees(looking_down(TaskSettings(pitch_limit_deg=35))) == pytest.approx(-30)
    assert looking_down(TaskSettings(sensor_height_m=0.2)) == 0.0


def test_spin_turns_a_full_circle_walks_two_metres_and_turns_again():
    corridor = Corridor()
    env = make_env(corridor)
    policy = make_policy("spin", env, 0)
    observation, _ = env.reset(options={"position": [0.5, 2.0], "yaw": -np.pi / 2})
    actions = []
    for _ in range(80):
        actions.append(int(policy.predict(observation)[0]))
        observation, *_ = env.step(actions[-1])
    assert actions == [TURN_LEFT] * 36 + [MOVE_FORWARD] * 8 + [TURN_LEFT] * 36
    assert env.agent_pose[1] == pytest.approx(-np.pi / 2)


def test_spin_turns_to_where_there_is_room_before_it_walks():
    planner = SpinPlanner(np.random.default_rng(0))
    view = view_at(Corridor(), 1.0, 1.0, depth=0.4)
    aside = [planner.act(view) for _ in range(41)][36:]
    assert len(set(aside)) == 1
    assert planner.act(replace(view, centre_depth=3.0)) == MOVE_FORWARD
    assert planner.act(replace(view, collided=True)) == TURN_LEFT


@pytest.mark.parametrize("name", PLANNERS)
def test_a_vector_environment_gets_the_actions_of_single_ones_also_in_the_next_episode(name, room):
    settings = replace(SETTINGS, budget=15)
    both = AVPVecEnv(agents=2, simulator=room, settings=settings, seed=7)
    policy = make_policy(name, both, 3)  # type: ignore[arg-type]
    observation, together, starts = both.reset(), [], []
    for step in range(30):
        if step % 15 == 0:
            starts.append(agent_views(both))
        actions, _ = policy.predict(observation)
        together.append(actions)
        observation, *_ = both.step(actions)
    for agent in range(2):
        env = make_env(room, budget=15)
        single = make_policy(name, env, 3 + agent)
        alone = []
        for start in starts:
            view = start[agent]
            observation, _ = env.reset(options={"position": view.position, "yaw": view.yaw})
            for _ in range(15):
                alone.append(int(single.predict(observation)[0]))
                observation, *_ = env.step(alone[-1])
        assert alone == [int(actions[agent]) for actions in together]


def test_planning_beats_turning_and_no_planner_stops(room):
    coverage = {}
    for name in ("heuristic", *PLANNERS):
        env = make_env(room)
        _, actions, coverage[name] = play(env, make_policy(name, env, 0), 1000, 80)
        assert STOP not in actions
    assert coverage["greedy"] > coverage["frontier"] > max(coverage["spin"], coverage["heuristic"])
    assert coverage["greedy"] > 0.7
