"""Reconstruct what policies photograph from the same starts: equally many views, with depth and from colours alone.

A start's episodes are reconstructed from their first k frames each, k being the shortest one's. Rollouts and
reconstructions that the output folder holds already are not made again, so an interrupted call goes on.
"""

import json
import os
import platform
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from avp_habitat import command
from avp_habitat.collect import Collect, collect
from avp_habitat.command import progress
from avp_habitat.errors import UsageError
from avp_habitat.files import atomic_file, check_writable
from avp_habitat.metrics import FIGURES, mean_and_half_width
from avp_habitat.policies.registry import POLICIES_HELP, TRUSTED, check_policy
from avp_habitat.provenance import PACKAGES, git_commit, installed_versions
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import read_rollout
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.tables import table
from avp_nerfstudio.reconstruct import Reconstruct, reconstruct

SHOWN = ("visibility", "visibility_parallax", "psnr", "ssim", "lpips")
LEGEND = (
    "Mean ± 95 % interval over the starts; depth: whether avp-nerfacto learned from depth images too (else only the "
    "scene box is made from them)."
)


@dataclass(frozen=True)
class PolicyReconstructions:
    """Reconstruct what policies photograph, from equally many views; makes what the folder lacks."""

    scene: Annotated[tuple[str, ...], arg(help=SCENES)]
    policy: Annotated[tuple[str, ...], arg(help=POLICIES_HELP)]
    starts: Annotated[int, Range(1, 10_000)] = 3
    """Episodes of each policy in each scene, all policies from the same starts."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 1000
    """Of the first start; episode i uses SEED + i."""
    depth: tuple[bool, ...] = (False, True)
    """Reconstruct from colours alone (False), with depth (True), or both."""
    iterations: Annotated[int, Range(1, 1_000_000)] = 1000
    """Of each reconstruction."""
    width: Annotated[int, Range(40, 8192)] = 192
    """Of the pictures in pixels; their height is three quarters of it."""
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scenes."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False
    folder: Path = Path("runs/policy_reconstructions")
    """Where rollouts and reconstructions are kept."""
    out: Path = Path("runs/policy_reconstructions.json")
    """All scores; the table stands beside it as Markdown."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right."""
        hold_ranges(self)
        if not (self.scene and self.policy and self.depth):
            raise UsageError("scene, policy and depth: expected at least one of each")
        for kind, names in (("scene", self.scene), ("policy", self.policy)):
            if len({short(name) for name in names}) < len(names):
                raise UsageError(
                    f"{kind}: expected names that differ without folder and ending, got {', '.join(names)}"
                )


def short(name: str) -> str:
    """A scene or policy in names of folders."""
    return Path(name).stem.replace(":", "_")


def rollout_of(options: PolicyReconstructions, scene: str, policy: str, number: int) -> Path:
    """The rollout of one episode, collected if it is not there."""
    seed = options.seed + number
    out = options.folder / f"{short(scene)}-{short(policy)}-{seed}-{options.width}"
    if not out.exists():
        collect(
            Collect(
                scene,
                policy,
                out,
                simulator=options.simulator,
                seed=seed,
                width=options.width,
                height=options.width * 3 // 4,
                trusted=options.trusted,
                mlflow="off",
            )
        )
    return out


def scores_of(options: PolicyReconstructions, rollout: Path, frames: int, depth: bool) -> dict[str, Any]:
    """What `scores.json` of one reconstruction holds, which is made if it is not there."""
    out = rollout.with_name(f"{rollout.name}-{frames}-{'depth' if depth else 'colours'}-{options.iterations}")
    if not out.exists():
        reconstruct(Reconstruct(rollout, out, depth=depth, frames=frames, iterations=options.iterations))
    return json.loads((out / "scores.json").read_text(encoding="utf-8"))


def reconstructions(options: PolicyReconstructions) -> Iterator[dict[str, Any]]:
    """Every reconstruction's entry of the file, start by start."""
    for scene in options.scene:
        for number in range(options.starts):
            rollouts = {policy: rollout_of(options, scene, policy, number) for policy in options.policy}
            views = {policy: len(read_rollout(folder).frames) for policy, folder in rollouts.items()}
            for policy, folder in rollouts.items():
                for depth in options.depth:
                    found = scores_of(options, folder, min(views.values()), depth)
                    about = {"scene": Path(scene).name, "policy": Path(policy).name, "start": number, "depth": depth}
                    scores = {name: value for name, value in found["visibility"].items() if name in SHOWN}
                    yield about | {"episode": views[policy], "views": found["frames"]} | scores | found["scores"]


def rows_of(entries: list[dict[str, Any]]) -> str:
    """A line for each scene, depth and policy as Markdown."""
    shown = [name for name in SHOWN if all(name in entry for entry in entries)]
    rows = []
    for scene, depth, policy in dict.fromkeys((each["scene"], each["depth"], each["policy"]) for each in entries):
        chosen = [one for one in entries if (one["scene"], one["depth"], one["policy"]) == (scene, depth, policy)]
        cells = [scene, policy, "yes" if depth else "no", f"{np.mean([one['views'] for one in chosen]):.1f}"]
        for name in shown:
            mean, half = mean_and_half_width(np.array([[one[name]] for one in chosen]))
            cells.append(FIGURES[name].text(float(mean[0]), float(half[0])))
        rows.append(cells)
    head = ["scene", "policy", "depth", "views", *(FIGURES[name].heading for name in shown)]
    return table(head, sorted(rows, key=lambda row: (row[0], row[2])), words=3)


def main(options: PolicyReconstructions) -> None:
    """Make what is missing; what is done is kept after Ctrl-C."""
    for policy in options.policy:
        check_policy(policy)
    check_writable(options.out)
    options.folder.mkdir(parents=True, exist_ok=True)
    total = len(options.scene) * options.starts * len(options.policy) * len(options.depth)
    entries = list(progress(reconstructions(options), total=total, desc="reconstructing", unit="reconstruction"))
    line = shlex.join(["python", "scripts/policy_reconstructions.py", *sys.argv[1:]])
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    about = {"command": line, "commit": git_commit(), "machine": machine, "versions": installed_versions(PACKAGES)}
    with atomic_file(options.out) as path:
        path.write_text(json.dumps({**about, "reconstructions": entries}, indent=1) + "\n", encoding="utf-8")
    settings = f"{options.width}x{options.width * 3 // 4} pixels, {options.iterations} iterations, seed {options.seed}"
    made = f"`{line}` (commit {about['commit']}, {machine}; {settings})"
    page = ["# Reconstructions of policies at equal views", made, rows_of(entries), LEGEND]
    with atomic_file(options.out.with_suffix(".md")) as path:
        path.write_text("\n\n".join(page) + "\n", encoding="utf-8")
    print(rows_of(entries))
    print(f"{LEGEND}\n{options.out}: {len(entries)} reconstructions")


if __name__ == "__main__":
    sys.exit(command.run(main))
