"""The folder that a check leaves: never inside the rollout, never over files of somebody else."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.rollout import Rollout
from avp_habitat.versions import installed_versions
from avp_nerfstudio.check.verdict import Verdict

FORMAT = "avp-check"
REPORT, PICTURE, CLOUD, RECORDING = "check.json", "overview.png", "cloud.ply", "check.rrd"
_VERSIONED = ("avp-suite", "numpy", "open3d", "pycolmap", "rerun-sdk", "matplotlib")


def choose_folder(rollout: Path, out: Path | None) -> Path:
    """Where the results go: `ROLLOUT-check` beside the rollout by default.

    Raises:
        UsageError: it lies inside the rollout, or holds files but no results of a check.
    """
    rollout = rollout.resolve()
    folder = rollout.with_name(f"{rollout.name}-check") if out is None else out
    if folder.resolve().is_relative_to(rollout):
        raise UsageError(f"--out {folder}: expected a folder outside the rollout, which stays as it is")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder}: expected a folder, found a file")
    if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder / REPORT):
        raise UsageError(f"--out {folder}: holds other files and no {REPORT} of a check; choose another name")
    return folder


def _is_ours(path: Path) -> bool:
    try:
        return json.loads(path.read_text(encoding="utf-8")).get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        return False


def write_outputs(
    folder: Path, rollout: Path, verdicts: list[Verdict], files: dict[str, Callable[[Path], None]]
) -> None:
    """Write the report and the files; each appears when it is whole and replaces that of an earlier check.

    Args:
        folder: from `choose_folder`.
        rollout: which was checked.
        verdicts: what was found.
        files: by name, what writes them; those of an earlier check that are not among them are removed.

    Raises:
        RolloutError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (PICTURE, CLOUD, RECORDING):
            if name in files:
                _publish(folder / name, files[name])
            else:
                (folder / name).unlink(missing_ok=True)
        _publish(folder / REPORT, lambda path: _write_report(path, rollout, verdicts))
    except OSError as error:
        raise RolloutError(f"--out {folder}: cannot write there: {error.strerror or error}") from None


def _publish(path: Path, write: Callable[[Path], None]) -> None:
    # The suffix stays the last part of the name: libraries choose the format by it.
    temporary = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_report(path: Path, rollout: Path, verdicts: list[Verdict]) -> None:
    report = {
        "format": FORMAT,
        "format_version": 1,
        "rollout": rollout.resolve().name,
        "passed": all(verdict.passed for verdict in verdicts),
        "verdicts": [as_json(verdict) for verdict in verdicts],
        "versions": installed_versions(_VERSIONED),
    }
    path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def as_json(verdict: Verdict) -> dict[str, Any]:
    """A verdict as JSON has it: figures that are not numbers become null."""
    values = asdict(verdict)
    values["figures"] = {name: value if math.isfinite(value) else None for name, value in verdict.figures.items()}
    return values


def outputs_of_geometry(rollout: Rollout, geometry: Any, verdicts: list[Verdict]) -> dict[str, Callable[[Path], None]]:
    """What writes the picture, the cloud and the recording of a `Geometry`."""
    from avp_nerfstudio.check.cloud import fuse, write_ply
    from avp_nerfstudio.check.figures import draw_overview
    from avp_nerfstudio.check.recording import write_recording

    cameras, bad = geometry.cameras, geometry.bad
    cloud = fuse(rollout, geometry.maps, cameras, bad)
    return {
        PICTURE: lambda path: draw_overview(path, cloud, cameras, bad, verdicts),
        CLOUD: lambda path: write_ply(path, cloud),
        RECORDING: lambda path: write_recording(path, rollout, cloud, cameras, bad),
    }
