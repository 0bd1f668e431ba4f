"""The importer's answer to a viewer: the recording of rollouts, on the standard output."""

import argparse
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from avp_habitat.command import run
from avp_habitat.errors import UsageError
from avp_habitat.rollout import read_rollout
from avp_sb3.rerun_destination import Destination, Time
from avp_sb3.rerun_layout import APPLICATION
from avp_sb3.rerun_recording import recording_bytes

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
