"""Measure policies by views: how much of the held-out views they have seen, and with parallax, after 20, 40, 60, 80.

A cell is one policy in one scene. Those that the output file holds already, made by the same settings, are not run
again; of a model that changed, give another file. An episode that stopped keeps its last value. Depth is rendered at
`--width`: shares at 160 pixels were those at 640 within 0.1 percentage points (white_room, heuristic and greedy).
"""

import json
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import UsageError
from avp_habitat.files import atomic_file, check_writable
from avp_habitat.metrics import FIGURES, mean_and_half_width
from avp_habitat.policies.registry import POLICIES, POLICIES_HELP, TRUSTED, check_policy, make_policy_env, steps_of
from avp_habitat.policies.weights import PRETRAINED
from avp_habitat.poses import Intrinsics
from avp_habitat.provenance import PACKAGES, git_commit, installed_versions
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.sight.visibility import HeldoutPoints, grid_stride, heldout_points, visibility
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.tables import table
from avp_habitat.task.rewards import REWARDS_HELP
from avp_habitat.task.settings import TaskSettings

ALIKE_BOTH_WAYS = POLICIES.keys() - {PRETRAINED}
"""Policies that have no likeliest action to take instead of a sampled one."""
SHARES = ("visibility", "visibility_parallax")
LEGEND = (
    "Visibility and parallax in percent after so many views, mean ± 95 % interval (worst start); stop: share of "
    "episodes that the policy itself ended, percent."
)
HELDOUT_WIDTH, HELDOUT_HEIGHT = 640, 480
"""Of the held-out views, so that the tested points are those of a rollout."""


@dataclass(frozen=True)
class PolicyCurves:
    """Measure policies by views: how much of the held-out views they have seen, alone and with parallax.

    Runs what the output file lacks.
    """

    scene: Annotated[tuple[str, ...], arg(help=SCENES)]
    policy: Annotated[tuple[str, ...], arg(help=POLICIES_HELP)]
    starts: Annotated[int, Range(1, 10_000)] = 20
    """Episodes of each policy in each scene, all policies from the same starts."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 1000
    """Of the first start; episode i uses SEED + i."""
    reward: Annotated[str, arg(help=f"whose stop action counts: {REWARDS_HELP}")] = "multiview"
    budget: int = 80
    """Steps, which are views."""
    views: tuple[int, ...] = (20, 40, 60, 80)
    """After how many views to measure."""
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scenes."""
    together: bool = False
    """Show one row for each policy over all scenes, not one for each scene; intervals are over all episodes."""
    width: Annotated[int, Range(40, 640)] = 160
    """Of the depth images that tell what was seen, pixels; their height is three quarters of it."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False
    out: Path = Path("runs/policy_curves.json")
    """All cells; the table stands beside it as Markdown."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right."""
        hold_ranges(self)
        _ = self.settings
        if not self.scene or not self.policy:
            raise UsageError("scene and policy: expected at least one of each")
        if not self.views or not all(1 <= count <= self.budget for count in self.views):
            raise UsageError(f"views: expected numbers from 1 to the budget {self.budget}, got {self.views}")

    @property
    def settings(self) -> TaskSettings:
        """Of the task."""
        return TaskSettings(reward=self.reward, budget=self.budget)

    @property
    def made_by(self) -> dict[str, Any]:
        """What a cell must have been made by to be taken from the file."""
        names = ("starts", "seed", "reward", "budget", "width")
        return {name: getattr(self, name) for name in names} | {"views": list(self.views)}


@dataclass(frozen=True)
class Cell:
    """One policy in one scene."""

    scene: str
    """As the user calls it."""
    policy: str
    """As the user calls it."""
    sampled: bool
    """Whether actions are sampled instead of the likeliest ones taken."""

    @property
    def key(self) -> dict[str, Any]:
        """By which the file finds it; without folders."""
        names = {"scene": Path(self.scene).name, "policy": Path(self.policy).name}
        return {**names, "actions": "sampled" if self.sampled else "deterministic"}


def cells_of(options: PolicyCurves) -> list[Cell]:
    """All cells, scene by scene; policies that sample have two in each."""
    return [
        Cell(scene, policy, sampled)
        for scene in options.scene
        for policy in options.policy
        for sampled in ((False,) if policy in ALIKE_BOTH_WAYS else (False, True))
    ]


def target_points(simulator: Simulator, settings: TaskSettings) -> HeldoutPoints:
    """The tested points of the scene's held-out views, the same ones as those of a rollout's."""
    camera = Intrinsics.from_hfov(HELDOUT_WIDTH, HELDOUT_HEIGHT, hfov_deg=settings.hfov_deg)
    poses = heldout_poses(simulator, sensor_height_m=settings.sensor_height_m)
    seen = ((simulator.render(pose[None], camera, rgb=False).depth[0], pose) for pose in poses)
    return heldout_points(seen, camera, stride=grid_stride(camera))


def episode(
    simulator: Simulator,
    points: HeldoutPoints,
    camera_to_world: NDArray[np.float64],
    camera: Intrinsics,
    views: Sequence[int],
) -> dict[str, list[float]]:
    """Both shares after so many views of `(T, 4, 4)` frames; after more than T views those after T."""
    frames = ((simulator.render(pose[None], camera, rgb=False).depth[0], pose) for pose in camera_to_world)
    found = visibility(points, frames, camera)
    rows = np.minimum(views, found.frames) - 1
    curves = (found.curve(), found.curve(parallax=True))
    return {name: np.round(curve[rows], 5).tolist() for name, curve in zip(SHARES, curves, strict=True)}


