"""Check correct rollouts and deliberate faults at full size, and write how each check judged them.

Rollouts that were collected already are not collected again.
"""

import argparse
import json
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.versions import installed_versions
from avp_nerfstudio.check.__main__ import Request, check
from avp_nerfstudio.check.faults import FAULTS, MORE_FAULTS, Fault, write_faulty
from avp_nerfstudio.check.outputs import as_json, choose_folder
from avp_nerfstudio.check.verdict import Verdict

ROOT = Path(__file__).resolve().parent.parent
POLICIES = ("heuristic", "random", "frontier", "greedy", "oracle")
"""One per seed, so that five seeds are five ways to walk."""
_VERSIONED = ("avp-suite", "numpy", "open3d", "pycolmap", "pillow", "nerfstudio")


@dataclass(frozen=True)
class Case:
    """A rollout to check."""

    name: str
    """In the table."""
    folder: Path
    """The rollout."""
    scene: str
    """Its mesh."""
    fault: Fault | None
    """None for a correct one."""


@dataclass(frozen=True)
class Outcome:
    """What the checks said of a case."""

    case: Case
    """Which."""
    verdicts: list[Verdict]
    """Of all checks."""
    seconds: float
    """For all checks and their files, on the clock."""
    cpu_seconds: float
    """The same in processor time."""

    @property
    def cause(self) -> str:
        """The cause that is named first: that of the depth, or of the format where nothing else could be read."""
        causes = {verdict.name: verdict.cause for verdict in self.verdicts if verdict.cause}
        return next((causes[name] for name in ("depth agreement", "format") if name in causes), "")

    @property
    def right(self) -> bool:
        """Whether a correct rollout passed, or a fault was caught and named."""
        passed = all(verdict.passed for verdict in self.verdicts)
        if self.case.fault is None:
            return passed
        return not passed and re.search(self.case.fault.named, self.cause) is not None


def collect(scene: str, policy: str, seed: int, out: Path, log: Path) -> None:
    """Collect a rollout, once.

    Raises:
        AVPError: it failed.
    """
    if out.exists():
        return
    words = ["-m", "avp_habitat.collect", "--scene", scene, "--policy", policy, "--seed", str(seed), "--out", str(out)]
    with log.open("a", encoding="utf-8") as file:
        code = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=file, stderr=file, check=False).returncode
    if code:
        raise AVPError(f"python {shlex.join(words)}: exit code {code}; see {log}")


def judge(case: Case, *, pictures: bool) -> Outcome:
    """Run all checks on a case."""
    began, cpu = time.perf_counter(), time.process_time()
    verdicts = check(Request(case.folder, choose_folder(case.folder, None), case.scene, None, pictures))
    return Outcome(case, verdicts, time.perf_counter() - began, time.process_time() - cpu)


def correct_cases(options: argparse.Namespace) -> list[Case]:
    """Five seeds in each room, each with a policy of its own."""
    cases = []
    for scene in options.scene:
        for seed in range(options.seeds):
            policy = POLICIES[seed % len(POLICIES)]
            room = Path(scene).stem.replace(":", "_")
            folder = options.work / f"{room}-{policy}-{seed}"
            collect(scene, policy, seed, folder, options.work / "collect.log")
            cases.append(Case(f"{room}, {policy}, seed {seed}", folder, scene, None))
    return cases


def faulty_cases(options: argparse.Namespace, correct: Sequence[Case]) -> list[Case]:
    """Every fault, each on another of the correct rollouts."""
    cases = []
    for number, fault in enumerate((*FAULTS, *MORE_FAULTS)):
        source = correct[number % len(correct)]
        folder = options.work / f"fault-{number}"
        shutil.rmtree(folder, ignore_errors=True)
        write_faulty(source.folder, folder, fault, seed=number)
        cases.append(Case(f"{fault.name} ({source.name})", folder, source.scene, fault))
    return cases


def table(outcomes: Sequence[Outcome], columns: dict[str, tuple[str, str, str]]) -> list[str]:
    """A Markdown table of figures; columns by title: the verdict, the figure, its format."""
    lines = [f"| rollout | {' | '.join(columns)} | passed |", "|---" * (len(columns) + 2) + "|"]
    for outcome in outcomes:
        by_name = {verdict.name: verdict for verdict in outcome.verdicts}
        cells = []
        for verdict, figure, form in columns.values():
            value = by_name[verdict].figures.get(figure) if verdict in by_name else None
            cells.append("–" if value is None else format(value, form))
        lines.append(f"| {outcome.case.name} | {' | '.join(cells)} | {_yes(_passed(outcome))} |")
    return lines


def fault_table(outcomes: Sequence[Outcome]) -> list[str]:
    """A Markdown table: by which checks each fault was caught, and what was named."""
    lines = ["| fault | failed checks | cause named | right |", "|---|---|---|---|"]
    for outcome in outcomes:
        failed = ", ".join(verdict.name for verdict in outcome.verdicts if not verdict.passed) or "none"
        lines.append(f"| {outcome.case.name} | {failed} | {outcome.cause or 'none'} | {_yes(outcome.right)} |")
    return lines


