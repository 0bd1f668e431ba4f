"""Measure how often the pose checks refuse a correct rollout, and how small a fault they catch.

Rollout NUMBER is drawn at random from its number: room, policy, size of the pictures and budget; NUMBER is its seed.
Every rollout is checked as it is; every fifth, until there are `--damaged` of them, also with small faults and with two
of the known mistakes.
What was judged already is read again from `--work`: a run that was stopped goes on.
"""

import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pose_faults import FAULTS, MORE_FAULTS, SMALL_FAULTS, damaged, write_faulty
from scipy.stats import beta

from avp_habitat import command
from avp_habitat.collect import Collect, collect
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.provenance import installed_versions
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import Rollout
from avp_habitat.task.settings import TaskSettings
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.check.depth_maps import DepthMaps, load_depth_maps
from avp_nerfstudio.check.geometry import check_geometry
from avp_nerfstudio.check.pictures.evidence import judge
from avp_nerfstudio.check.pictures.matching import Matches, match_pictures
from avp_nerfstudio.check.pictures.rays import RelativePoses, estimate_relative_poses
from avp_nerfstudio.check.shape import check_format

ROOT = Path(__file__).resolve().parent.parent
POLICIES = ("heuristic", "random", "spin", "frontier", "greedy", "survey")
BUILT_IN_ROOMS = 21
SIZES = {(160, 120): 0.6, (320, 240): 0.28, (640, 480): 0.12}
"""With what share of the rollouts has pictures of this size."""
BUDGETS = (10, 20, 30, 40, 60, 80)
HELDOUT = 8
DAMAGED_EVERY = 5
CHECKS = ("depth agreement", "ICP correction", "reprojection", "relative poses")
"""Those that look at the data; the format check sees every change of a pose in `steps.csv` besides."""
KNOWN = (*FAULTS, *MORE_FAULTS)
GOAL = 1 / 200
SEEN_BELOW = 1310
"""Rollouts below this number were looked at when the limits were chosen."""
_VERSIONED = ("avp-suite", "numpy", "open3d", "pycolmap", "pillow")


@dataclass(frozen=True)
class Drawn:
    """What a number stands for."""

    number: int
    """Also the seed."""
    scene: str
    """As `collect` takes it."""
    policy: str
    """A baseline's name."""
    size: tuple[int, int]
    """Of the pictures, pixels."""
    budget: int
    """Views."""

    @property
    def room(self) -> str:
        """The scene without its place."""
        return Path(self.scene).stem

    @property
    def name(self) -> str:
        """Of its folder."""
        width, height = self.size
        return f"{self.room.replace(':', '_')}-{self.policy}-{self.number}-{width}x{height}-{self.budget}"


def draw(number: int, scenes: Sequence[str]) -> Drawn:
    """Half of the rollouts or more lie in built-in rooms, the others in those given."""
    rng = np.random.default_rng(number)
    place = int(rng.integers(len(scenes) + max(2, len(scenes))))
    scene = scenes[place] if place < len(scenes) else f"builtin:{rng.integers(BUILT_IN_ROOMS)}"
    policy = POLICIES[rng.integers(len(POLICIES))]
    size = list(SIZES)[rng.choice(len(SIZES), p=list(SIZES.values()))]
    return Drawn(number, scene, policy, size, int(rng.choice(BUDGETS)))


@dataclass(frozen=True)
class Known:
    """What a rollout's pictures and depth say whatever its poses are."""

    maps: DepthMaps
    """The depth."""
    matches: Matches
    """The features."""
    relative: RelativePoses
    """With the right intrinsics."""
    right: Intrinsics
    """Those."""


def judge_views(rollout: Rollout, known: Known, *, explain: bool) -> list[Verdict]:
    """The verdicts on poses and intrinsics, as `python -m avp_nerfstudio.check` gives them."""
    geometry = check_geometry(rollout, maps=known.maps, explain=explain)
    poses = np.array([rollout.frames[frame].camera_to_world for frame in known.matches.frames])
    pictures = judge(
        known.matches,
        poses,
        rollout.intrinsics,
        proved=geometry.proved[known.matches.frames],
        estimated=known.relative if rollout.intrinsics == known.right else None,
    )
    return [*geometry.verdicts, *pictures]


