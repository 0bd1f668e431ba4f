"""`survey-multiview`: a beam search for points that are seen twice, the second time from another direction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.metrics import PARALLAX_DEG
from avp_habitat.policies.oracle.kernels import NEVER, choose
from avp_habitat.policies.oracle.places import ScenePlaces
from avp_habitat.policies.oracle.search import PACE, PER_KEY, Moves, all_moves, back_from, turning
from avp_habitat.sight.bits import ONE, Bits, lowest, unpack
from avp_habitat.sight.rules import camera_numbers, in_camera, in_image
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.float64]

FIRST, SECOND = 0.5, 0.5
"""What a point is worth once it is seen, and what more once a second ray to it stands `PARALLAX_DEG` from the first."""
ASIDE = 4.0
"""Steps counted from the first look at a point to the second, where the first is still to come."""
END = 0.0
"""What is seen when the budget ends counts as long as so many views more."""

_COSINE = float(np.cos(np.radians(PARALLAX_DEG)))
_CHORD = float(2 * np.sin(np.radians(PARALLAX_DEG) / 2))


@dataclass(frozen=True)
class TwiceStates:
    """n agents that have taken equally many views; every array's first axis is n. Rays lead from points to cameras."""

    position: Float
    """`(n, 3)` feet, metres."""
    yaw: Float
    """`(n,)` radians."""
    pitch: Float
    """`(n,)` radians."""
    seen: Bits
    """`(n, 2 * words)` sets of the points seen, then of those seen along a second ray."""
    first: NDArray[np.float32]
    """`(n, m, 3)` unit rays along which points were first seen; 0 where they were not."""
    value: Float
    """`(n,)` worth times views, as in `search.States`."""


def plan_second_looks(places: ScenePlaces, view: AgentView, views: int, width: int) -> NDArray[np.int64]:
    """The `(views,)` actions, never stop, by which most is worth most of the time, as far as the beam finds.

    As `search.beam_search`, with points that are worth `FIRST` once seen and `SECOND` more once seen along another ray.
    Nothing counts as seen before.
    """
    seen, first = np.zeros((1, 2 * len(places.wanted)), np.uint64), np.zeros((1, len(places.points), 3), np.float32)
    states = TwiceStates(view.position[None], np.array([view.yaw]), np.array([view.pitch]), seen, first, np.zeros(1))
    weight, history = picture_shares(places, view.settings), []
    for left in range(views - 1, -1, -1):
        states, parent, action = _advance(places, view.settings, states, weight, left, width)
        history.append((parent, action))
    return back_from(int(np.argmax(states.value)), history)


def _advance(
    places: ScenePlaces, settings: TaskSettings, states: TwiceStates, weight: Float, left: int, width: int
) -> tuple[TwiceStates, NDArray[np.int64], NDArray[np.int64]]:
    moves: Moves = all_moves(places, settings, states.position, states.yaw, states.pitch)
    pose = sensor_poses(settings, moves.position, moves.yaw, moves.pitch)
    eye, parent = np.ascontiguousarray(pose[:, :3, 3]), moves.parent
    camera = camera_numbers(settings.intrinsics)
    fresh, gain = look_twice(
        parent, moves.place, pose, camera, places.sees, places.points, states.seen, states.first, weight
    )
    value = states.value[parent] + (left + 1 + END) * (gain @ np.array([FIRST, SECOND]))
    seen = states.seen[parent] | fresh
    hope = outlook_twice(
        (parent, moves.place, eye, moves.heading),
        (seen, fresh, states.first),
        (places.wanted, places.points, places.reach, places.heading, weight),
        turning(settings),
        left,
        settings.forward_m,
        (FIRST, SECOND, ASIDE, END, PACE),
    )
    kept = choose(np.argsort(-(value + hope), kind="stable"), moves.key, seen, width, PER_KEY)
    first = states.first[parent[kept]]
    row, point = np.nonzero(unpack(fresh[kept, : len(places.wanted)], len(places.points)))
    ray = eye[kept[row]] - places.points[point]
    first[row, point] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    state = moves.position[kept], moves.yaw[kept], moves.pitch[kept]
    return TwiceStates(*state, seen[kept], first, value[kept]), parent[kept], moves.action[kept]


