"""The program that Rerun calls for every path it opens: it answers with the recording of a rollout, or declines.

`rerun ROLLOUT` calls `rerun-importer-avp ROLLOUT --application-id … --recording-id …` and reads the recording from the
standard output. To decline is exit code 66, decided before anything large is imported.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from avp_habitat.command import run
from avp_habitat.errors import UsageError
from avp_habitat.rollout.format import read_rollout
from avp_sb3.rerun.destination import Destination, Time, is_shown_with_its_folder, rollouts_at
from avp_sb3.rerun.layout import APPLICATION
from avp_sb3.rerun.recording import recording_bytes

# Rerun gives every recording these by itself.
_AUTOMATIC = ("log_time", "log_tick")


def answer(folders: Sequence[str], options: argparse.Namespace) -> int:
    """Write the recording of rollouts to the standard output.

    Args:
        folders: of the rollouts.
        options: as parsed by the importer.

    Returns:
        Exit code: 0, or 1 with one line on stderr when a rollout is damaged.
    """

    def write(_: Sequence[str]) -> None:
        destination = destination_of(options)
        written = recording_bytes([read_rollout(folder) for folder in folders], destination)
        sys.stdout.buffer.write(written)
        sys.stdout.buffer.flush()

    return run(write, [])


def destination_of(options: argparse.Namespace) -> Destination:
    """What the caller wants the rollouts to be part of.

    Raises:
        UsageError: a time is not a name and a whole number, or a name holds bytes that are no text.
    """
    for option in ("application_id", "recording_id", "entity_path_prefix"):
        if _is_no_text(getattr(options, option)):
            raise UsageError(f"--{option.replace('_', '-')}: expected a text, got {getattr(options, option)!r}")
    joins = options.recording_id is not None and options.recording_id == options.opened_recording_id
    return Destination(
        application_id=options.application_id or APPLICATION,
        recording_id=options.recording_id,
        prefix=options.entity_path_prefix,
        times=_times(options),
        own=not joins and not options.entity_path_prefix.strip("/"),
    )


def _is_no_text(value: str | None) -> bool:
    """Whether the command line held other bytes than UTF-8, which Python keeps as surrogates and Rerun refuses."""
    return any("\ud800" <= letter <= "\udfff" for letter in value or "")


def _times(options: argparse.Namespace) -> dict[str, Time]:
    older = dict(_pairs("--sequence", options.sequence))
    times: dict[str, Time] = dict(_pairs("--time_sequence", options.time_sequence))
    for name, value in _pairs("--time_duration_nanos", options.time_duration_nanos):
        # Rerun 0.41 sends moments as durations; only the older flag beside them tells.
        times[name] = np.datetime64(value, "ns") if name in older else np.timedelta64(value, "ns")
    for name, value in _pairs("--time_timestamp_nanos", options.time_timestamp_nanos):
        times[name] = np.datetime64(value, "ns")
    return times


def _pairs(option: str, texts: Sequence[str]) -> Iterator[tuple[str, int]]:
    for text in texts:
        name, _, value = text.rpartition("=")
        try:
            number = int(value)
        except ValueError:
            number = None
        if not name or number is None or abs(number) >= 2**63:
            raise UsageError(f"{option}: expected NAME=NUMBER with a whole number, got {text!r}")
        if name not in _AUTOMATIC:
            yield name, number


INCOMPATIBLE = 66
"""Rerun's exit code of an importer that does not know a path."""
_USAGE = 2
_NAME, _DEPRECATED_PREFIX = "rerun-importer-avp", "rerun-loader-"


def main() -> int:
    """Run the program with the process's arguments.

    Returns:
        0 when the recording was written to the standard output (or is written by the same viewer's call for the
        folder), 66 when the path is no rollout, 1 when it is a damaged one, 2 for a usage error.
    """
    options = _parse(sys.argv[1:])
    if _other_name_answers(options):
        return INCOMPATIBLE
    folders = rollouts_at(options.path)
    if options.recording_id and is_shown_with_its_folder(options.path, options.application_id):
        return 0
    if not folders:
        return INCOMPATIBLE
    if sys.stdout.isatty():
        print(f"error: expected the output to go to a viewer or a file: try `rerun {options.path}`", file=sys.stderr)
        return _USAGE
    pass

    return answer(folders, options)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """The arguments; flags that later viewers may add are tolerated."""
    parser = argparse.ArgumentParser(
        prog=_NAME,
        allow_abbrev=False,
        description="Called by Rerun for the paths that it opens: try `rerun ROLLOUT`. Writes the recording of a "
        f"rollout folder, of its rollout.json or of a folder of rollouts to the standard output; exit code "
        f"{INCOMPATIBLE} for everything else.",
    )
    parser.add_argument("path", help="rollout folder, its rollout.json, or a folder of rollouts")
    parser.add_argument("--application-id", help="application of the recording")
    parser.add_argument("--recording-id", help="recording to add to")
    parser.add_argument("--opened-application-id", help="application of the recording on show")
    parser.add_argument("--opened-recording-id", help="recording on show")
    parser.add_argument("--entity-path-prefix", default="", help="entity path above all that is added")
    pair = {"action": "append", "default": [], "metavar": "NAME=NUMBER"}
    parser.add_argument("--time_sequence", help="further time line with the value that it has throughout", **pair)
    parser.add_argument("--time_duration_nanos", help="likewise, a duration in nanoseconds", **pair)
    parser.add_argument("--time_timestamp_nanos", help="likewise, nanoseconds since 1970", **pair)
    parser.add_argument("--sequence", help="older name, sent along with the others", **pair)
    parser.add_argument("--time", help="older name, sent along with the others", **pair)
    for name in ("--static", "--timeless"):
        parser.add_argument(name, action="store_true", help="ignored: a rollout is a sequence of steps")
    return parser.parse_known_args(argv)[0]


def _other_name_answers(options: argparse.Namespace) -> bool:
    """Whether a viewer asks under the deprecated name and under the new one as well, which answers."""
    asked_as = os.path.basename(sys.argv[0])
    return asked_as.startswith(_DEPRECATED_PREFIX) and bool(options.recording_id) and shutil.which(_NAME) is not None