def _passed(outcome: Outcome) -> bool:
    return all(verdict.passed for verdict in outcome.verdicts)


def _yes(value: bool) -> str:
    return "yes" if value else "**no**"


COLUMNS = {
    "agreeing within 2 cm [%]": ("depth agreement", "agreeing_2cm_percent", ".3f"),
    "worst frame [%]": ("depth agreement", "worst_frame_percent", ".2f"),
    "mean difference [mm]": ("depth agreement", "mean_difference_mm", ".2f"),
    "largest ICP shift [mm]": ("ICP correction", "largest_shift_mm", ".2f"),
    "to the mesh, 95 % within [mm]": ("mesh distance", "p95_mm", ".2f"),
    "reprojection [px]": ("reprojection", "mean_reprojection_px", ".3f"),
    "rotation of pairs, median [deg]": ("relative poses", "rotation_median_deg", ".3f"),
}


def write_results(out: Path, correct: Sequence[Outcome], faulty: Sequence[Outcome], argv: Sequence[str]) -> None:
    """The tables and the JSON file."""
    out.mkdir(parents=True, exist_ok=True)
    about = {
        "command": shlex.join(["python", "scripts/pose_check_results.py", *argv]),
        "commit": _commit(),
        "machine": f"{os.cpu_count()} CPU cores, {platform.system()} {platform.machine()}",
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "versions": installed_versions(_VERSIONED),
    }
    cases = [
        {
            "rollout": outcome.case.name,
            "fault": outcome.case.fault.name if outcome.case.fault else None,
            "right": outcome.right,
            "seconds": round(outcome.seconds, 1),
            "cpu_seconds": round(outcome.cpu_seconds, 1),
            "verdicts": [as_json(verdict) for verdict in outcome.verdicts],
        }
        for outcome in (*correct, *faulty)
    ]
    text = json.dumps(_portable({"about": about, "cases": cases}, correct, faulty), indent=1, allow_nan=False)
    (out / "results.json").write_text(text + "\n", encoding="utf-8")
    seconds = [outcome.seconds for outcome in correct]
    lines = [
        "# Pose checks",
        "",
        f"Made by `{about['command']}` at commit {about['commit']} on {about['machine']}; versions and all figures: "
        "[results.json](results.json).",
        "",
        f"## Correct rollouts: {sum(o.right for o in correct)} of {len(correct)} pass",
        "",
        *table(correct, COLUMNS),
        "",
        f"All checks of a rollout took {min(seconds):.0f} to {max(seconds):.0f} s, processor time "
        f"{max(outcome.cpu_seconds for outcome in correct):.0f} s at most; peak memory {about['peak_memory_mib']} MiB.",
        "",
        f"## Deliberate faults: {sum(o.right for o in faulty)} of {len(faulty)} are caught and named",
        "",
        f"The first {len(FAULTS)} are those of the self-test. Poses, `transforms.json`, `rollout.json` and `steps.csv` "
        "all follow the fault. In brackets: the correct rollout that was damaged.",
        "",
        *fault_table(faulty),
        "",
    ]
    (out / "README.md").write_text("\n".join(lines), encoding="utf-8")


def _portable(value: Any, *groups: Sequence[Outcome]) -> Any:
    """The same without the places where the rollouts lay on this machine."""
    text = json.dumps(value)
    for group in groups:
        for outcome in group:
            text = text.replace(json.dumps(str(outcome.case.folder))[1:-1] + "/", "")
    return json.loads(text)


def _commit() -> str:
    words = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    rooms = ["../shared/scenes/white_room.glb", "../shared/scenes/grey_white_room.glb"]
    add("--scene", nargs="+", default=rooms, help="the rooms")
    add("--seeds", default=5, type=int, help="correct rollouts per room")
    add("--work", default=Path("runs/pose-checks"), type=Path, help="rollouts and what the checks leave")
    add("--out", default=Path("docs/results/pose_checks"), type=Path, help="tables")
    add("--no-pictures", action="store_true", help="leave out the checks of the pictures (pycolmap)")
    return parser


def main(argv: Sequence[str]) -> None:
    """Collect, damage, check, write.

    Raises:
        AVPError: a correct rollout failed or a fault was missed; the results are written all the same.
    """
    options = _parser().parse_args(argv)
    for scene in options.scene:
        if not scene.startswith("builtin:") and not Path(scene).is_file():
            raise UsageError(f"{scene}: no such file")
    options.work.mkdir(parents=True, exist_ok=True)
    correct = correct_cases(options)
    faulty = faulty_cases(options, correct)
    outcomes = [
        judge(case, pictures=not options.no_pictures)
        for case in tqdm([*correct, *faulty], desc="checking", unit="rollout", disable=None)
    ]
    write_results(options.out, outcomes[: len(correct)], outcomes[len(correct) :], argv)
    print(f"{options.out}: tables")
    wrong = [outcome.case.name for outcome in outcomes if not outcome.right]
    if wrong:
        raise AVPError(f"{len(wrong)} of {len(outcomes)} rollouts were judged wrongly: {'; '.join(wrong)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
