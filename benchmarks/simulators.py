"""How equal the two simulators are, on the same scenes: pictures, navigable areas, and the same walk; and how fast.

Needs habitat-sim. Pictures: both simulators look from the same poses at 640x480; depth is compared away from edges,
which are the pixels where inverse depth bends (it is linear over the picture of a plane). Areas: navigable cells, which
both lay in the same places. Walks: the same actions from the same start. `own`: each simulator in the area that it
computes, whose walls differ by up to a voxel, so that two agents may part at a corner; `file`: both with the NavMesh
that `avp_habitat.save_navmesh` writes. `frontier` actions are those that this baseline chooses in raycast, `random`
ones are forward as often as all others together and run into walls. The observation is compared until the first
contact, and with the file to the end. Sliding: single moves from random places, by the task's code and by Habitat-Sim's
own filter on the same NavMesh; a contact is a move that does not arrive in one of them.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import reporting
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from avp_habitat import command, poses
from avp_habitat.metrics import mean_and_half_width
from avp_habitat.policies.frontier import FrontierPolicy
from avp_habitat.policies.registry import check_policy
from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.habitat import HabitatSimulator
from avp_habitat.simulators.habitat.graphics import choose_gpu, inspect_graphics
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.observations import NAMES
from avp_habitat.task.settings import ACTION_NAMES, MOVE_FORWARD, TaskSettings
from avp_sb3.evaluation.policy import evaluate_policy

CAMERA = Intrinsics.from_hfov(640, 480, hfov_deg=90.0)
SENSOR_HEIGHT_M = 1.5
BEND_M = 0.02
"""Depth that differs by more than this from what a plane through the neighbours would have is an edge."""
_CHUNK = 5
_ARRIVED_M = 0.002
_PICTURE = "Per scene: raycast, habitat, and four times their difference"


@dataclass(frozen=True)
class Pictures:
    """Differences of pictures from n equal poses."""

    depth_m: NDArray[np.float64]
    """`(k,)` absolute differences of planar depth in metres, away from edges."""
    kept: float
    """Share of pixels that are away from edges."""
    psnr_db: NDArray[np.float64]
    """`(n,)` of the RGB pictures, all pixels."""


def compare_pictures(one: Simulator, other: Simulator, camera_to_world: NDArray[np.floating]) -> Pictures:
    """Look from `(n, 4, 4)` habitat poses with both; edges are those of `one`."""
    differences, kept, psnr = [], [], []
    for start in range(0, len(camera_to_world), _CHUNK):
        chunk = camera_to_world[start : start + _CHUNK]
        first, second = (simulator.render(chunk, CAMERA, rgb=True) for simulator in (one, other))
        assert first.rgb is not None
        assert second.rgb is not None
        smooth = ~edges(first.depth)
        differences.append(np.abs(first.depth - second.depth, dtype=np.float64)[smooth])
        kept.append(smooth.mean())
        squared = (first.rgb.astype(np.float64) - second.rgb) ** 2
        psnr.append(10 * np.log10(255**2 / np.maximum(squared.mean(axis=(1, 2, 3)), 1e-9)))
    return Pictures(np.concatenate(differences), float(np.mean(kept)), np.concatenate(psnr))


def edges(depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels of `(n, h, w)` planar depth next to which another surface begins, or where nothing was hit."""
    depth = depth.astype(np.float64)
    inverse = 1.0 / np.where(depth > 0, depth, np.nan)
    bent = ~np.isfinite(inverse)
    for axis in (1, 2):
        before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
        with np.errstate(invalid="ignore"):
            bent |= ~(np.abs(before + after - 2 * inverse) * depth**2 <= BEND_M)
    spread = bent.copy()
    for axis in (1, 2):
        spread |= np.roll(spread, 1, axis) | np.roll(spread, -1, axis)
    spread[:, [0, -1]] = spread[:, :, [0, -1]] = True
    return spread


def scattered_poses(simulator: Simulator, count: int, seed: int) -> NDArray[np.float64]:
    """`(count, 4, 4)` habitat poses over the navigable area, any yaw, pitch within 30°."""
    rng = np.random.default_rng(seed)
    position = simulator.area.random_points(rng, count) + np.array([0.0, SENSOR_HEIGHT_M, 0.0])
    yaw, pitch = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(-30, 30, count))
    return poses.camera_to_world(position, yaw=yaw, pitch=pitch)


