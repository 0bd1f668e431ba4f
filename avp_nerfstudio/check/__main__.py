"""`python -m avp_nerfstudio.check`: whether the poses and depth of a rollout are right, and what is wrong if not."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.files import check_new
from avp_habitat.rollout.format import Rollout
from avp_habitat.scenes.loader import Scene, load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.scenes.location import UPS, locate
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.data.refusals import check_is_rollout


class CheckFailedError(AVPError):
    """A rollout that does not pass."""


@dataclass(frozen=True)
class Check:
    """Check that poses, intrinsics and depth of a rollout belong together, and name the likely mistake.

    Exit code 0: all checks passed; 1: one failed; 2: wrong options.
    """

    rollout: Positional[Path]
    """The folder made by `python -m avp_habitat.collect`."""
    mesh: Annotated[str | None, arg(help=f"also measure the distance to this scene: {SCENES}")] = None
    up: Annotated[
        str | None, arg(help="axis of the mesh file that points up, y or z (omitted: as the rollout says)")
    ] = None
    export_colmap: Path | None = None
    """Also write the rollout as a COLMAP model, into this new folder."""
    out: Path | None = None
    """Where the results go (omitted: ROLLOUT-check, beside the rollout)."""
    no_pictures: bool = False
    """Leave out what is found in the pictures (pycolmap), which is slow."""

    def __post_init__(self) -> None:
        """Find the folder, and refuse what cannot be checked."""
        folder = self.rollout.parent if self.rollout.name == "rollout.json" else self.rollout
        object.__setattr__(self, "rollout", folder)
        if self.up not in (None, *UPS):
            raise UsageError(f"up: expected {' or '.join(UPS)}, got {self.up!r}")
        if not folder.is_dir():
            raise UsageError(
                f"{folder}: expected a rollout folder (made by `python -m avp_habitat.collect`), found none"
            )
        check_is_rollout(folder)
        if self.export_colmap is not None:
            check_new(self.export_colmap, option="--export-colmap")


def check(options: Check) -> tuple[list[Verdict], Path]:
    """Run all checks and write their results; the verdicts, and the folder of the results.

    Raises:
        UsageError: the mesh is no scene file, or the results' folder is not one of a check.
        AVPError: the scene cannot be read, or the results cannot be written.
    """
    from avp_nerfstudio.check.geometry import check_geometry
    from avp_nerfstudio.check.outputs import choose_folder, outputs_of, write_outputs
    from avp_nerfstudio.check.shape import check_format

    out = choose_folder(options.rollout, options.out)
    if options.mesh is not None:
        locate(options.mesh, up=options.up)
    rollout, verdict = check_format(options.rollout)
    if rollout is None or not rollout.frames:
        write_outputs(out, options.rollout, [verdict], {})
        return [verdict], out
    scene = None if options.mesh is None else _scene_of(rollout, options.mesh, options.up)
    with progress(total=len(rollout.frames) + len(rollout.heldout), unit="view", desc="comparing depth") as bar:
        geometry = check_geometry(rollout, scene, progress=bar.update)
    if not verdict.passed and geometry.diagnosis is not None:
        verdict = replace(verdict, cause=geometry.diagnosis.cause)
    verdicts = [verdict, *geometry.verdicts, *_pictures(rollout, options, geometry.proved)]
    write_outputs(out, options.rollout, verdicts, outputs_of(rollout, geometry, verdicts))
    return verdicts, out


def _scene_of(rollout: Rollout, mesh: str, up: str | None) -> Scene:
    """The mesh, placed in the world as the rollout says that its scene was."""
    told = rollout.meta.get("scene")
    told = told if isinstance(told, dict) else {}
    own = told.get("up") if told.get("up") in UPS and not mesh.endswith(".json") else None
    return load_scene(mesh, up=up or own, origin=told.get("origin"))


def _pictures(rollout: Rollout, options: Check, proved: Any) -> list[Verdict]:
    """The verdicts of the pictures; the matches that they need serve the COLMAP model too.

    `proved` is an `(n,)` mask of the frames, perhaps with more after them, whose poses the depth proves right.
    """
    if options.no_pictures and options.export_colmap is None:
        return []
    from avp_nerfstudio.check.colmap import export_colmap
    from avp_nerfstudio.check.pictures.evidence import check_pictures
    from avp_nerfstudio.check.pictures.matching import match_pictures

    matches = match_pictures(rollout)
    verdicts = [] if options.no_pictures else check_pictures(rollout, matches=matches, proved=proved)
    if options.export_colmap is not None:
        export_colmap(rollout, options.export_colmap, matches=matches)
        print(f"COLMAP model: {options.export_colmap}")
    return verdicts


def describe(verdict: Verdict) -> str:
    """A verdict as some lines of text."""
    lines = [f"{'PASS' if verdict.passed else 'FAIL'}  {verdict.name}: {verdict.text}"]
    if verdict.figures:
        lines.append("      " + ", ".join(f"{name} {value:.4g}" for name, value in verdict.figures.items()))
    if not verdict.passed:
        lines.append(f"      likely cause: {verdict.cause or 'not known'}")
    return "\n".join(lines)


def main(options: Check) -> None:
    """Check one rollout, print what was found and where the results are."""
    verdicts, out = check(options)
    print("\n".join(map(describe, verdicts)))
    print(f"results: {out}")
    failed = [verdict.name for verdict in verdicts if not verdict.passed]
    if failed:
        raise CheckFailedError(
            f"{options.rollout}: {len(failed)} of {len(verdicts)} checks failed: {', '.join(failed)}"
        )


if __name__ == "__main__":
    sys.exit(command.run(main))
