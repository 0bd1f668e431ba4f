"""The program that Rerun calls for every path it opens: it answers with the recording of a rollout, or declines.

`rerun ROLLOUT` calls `rerun-importer-avp ROLLOUT --application-id … --recording-id …` and reads the recording from the
standard output. To decline is exit code 66, decided before anything large is imported (hence argparse).
"""

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from avp_sb3.rerun import APPLICATION

INCOMPATIBLE = 66
"""Rerun's exit code of an importer that does not know a path."""
_NAME, _DEPRECATED_PREFIX = "rerun-importer-avp", "rerun-loader-"
_META, _MARK, _HEAD_BYTES = "rollout.json", b"avp-rollout", 65_536


def main() -> int:
    """0: the recording was written to the standard output, or the same viewer's call for the folder writes it.

    66: the path is no rollout, 1: it is a damaged one, 2: a usage error.
    """
    options = _parse(sys.argv[1:])
    asked_as = os.path.basename(sys.argv[0])
    if asked_as.startswith(_DEPRECATED_PREFIX) and options.recording_id and shutil.which(_NAME):
        return INCOMPATIBLE  # The viewer asks under the new name, too.
    folders = rollouts_at(options.path)
    if options.recording_id and _is_shown_with_its_folder(options.path, options.application_id):
        return 0
    if not folders:
        return INCOMPATIBLE
    from avp_habitat.command import run

    return run(lambda _: _answer(folders, options), [])


def rollouts_at(path: Path) -> list[Path]:
    """The rollouts that a path stands for: itself, the one whose `rollout.json` it is, or those directly in it."""
    if path.is_dir():
        if _is_rollout(path):
            return [path]
        return sorted(folder for folder in path.iterdir() if not folder.name.startswith(".") and _is_rollout(folder))
    return [path.parent] if path.name == _META and _is_rollout(path.parent) else []


def _is_rollout(folder: Path) -> bool:
    """Whether a folder is one of ours, be it damaged: by one of the first lines of its `rollout.json`."""
    try:
        if not (folder / _META).is_file():
            return False
        with (folder / _META).open("rb") as file:
            return _MARK in file.read(_HEAD_BYTES)
    except OSError:
        return False


def _is_shown_with_its_folder(path: Path, application_id: str | None) -> bool:
    """Whether a file of a rollout is asked about only because its folder is being opened.

    A viewer that opens a folder asks about it, then about each file in it, with the folder's name as application id
    (none for the folder `.`); a file that is opened by itself carries its own name.
    """
    folder = path.absolute().parent
    if not path.is_file() or not _is_rollout(folder) or application_id == _application_id(path):
        return False
    return application_id in (None, _application_id(folder), _application_id(folder.parent))


def _application_id(path: Path) -> str:
    """As a viewer makes it of a path."""
    return path.stem.replace(".", "_")


def _answer(folders: Sequence[Path], options: argparse.Namespace) -> None:
    """Write the recording of rollouts to the standard output."""
    import rerun as rr

    from avp_habitat.rollout.format import read_rollout
    from avp_sb3.rerun.rollout import log_rollouts

    prefix, identity = options.entity_path_prefix, options.recording_id
    is_alone = not prefix.strip("/") and (identity is None or identity != options.opened_recording_id)
    application = options.application_id or APPLICATION
    recording = rr.RecordingStream(application, recording_id=identity, send_properties=is_alone)
    rollouts = [read_rollout(folder) for folder in folders]
    log_rollouts(recording, rollouts, prefix=prefix, with_layout=is_alone)
    sys.stdout.buffer.write(recording.binary_stream().read() or b"")
    sys.stdout.buffer.flush()


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments; other flags are tolerated: a program's own time lines, and what later viewers may add."""
    parser = argparse.ArgumentParser(
        prog=_NAME,
        allow_abbrev=False,
        description="Called by Rerun for the paths that it opens: try `rerun ROLLOUT`. Writes the recording to the "
        f"standard output; exit code {INCOMPATIBLE} for what is no rollout.",
    )
    parser.add_argument("path", type=Path, help="rollout folder, its rollout.json, or a folder of rollouts")
    parser.add_argument("--application-id", help="application of the recording")
    parser.add_argument("--recording-id", help="recording to add to")
    parser.add_argument("--opened-recording-id", help="recording on show")
    parser.add_argument("--entity-path-prefix", default="", help="entity path above all that is added")
    return parser.parse_known_args(argv)[0]