def mask_overlap(one: Simulator, other: Simulator) -> tuple[float, float]:
    """Intersection over union of the navigable cells, and the ratio of their numbers, `other` to `one`."""
    first, second = (set(map(tuple, _cells(simulator, one))) for simulator in (one, other))
    return len(first & second) / len(first | second), len(second) / len(first)


def _cells(simulator: Simulator, frame: Simulator) -> list[list[int]]:
    """Rows and columns of a simulator's navigable cells in the grid of `frame`."""
    return frame.area.cell_of(simulator.area.centres).tolist()


@dataclass(frozen=True)
class Walk:
    """The same actions in both simulators; every array's first axis is the step."""

    apart_m: NDArray[np.float64]
    """`(n,)` distance of the two agents' feet in metres."""
    contact: int
    """Step at which one of them first moved less than it wanted; n when none did."""
    coverage: NDArray[np.float64]
    """`(n, 2)` of the first and the second simulator."""
    observation: NDArray[np.float64]
    """`(n, 12)` absolute differences as shares of each number's range."""


def compare_walks(
    one: Simulator, other: Simulator, actions: NDArray[np.integer], start: dict[str, Any], *, seed: int = 0
) -> Walk:
    """Do the same actions from the same start, given as options of `AVPEnv.reset`."""
    settings = TaskSettings(budget=len(actions), reward="coverage")
    first, second = (AVPEnv(simulator=simulator, settings=settings) for simulator in (one, other))
    for env in (first, second):
        env.reset(seed=seed, options=start)
    apart, coverage, observation, contact = [], [], [], len(actions)
    for step, action in enumerate(actions):
        before = [env.agent_pose[0] for env in (first, second)]
        seen = [env.step(action) for env in (first, second)]
        after = [env.agent_pose[0] for env in (first, second)]
        moved = [float(np.linalg.norm((b - a)[[0, 2]])) for a, b in zip(before, after, strict=True)]
        if action == MOVE_FORWARD and min(moved) < settings.forward_m - 1e-6:
            contact = min(contact, step)
        apart.append(np.linalg.norm(after[0] - after[1]))
        coverage.append([found[4]["coverage"] for found in seen])
        observation.append(np.abs(seen[0][0].astype(np.float64) - seen[1][0]))
    return Walk(np.array(apart), contact, np.array(coverage), np.array(observation) / _ranges())


def random_actions(count: int, seed: int) -> NDArray[np.int64]:
    """`(count,)` of the five moves, forward as often as all others together."""
    moves = len(ACTION_NAMES) - 1
    weights = [0.5] + [0.5 / (moves - 1)] * (moves - 1)
    return np.random.default_rng(seed).choice(moves, size=count, p=weights)