def picture_shares(places: ScenePlaces, settings: TaskSettings) -> Float:
    """`(m,)` how large the cubes of the points are in the pictures of level cameras all over the floor; on average 1.

    Otherwise the ceiling and the floor near the camera, which few pictures show, would count like the walls.
    """
    shares, eye = np.zeros(len(places.points)), places.position + [0.0, settings.sensor_height_m, 0.0]
    steepest = settings.intrinsics.height / 2 / settings.intrinsics.fy
    for place, seen in zip(eye, unpack(places.sees, len(shares)), strict=True):
        x, y, z = (places.points[seen] - place).T
        level = np.hypot(x, z)
        shares[seen] += (np.abs(y) <= steepest * level) / np.maximum(level**2 + y**2, 0.25)
    return shares / max(shares.mean(), 1e-12)


@njit(cache=True)
def _cosine_to(first, eye, point):
    """Cosine of the angle at a point between its first ray and that to an eye, and the eye's distance in metres."""
    x, y, z = eye[0] - point[0], eye[1] - point[1], eye[2] - point[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    return (x * first[0] + y * first[1] + z * first[2]) / distance, distance


@njit(cache=True)
def look_twice(parent, place, pose, camera, sees, points, seen, first, weight):
    """What n candidate views add; arguments as of `kernels.look`, `seen` and `first` those of `TwiceStates`.

    Returns:
        `(n, 2 * words)` points seen for the first time, and points seen along a second ray; `(n, 2)` what they weigh.
    """
    words = sees.shape[1]
    fresh, gain = np.zeros((len(parent), 2 * words), np.uint64), np.zeros((len(parent), 2), np.float64)
    for i in range(len(parent)):
        for k in range(words):
            left = sees[place[i], k] & ~seen[parent[i], words + k]
            while left:
                bit = lowest(left)
                left &= left - ONE
                point, mark = 64 * k + bit, ONE << np.uint64(bit)
                if not in_image(*in_camera(pose[i], points[point]), camera):
                    continue
                if not seen[parent[i], k] & mark:
                    fresh[i, k] |= mark
                    gain[i, 0] += weight[point]
                elif _cosine_to(first[parent[i], point], pose[i, :3, 3], points[point])[0] <= _COSINE:
                    fresh[i, words + k] |= mark
                    gain[i, 1] += weight[point]
    return fresh, gain


@njit(cache=True)
def _rest(left, steps, end):
    """For how many views a look that takes so many steps counts."""
    return left - steps + end if steps < left else 0.0


@njit(cache=True)
def outlook_twice(candidates, known, scene, turns, left, forward_m, rates):
    """`(n,)` what points that lack a look can still bring, as `kernels.outlook`.

    A second look costs at least the walk by which the ray turns enough.
    """
    parent, place, eye, yaw = candidates
    seen, fresh, first = known
    wanted, points, reach, heading, weight = scene
    near_turn, far_turn = turns
    worth_first, worth_second, steps_aside, end, pace = rates
    words, result = len(wanted), np.zeros(len(place), np.float64)
    for i in range(len(place)):
        for k in range(words):
            word = wanted[k] & ~seen[i, words + k]
            while word:
                bit = lowest(word)
                word &= word - ONE
                point, mark = 64 * k + bit, ONE << np.uint64(bit)
                half = reach[place[i], point]
                if half == NEVER:
                    continue
                turn = (int(heading[place[i], point]) - int(yaw[i])) & 255
                turned = 1.0 + (near_turn[turn] if half == 0 else far_turn[turn])
                if not seen[i, k] & mark:
                    steps = turned + 0.5 * half
                    result[i] += weight[point] * worth_first * _rest(left, pace * steps, end)
                    result[i] += weight[point] * worth_second * _rest(left, pace * (steps + steps_aside), end)
                    continue
                cosine, distance = _cosine_to(first[parent[i], point], eye[i], points[point])
                apart = 0.0 if fresh[i, k] & mark else np.sqrt(max(2 - 2 * cosine, 0.0))
                aside = max(_CHORD - apart, 0.0) * distance / forward_m
                result[i] += weight[point] * worth_second * _rest(left, pace * (turned + max(aside, 0.5 * half)), end)
    return result