def measure(drawn: Drawn, work: Path, *, faults: bool) -> dict[str, Any]:
    """Collect a rollout, once, and judge it, once."""
    results = work / "judged" / f"{drawn.name}{'-faults' * faults}.json"
    if results.exists():
        return json.loads(results.read_text(encoding="utf-8"))
    folder = work / drawn.name
    if not folder.exists():
        settings = TaskSettings(budget=drawn.budget)
        width, height = drawn.size
        options = Collect(drawn.scene, drawn.policy, folder, seed=drawn.number, width=width, height=height)
        collect(options, settings=settings, heldout=HELDOUT)
    rollout, verdict = check_format(folder)
    if rollout is None:
        raise AVPError(f"{folder}: {verdict.text}")
    matches = match_pictures(rollout, progress=False)
    relative = estimate_relative_poses(matches, rollout.intrinsics)
    maps = load_depth_maps(rollout.frames + rollout.heldout, rollout.intrinsics)
    known = Known(maps, matches, relative, rollout.intrinsics)
    verdicts = [verdict, *judge_views(rollout, known, explain=False)]
    found = {
        "number": drawn.number,
        "room": drawn.room,
        "policy": drawn.policy,
        "size": "{}x{}".format(*drawn.size),
        "views": len(rollout.frames),
        "failed": {verdict.name: verdict.text for verdict in verdicts if not verdict.passed},
        "figures": {name: float(f"{value:.4g}") for v in verdicts for name, value in v.figures.items()},
        "unjudged": [verdict.name for verdict in verdicts if "could not be" in verdict.text],
        "faults": list(_faulty(rollout, known, work / f"{drawn.name}-faulty", drawn.number)) if faults else [],
    }
    results.parent.mkdir(exist_ok=True)
    part = results.with_suffix(".part")
    part.write_text(json.dumps(found, allow_nan=False), encoding="utf-8")
    part.replace(results)
    return found