def with_navmesh_of(habitat: HabitatSimulator, scene: str) -> Simulator:
    """`raycast` of a scene with the NavMesh of the other simulator."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.navmesh"
        habitat.save_navmesh(path)
        simulator = make_simulator("raycast", scene, navmesh=path)
        assert simulator.area is not None  # Read now, while the file is there.
    return simulator


def frontier_actions(simulator: Simulator, count: int, start: dict[str, Any], seed: int) -> NDArray[np.int64]:
    """`(count,)` actions that the baseline chooses from a start."""
    env = AVPEnv(simulator=simulator, settings=TaskSettings(budget=count, reward="coverage"))
    policy = FrontierPolicy.for_env(env, seed)
    observation, _ = env.reset(seed=seed, options=start)
    actions = []
    for _ in range(count):
        actions.append(int(policy.predict(observation)[0]))
        observation, *_ = env.step(actions[-1])
    return np.array(actions)


def common_start(one: Simulator, other: Simulator, seed: int) -> dict[str, Any]:
    """Options of `AVPEnv.reset` for a random start that is navigable in both simulators."""
    rng = np.random.default_rng(seed)
    points = one.area.random_points(rng, 100)
    both = points[other.area.contains(points)]
    return {"position": both[0], "yaw": rng.uniform(-np.pi, np.pi)}


def _ranges() -> NDArray[np.float64]:
    """Width of the range of each observed number: sines and displacements reach from -1 to 1, the others from 0."""
    signed = ("dx", "dz", "sin", "cos")
    return np.array([2.0 if name.startswith(signed) else 1.0 for name in NAMES])


def _sliding(habitat: HabitatSimulator, moves: int, seed: int) -> dict[str, Any]:
    """The task's way to move beside Habitat-Sim's, from random places in random directions."""
    rng = np.random.default_rng(seed)
    begin = habitat.area.random_points(rng, moves)
    move = TaskSettings().forward_m * poses.heading(rng.uniform(-np.pi, np.pi, moves))
    ours, theirs = habitat.area.slide(begin, move), habitat.native_steps(begin, move)
    goal = begin + move

    def apart(one: NDArray[np.floating], other: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.linalg.norm((one - other)[:, [0, 2]], axis=1)

    between = apart(ours, theirs)
    contact = np.maximum(apart(ours, goal), apart(theirs, goal)) > _ARRIVED_M
    return {
        "moves": moves,
        "free_apart_mm": 1e3 * between[~contact].max(initial=0.0),
        "contacts": int(contact.sum()),
        "contacts_apart_percent": 100 * float((between[contact] > _ARRIVED_M).mean()),
        "most_apart_mm": 1e3 * between.max(),
    }


def _speed(simulator: Simulator, seed: int) -> float:
    """Steps per second of one environment, random actions, the policy's camera."""
    env = AVPEnv(simulator=simulator, settings=TaskSettings(reward="coverage"))
    env.reset(seed=seed)
    actions = random_actions(80, seed)
    env.step(actions[0])
    begin = time.perf_counter()
    for action in actions[1:]:
        env.step(action)
    return (len(actions) - 1) / (time.perf_counter() - begin)


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "simulators")
    add = made.add_argument
    add("--scene", default=["builtin:0"], nargs="+", help=SCENES)
    add("--poses", default=50, type=int, help="pictures from so many poses")
    add("--actions", default=200, type=int, help="length of the walk")
    add("--walks", default=5, type=int, help="walks, each from a start of its own")
    add("--moves", default=4000, type=int, help="single moves that are compared with Habitat-Sim's own")
    add("--policy", default=[], nargs="*", help="baselines' names or PPO models (.zip) to evaluate in both")
    add("--episodes", default=20, type=int, help="per policy, scene and simulator, from the same starts")
    add("--seed", default=0, type=int, help="of poses, starts and actions")
    add("--gpu", default=None, type=int, help="CUDA device of habitat; -1 for none; the first one when left out")
    return made