def run_cell(cell: Cell, options: PolicyCurves, points: HeldoutPoints, simulator: Simulator, bar: Any) -> dict:
    """Run a cell's episodes; its entry of the file."""
    env, policy = make_policy_env(cell.policy, simulator, options.settings, seed=options.seed, trusted=options.trusted)
    camera = Intrinsics.from_hfov(options.width, options.width * 3 // 4, hfov_deg=options.settings.hfov_deg)
    episodes = []
    for number in range(options.starts):
        poses, info = [], {}
        for step in steps_of(env, policy, seed=options.seed + number, deterministic=not cell.sampled):
            poses.append(env.camera_to_world.copy())
            info = step.info
        figures = info["avp_episode"]
        about = {"views_used": len(poses), "stopped": bool(figures["stopped"]), "coverage": figures["coverage"]}
        episodes.append(about | episode(simulator, points, np.array(poses), camera, options.views))
        bar.update()
    return {**cell.key, **options.made_by, "commit": git_commit(), **summary(episodes), "episodes": episodes}


def summary(episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means and worst starts of a cell's episodes, shares within [0, 1]; lists are by number of views."""
    shares = {name: np.array([episode[name] for episode in episodes]) for name in SHARES}
    return {
        "mean": {name: np.round(values.mean(axis=0), 5).tolist() for name, values in shares.items()},
        "worst": {name: np.round(values.min(axis=0), 5).tolist() for name, values in shares.items()},
        "views_used": float(np.mean([episode["views_used"] for episode in episodes])),
        "stopped": float(np.mean([episode["stopped"] for episode in episodes])),
    }


def read(out: Path) -> list[dict[str, Any]]:
    """The cells of earlier calls, whatever their settings."""
    return json.loads(out.read_text(encoding="utf-8"))["cells"] if out.exists() else []


def is_done(cell: Cell, options: PolicyCurves, done: Sequence[dict[str, Any]]) -> bool:
    """Whether a cell's entry, made by these settings, is known."""
    wanted = cell.key | options.made_by
    return any({name: entry[name] for name in wanted} == wanted for entry in done)


def shown(options: PolicyCurves, done: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The entries that these settings made, which one table can hold."""
    wanted = options.made_by
    chosen = [entry for entry in done if {name: entry[name] for name in wanted} == wanted]
    asked = {Path(scene).name for scene in options.scene}
    return together([entry for entry in chosen if entry["scene"] in asked]) if options.together else chosen


def together(done: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One entry for each policy, with the episodes of all its scenes; those without one in every scene are left out."""
    scenes = {entry["scene"] for entry in done}
    merged = []
    for policy, actions in dict.fromkeys((entry["policy"], entry["actions"]) for entry in done):
        cells = [entry for entry in done if (entry["policy"], entry["actions"]) == (policy, actions)]
        if len(cells) == len(scenes):
            episodes = [episode for entry in cells for episode in entry["episodes"]]
            about = {"scene": f"{len(scenes)} scenes", "starts": len(episodes), "episodes": episodes}
            merged.append({**cells[0], **summary(episodes), **about})
    return merged


def rows_of(done: Sequence[dict[str, Any]], views: Sequence[int]) -> str:
    """The cells as a Markdown table in percent, with 95 % intervals over the starts; the worst start in brackets."""
    titles = [f"{FIGURES[name].title} {count}" for name in SHARES for count in views]
    head = ["scene", "policy", "actions", "starts", "views", "stop", *titles]
    rows = []
    for entry in done:
        cells = [str(entry[name]) for name in ("scene", "policy", "actions", "starts")]
        cells += [f"{entry['views_used']:.1f}", f"{100 * entry['stopped']:.0f}"]
        for name in SHARES:
            shares = 100 * np.array([episode[name] for episode in entry["episodes"]])
            columns = zip(*mean_and_half_width(shares), shares.min(axis=0), strict=True)
            cells += [f"{mean:.1f} ± {half:.1f} ({worst:.0f})" for mean, half, worst in columns]
        rows.append(cells)
    return table(head, rows, words=3)


def write(options: PolicyCurves, done: Sequence[dict[str, Any]]) -> None:
    """JSON, and beside it the table."""
    about = {
        "command": shlex.join(["python", "scripts/policy_curves.py", *sys.argv[1:]]),
        **options.made_by,
        "commit": git_commit(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": installed_versions(PACKAGES),
    }
    with atomic_file(options.out) as path:
        path.write_text(json.dumps({**about, "cells": list(done)}, indent=1) + "\n", encoding="utf-8")
    made = f"`{about['command']}` (commit {about['commit']}, {about['machine']})"
    page = ["# Policies by views", made, rows_of(shown(options, done), options.views), LEGEND]
    with atomic_file(options.out.with_suffix(".md")) as path:
        path.write_text("\n\n".join(page) + "\n", encoding="utf-8")


def main(options: PolicyCurves) -> None:
    """Run the cells that are not in the output file yet; what is done is kept after Ctrl-C."""
    for policy in options.policy:
        check_policy(policy)
    check_writable(options.out)
    done = read(options.out)
    left = [cell for cell in cells_of(options) if not is_done(cell, options, done)]
    with progress(total=len(left) * options.starts, desc="measuring", unit="episode") as bar:
        for scene in dict.fromkeys(cell.scene for cell in left):
            simulator = open_simulator(options.simulator, scene)
            points = target_points(simulator, options.settings)
            for cell in (cell for cell in left if cell.scene == scene):
                bar.set_description_str(" ".join(map(str, cell.key.values())), refresh=False)
                done.append(run_cell(cell, options, points, simulator, bar))
                write(options, done)
            del simulator
    print(rows_of(shown(options, done), options.views))
    print(LEGEND)
    print(f"{options.out}: {len(done)} cells")


if __name__ == "__main__":
    sys.exit(command.run(main))
