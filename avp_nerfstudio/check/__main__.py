"""`python -m avp_nerfstudio.check`: whether the poses and depth of a rollout are right, and what is wrong if not."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.rollout.format import Rollout
from avp_habitat.scenes.loader import Scene, load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.scenes.location import UPS, locate
from avp_habitat.simulators.registry import add_up_option
from avp_nerfstudio.check.outputs import choose_folder, outputs_of_geometry, write_outputs
from avp_nerfstudio.check.shape import check_format
from avp_nerfstudio.check.verdict import Verdict
from avp_nerfstudio.data.refusals import check_is_rollout


class CheckFailedError(AVPError):
    """A rollout that does not pass."""


class MissingPackageError(AVPError):
    """A package without which a check cannot run."""


@dataclass(frozen=True)
class Request:
    """What to check."""

    rollout: Path
    """The folder."""
    out: Path
    """Where the results go."""
    mesh: str | None = None
    """The scene, as `avp_habitat.scenes.location.locate` takes it."""
    export_colmap: Path | None = None
    """Where to write a COLMAP model."""
    pictures: bool = True
    """Whether to hold the poses against the pictures too."""
    up: str | None = None
    """Axis of the mesh file that points up; as the rollout says when None."""


def check(request: Request) -> list[Verdict]:
    """Run all checks and write their results.

    Raises:
        UsageError: the mesh is not a scene file.
        AVPError: the scene cannot be read, the results cannot be written, or a package is missing.
    """
    if request.mesh is not None:
        locate(request.mesh, up=request.up)
    rollout, verdict = check_format(request.rollout)
    if rollout is None or not rollout.frames:
        write_outputs(request.out, request.rollout, [verdict], {})
        return [verdict]
    scene = None if request.mesh is None else _scene_of(rollout, request.mesh, request.up)
    from avp_nerfstudio.check.geometry import check_geometry

    geometry = _with_bar(check_geometry, rollout, scene)
    if not verdict.passed and geometry.diagnosis is not None:
        verdict = replace(verdict, cause=geometry.diagnosis.cause)
    verdicts = [verdict, *geometry.verdicts, *_pictures(rollout, request, geometry.proved)]
    write_outputs(request.out, request.rollout, verdicts, outputs_of_geometry(rollout, geometry, verdicts))
    return verdicts


def _scene_of(rollout: Rollout, mesh: str, up: str | None) -> Scene:
    """The mesh, placed in the world as the rollout says that its scene was."""
    told = rollout.meta.get("scene")
    told = told if isinstance(told, dict) else {}
    own = told.get("up") if told.get("up") in UPS and not mesh.endswith(".json") else None
    return load_scene(mesh, up=up or own, origin=told.get("origin"))


def _with_bar(check_geometry: Any, rollout: Rollout, scene: Scene | None) -> Any:
    total = len(rollout.frames) + len(rollout.heldout)
    with progress(total=total, unit="view", desc="comparing depth") as bar:
        return check_geometry(rollout, scene, progress=bar.update)


def _pictures(rollout: Rollout, request: Request, proved: Any) -> list[Verdict]:
    """The verdicts of the pictures; the matches that they need serve the COLMAP model too.

    `proved` is an `(n,)` mask of the frames, perhaps with more after them, whose poses the depth proves right.
    """
    if not request.pictures and request.export_colmap is None:
        return []
    try:
        from avp_nerfstudio.check.colmap import export_colmap
        from avp_nerfstudio.check.pictures.evidence import check_pictures
        from avp_nerfstudio.check.pictures.matching import match_pictures
    except ImportError as error:
        raise MissingPackageError(
            f"checking the pictures needs {error.name}: pip install {error.name}, or leave it out with --no-pictures"
        ) from None
    matches = match_pictures(rollout)
    verdicts = check_pictures(rollout, matches=matches, proved=proved) if request.pictures else []
    if request.export_colmap is not None:
        print(f"COLMAP model: {export_colmap(rollout, request.export_colmap, matches=matches)}")
    return verdicts


def describe(verdict: Verdict) -> str:
    """A verdict as some lines of text."""
    lines = [f"{'PASS' if verdict.passed else 'FAIL'}  {verdict.name}: {verdict.text}"]
    if verdict.figures:
        lines.append("      " + ", ".join(f"{name} {value:.4g}" for name, value in verdict.figures.items()))
    if not verdict.passed:
        lines.append(f"      likely cause: {verdict.cause or 'not known'}")
    return "\n".join(lines)


def _request(argv: Sequence[str]) -> Request:
    parser = argparse.ArgumentParser(
        prog="python -m avp_nerfstudio.check",
        description="Check that poses, intrinsics and depth of a rollout belong together, and name the likely mistake. "
        "Exit code 0: all checks passed; 1: one failed; 2: wrong options.",
    )
    add = parser.add_argument
    add("rollout", type=Path, metavar="ROLLOUT", help="the folder made by `python -m avp_habitat.collect`")
    add("--mesh", metavar="SCENE", help=f"also measure the distance to this scene: {SCENES}")
    add_up_option(parser)
    add("--export-colmap", type=Path, metavar="DIR", help="also write the rollout as a COLMAP model; must not exist")
    add("--out", type=Path, metavar="DIR", help="where the results go (default: ROLLOUT-check, beside the rollout)")
    add("--no-pictures", action="store_true", help="leave out what is found in the pictures (pycolmap), which is slow")
    options = parser.parse_args(argv)
    folder = options.rollout.parent if options.rollout.name == "rollout.json" else options.rollout
    if not folder.is_dir():
        raise UsageError(f"{folder}: expected a rollout folder (made by `python -m avp_habitat.collect`), found none")
    check_is_rollout(folder)
    if options.export_colmap is not None and options.export_colmap.exists():
        raise UsageError(f"--export-colmap {options.export_colmap}: exists already, expected a new folder")
    return Request(
        folder,
        choose_folder(folder, options.out),
        options.mesh,
        options.export_colmap,
        not options.no_pictures,
        options.up,
    )


def main(argv: Sequence[str]) -> None:
    """Check one rollout, print what was found and where the results are."""
    request = _request(argv)
    verdicts = check(request)
    print("\n".join(describe(verdict) for verdict in verdicts))
    print(f"results: {request.out}")
    failed = [verdict.name for verdict in verdicts if not verdict.passed]
    if failed:
        raise CheckFailedError(
            f"{request.rollout}: {len(failed)} of {len(verdicts)} checks failed: {', '.join(failed)}"
        )


if __name__ == "__main__":
    sys.exit(command.run(main))