def main(argv: Sequence[str]) -> None:
    """Compare, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, poses=1, actions=1, walks=1, moves=1, episodes=1, seed=0)
    for policy in options.policy:
        check_policy(policy)
    rows = []
    with reporting.reported("simulators", options) as results:
        for name in ("simulators", "pictures", "areas", "walks", "sliding", "policies", "speed"):
            results[name] = []
        for scene in tqdm(options.scene, desc="scenes", disable=None):
            raycast = make_simulator("raycast", scene)
            habitat = cast(HabitatSimulator, make_simulator("habitat", scene, gpu=options.gpu))
            if not results["simulators"]:
                results["simulators"] = [_about(each, options.gpu) for each in (raycast, habitat)]
            _one_scene(raycast, habitat, with_navmesh_of(habitat, scene), options, results)
            _policies(scene, raycast.scene, options, results)
            rows.append(_side_by_side(raycast, habitat, options.seed))
            habitat.close()
            del habitat
    options.out.with_suffix(".jpg").unlink(missing_ok=True)
    Image.fromarray(np.concatenate(rows)).save(options.out.with_suffix(".jpg"), quality=88)
    reporting.write_page(options.out, "The two simulators side by side", __doc__, _PICTURE)


def _about(simulator: Simulator, gpu: int | None) -> dict[str, Any]:
    renderer = "Embree, on the CPU"
    if simulator.name == "habitat":
        device = choose_gpu(gpu)
        context = inspect_graphics(inspect_graphics().index_of(device)).context if device < 0 else None
        renderer = f"OpenGL {context.version}, {context.renderer}" if context else f"CUDA device {device}"
    return {"simulator": simulator.name, "version": simulator.version, "renderer": renderer}


def _policies(scene: str, name: str, options: argparse.Namespace, results: reporting.Results) -> None:
    for policy in options.policy:
        for simulator in ("raycast", "habitat"):
            gpu = options.gpu if simulator == "habitat" else None
            done = evaluate_policy(
                policy, scene, episodes=options.episodes, simulator=simulator, gpu=gpu, stochastic=True
            )
            row: dict[str, Any] = {"scene": name, "policy": Path(policy).name, "simulator": simulator}
            for figure, factor in (("coverage", 100), ("views", 1), ("stopped", 100), ("path_length_m", 1)):
                mean, half = mean_and_half_width(factor * done.figures[figure])
                row |= {figure: float(mean), f"{figure}_±": float(half)}
            results["policies"].append(row | {"episodes": options.episodes})


def _side_by_side(raycast: Simulator, habitat: Simulator, seed: int) -> NDArray[np.uint8]:
    """`(h, w, 3)` what both see from the pose that sees farthest of some, and four times the difference."""
    candidates = scattered_poses(raycast, 20, seed)
    depth = raycast.render(candidates, Intrinsics.from_hfov(32, 24, hfov_deg=90.0), rgb=False).depth
    pose = candidates[depth.mean(axis=(1, 2)).argmax()][None]
    one, other = (simulator.render(pose, CAMERA, rgb=True).rgb for simulator in (raycast, habitat))
    assert one is not None
    assert other is not None
    apart = np.minimum(4 * np.abs(one[0].astype(np.int16) - other[0]), 255).astype(np.uint8)
    return np.concatenate([one[0], other[0], apart], axis=1)[::2, ::2]


def _one_scene(
    raycast: Simulator,
    habitat: HabitatSimulator,
    same: Simulator,
    options: argparse.Namespace,
    results: reporting.Results,
) -> None:
    scene = {"scene": raycast.scene}
    seen = compare_pictures(raycast, habitat, scattered_poses(raycast, options.poses, options.seed))
    median, p99 = np.quantile(seen.depth_m, [0.5, 0.99])
    results["pictures"].append(
        scene
        | {"poses": options.poses, "depth_median_mm": 1e3 * median, "depth_p99_mm": 1e3 * p99, "pixels": seen.kept}
        | {"psnr_least_db": seen.psnr_db.min(), "psnr_mean_db": seen.psnr_db.mean()}
    )
    overlap, ratio = mask_overlap(raycast, habitat)
    areas = [simulator.area.area_m2 for simulator in (raycast, habitat)]
    results["areas"].append(
        scene | {"iou": overlap, "cells_ratio": ratio, "raycast_m2": areas[0], "habitat_m2": areas[1]}
    )
    for seed in tqdm(range(options.seed, options.seed + options.walks), desc="walks", disable=None):
        start = common_start(raycast, habitat, seed)
        actions = {
            "frontier": frontier_actions(raycast, options.actions, start, seed),
            "random": random_actions(options.actions, seed),
        }
        for kind, chosen in actions.items():
            for navmesh, first in (("own", raycast), ("file", same)):
                walk = compare_walks(first, habitat, chosen, start)
                row = {"navmesh": navmesh, "actions": kind, "seed": seed}
                results["walks"].append(scene | row | walk_figures(walk, whole=navmesh == "file"))
    results["sliding"].append(scene | _sliding(habitat, options.moves, options.seed))
    speeds = [_speed(simulator, options.seed) for simulator in (raycast, habitat)]
    results["speed"].append(scene | {"raycast_steps_s": speeds[0], "habitat_steps_s": speeds[1]})


def walk_figures(walk: Walk, *, whole: bool) -> dict[str, Any]:
    """What a table shows of a walk: lengths in millimetres, coverage in percent, observations in percent of range.

    Args:
        walk: of two agents.
        whole: compare the observations to the end, not only until the first contact.
    """
    free = walk.apart_m[: walk.contact]
    compared = walk.observation if whole else walk.observation[: walk.contact]
    worst = compared.max(axis=0, initial=0.0)
    return {
        "steps": len(walk.apart_m),
        "contact_at": walk.contact,
        "apart_before_mm": 1e3 * free.max(initial=0.0),
        "apart_after_mm": 1e3 * walk.apart_m.max(),
        "coverage_raycast": 100 * walk.coverage[-1, 0],
        "coverage_points": 100 * float(walk.coverage[-1, 1] - walk.coverage[-1, 0]),
        "observation_worst": 100 * worst.max(),
        "worst_number": NAMES[int(worst.argmax())],
    }


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    sys.exit(command.run(main))