def _faulty(rollout: Rollout, known: Known, folder: Path, number: int) -> Iterator[dict[str, Any]]:
    """What is said of the rollout with each small fault, and with two of the known mistakes, which must be named."""
    for fault in SMALL_FAULTS:
        verdicts = judge_views(damaged(rollout, fault, seed=number), known, explain=False)
        yield {"fault": fault.name, "failed": [verdict.name for verdict in verdicts if not verdict.passed]}
    for fault in (KNOWN[number % len(KNOWN)], KNOWN[(number // 2 + 5) % len(KNOWN)]):
        shutil.rmtree(folder, ignore_errors=True)
        wrong, verdict = check_format(write_faulty(rollout.folder, folder, fault, seed=number))
        shutil.rmtree(folder)
        verdicts = [verdict] if wrong is None else [verdict, *judge_views(wrong, known, explain=True)]
        causes = {verdict.name: verdict.cause for verdict in verdicts if verdict.cause}
        cause = causes.get("depth agreement") or causes.get("format") or next(iter(causes.values()), "")
        yield {
            "fault": fault.name,
            "failed": [verdict.name for verdict in verdicts if not verdict.passed],
            "named": re.search(fault.named, cause) is not None,
            "cause": cause,
        }


@dataclass(frozen=True)
class PoseCheckResults:
    """Measure how often the pose checks refuse a correct rollout, and how small a fault they catch."""

    scene: tuple[str, ...] = ()
    """Rooms besides the built-in ones."""
    rollouts: Annotated[int, Range(1, 10**9)] = 150
    """How many."""
    first: int = 1000
    """The first one's number."""
    damaged: int = 30
    """How many of them are damaged too, every fifth at most."""
    jobs: Annotated[int, Range(1, 1024)] = os.cpu_count() or 1
    """Processes."""
    work: Path = Path("runs/pose-checks")
    """Rollouts and what was judged."""
    out: Path = Path("docs/results/pose_checks")
    """Tables."""

    def __post_init__(self) -> None:
        """Hold the ranges, and refuse a scene that is no file."""
        hold_ranges(self)
        for scene in self.scene:
            if not Path(scene).is_file():
                raise UsageError(f"scene: {scene}: expected a file, found none")


def measure_all(options: PoseCheckResults) -> list[dict[str, Any]]:
    """Measure every number, one per process at a time."""
    numbers = range(options.first, options.first + options.rollouts)
    damaged = numbers[::DAMAGED_EVERY][: options.damaged]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        waiting = [
            pool.submit(
                measure,
                draw(number, options.scene),
                options.work,
                faults=number in damaged,
            )
            for number in numbers
        ]
        done = []
        try:
            for one in as_completed(waiting):
                done.append(one.result())
                said = f"refused by {', '.join(done[-1]['failed'])}" if done[-1]["failed"] else "passed"
                print(f"{len(done)} of {len(waiting)}: rollout {done[-1]['number']} {said}", flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return sorted(done, key=lambda found: found["number"])


def upper_bound(events: int, trials: int) -> float:
    """The rate that is exceeded with 95 % confidence by no more (Clopper and Pearson)."""
    return float(beta.ppf(0.95, events + 1, trials - events)) if events < trials else 1.0


def group_table(found: Sequence[dict[str, Any]], title: str, group: Callable[[dict[str, Any]], str]) -> list[str]:
    """Correct rollouts and false alarms by group."""
    lines = [
        f"| {title} | rollouts | views | false alarms | matches that do not fit, most [%] | "
        "focal length off, most [%] | pictures not judged |",
        "|---" * 7 + "|",
    ]
    for name in sorted({group(one) for one in found}, key=lambda name: (len(name), name)):
        mine = [one for one in found if group(one) == name]
        figures = [one["figures"] for one in mine]
        misfit = max((figure.get("misfit_percent", 0.0) for figure in figures), default=0.0)
        focal = max(abs(figure.get("best_focal_factor", 1.0) - 1) for figure in figures)
        unjudged = sum("reprojection" in one["unjudged"] for one in mine)
        lines.append(
            f"| {name} | {len(mine)} | {sum(one['views'] for one in mine)} | "
            f"{sum(bool(one['failed']) for one in mine)} | {misfit:.1f} | {100 * focal:.2f} | {unjudged} |"
        )
    return lines


def small_fault_table(found: Sequence[dict[str, Any]]) -> list[str]:
    """Share of the rollouts in which each check caught each small fault."""
    sizes = sorted({one["size"] for one in found if one["faults"]}, key=lambda size: (len(size), size))
    columns = [*CHECKS, "any of them", *(f"any, {size}" for size in sizes)]
    lines = [f"| fault | rollouts | {' | '.join(columns)} |", "|---" * (len(columns) + 2) + "|"]
    for fault in SMALL_FAULTS:
        rows = [
            (one["size"], row["failed"])
            for one in found
            for row in one["faults"]
            if row["fault"] == fault.name and "named" not in row
        ]
        shares = [_share([check in failed for _, failed in rows]) for check in CHECKS]
        shares.append(_share([bool(failed) for _, failed in rows]))
        shares += [_share([bool(failed) for of, failed in rows if of == size]) for size in sizes]
        lines.append(f"| {fault.name} | {len(rows)} | {' | '.join(shares)} |")
    return lines


def _share(caught: list[bool]) -> str:
    return f"{100 * sum(caught) / len(caught):.0f} %" if caught else "–"


def known_fault_table(found: Sequence[dict[str, Any]]) -> list[str]:
    """How often each known mistake was caught, by what, and named."""
    lines = ["| mistake | rollouts | caught | named | failed checks, with how often |", "|---" * 5 + "|"]
    for fault in KNOWN:
        rows = [row for one in found for row in one["faults"] if row["fault"] == fault.name and "named" in row]
        checks = Counter(check for row in rows for check in row["failed"])
        told = ", ".join(f"{check} {count}" for check, count in checks.most_common())
        caught, named = sum(bool(row["failed"]) for row in rows), sum(row["named"] for row in rows)
        lines.append(f"| {fault.name} | {len(rows)} | {caught} | {named} | {told} |")
    return lines


def write_results(options: PoseCheckResults, found: list[dict[str, Any]]) -> None:
    """The tables and the JSON file."""
    options.out.mkdir(parents=True, exist_ok=True)
    about = {
        "command": shlex.join(["python", "scripts/pose_check_results.py", *sys.argv[1:]]),
        "commit": _commit(),
        "machine": f"{os.cpu_count()} CPU cores, {platform.system()} {platform.machine()}",
        "versions": installed_versions(_VERSIONED),
    }
    rows = ",\n".join(json.dumps(one, allow_nan=False) for one in found)
    text = f'{{"about": {json.dumps(about)},\n"rollouts": [\n{rows}\n]}}\n'
    (options.out / "results.json").write_text(text, encoding="utf-8")
    alarms = [one for one in found if one["failed"]]
    last = options.first + options.rollouts - 1
    lines = [
        "# Pose checks",
        "",
        f"Made by `{about['command']}` at commit {about['commit']} on {about['machine']}; versions and all figures: "
        "[results.json](results.json).",
        "",
        f"Rollouts {options.first} to {last}, each drawn from its number: room, policy ({', '.join(POLICIES)}), size "
        f"of the pictures, budget of {BUDGETS[0]} to {BUDGETS[-1]} views, {HELDOUT} held-out views.",
        "",
        f"## Correct rollouts: {len(alarms)} false alarms in {len(found)}",
        "",
        f"Goal: less than {100 * GOAL:g} %. {_rate(found)}. Rollouts below number {SEEN_BELOW} were looked at when the "
        f"limits were chosen; without them: {_rate([one for one in found if one['number'] >= SEEN_BELOW])}.",
        "",
        *group_table(found, "pictures", lambda one: one["size"]),
        "",
        *group_table(found, "room", lambda one: "builtin" if one["room"].startswith("builtin") else one["room"]),
        "",
        *group_table(found, "policy", lambda one: one["policy"]),
        "",
        *(f"- {one['room']}, {one['policy']}, seed {one['number']}, {one['size']}: {one['failed']}" for one in alarms),
        "",
        "## Small faults",
        "",
        "Share of the rollouts in which the checks that look at depth and pictures fail when one pose, or the focal "
        "length, is wrong by so much. The frame and the direction are drawn at random. The format check is left out: "
        "with a `steps.csv` it catches every pose that is off by more than its steps can be.",
        "",
        *small_fault_table(found),
        "",
        "## Known mistakes, with their names",
        "",
        "Poses, `transforms.json`, `rollout.json` and `steps.csv` all follow the fault.",
        "",
        *known_fault_table(found),
        "",
    ]
    (options.out / "README.md").write_text("\n".join(lines), encoding="utf-8")


def _rate(found: Sequence[dict[str, Any]]) -> str:
    alarms = sum(bool(one["failed"]) for one in found)
    bound = upper_bound(alarms, len(found))
    return (
        f"{alarms} of {len(found)} were refused ({100 * alarms / max(len(found), 1):.2f} %; with 95 % confidence at "
        f"most {100 * bound:.1f} %)"
    )


def _commit() -> str:
    words = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def main(options: PoseCheckResults) -> None:
    """Collect, damage, judge, write.

    Raises:
        AVPError: there were more false alarms than the goal allows; the results are written all the same.
    """
    options.work.mkdir(parents=True, exist_ok=True)
    found = measure_all(options)
    write_results(options, found)
    print(f"{options.out}: tables")
    alarms = [f"rollout {one['number']}" for one in found if one["failed"]]
    if len(alarms) > GOAL * len(found):
        raise AVPError(f"{len(alarms)} of {len(found)} correct rollouts were refused: {', '.join(alarms)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
