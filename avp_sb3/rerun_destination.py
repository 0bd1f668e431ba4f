"""The recording that rollouts become part of, as a viewer or another application asks for it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from avp_sb3.rerun_layout import APPLICATION

Time = int | np.timedelta64 | np.datetime64
"""A number in a sequence, a duration, or a moment."""


@dataclass(frozen=True)
class Destination:
    """Where rollouts are recorded."""

    application_id: str = APPLICATION
    """Of the recording."""
    recording_id: str | None = None
    """Of the recording; a new one when None."""
    prefix: str = ""
    """Entity path above the rollouts."""
    times: Mapping[str, Time] = field(default_factory=dict)
    """Further time lines, each with the one value that it has for all of the rollouts."""
    own: bool = True
    """The recording is for the rollouts alone, which give it its name and layout."""


class DestinationRecording(rr.RecordingStream):
    """A recording in which all that has a time has the destination's times too."""

    def __init__(self, destination: Destination) -> None:
        """Make a recording that goes nowhere yet.

        Args:
            destination: what it is part of.
        """
        super().__init__(
            destination.application_id, recording_id=destination.recording_id, send_properties=destination.own
        )
        self._times = destination.times
        self._set_times()

    def __del__(self) -> None:
        """As `rerun.RecordingStream.__del__`, which asks for `inner` also where making the recording failed."""
        if hasattr(self, "inner"):
            super().__del__()

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any], *, strict: bool | None = None
    ) -> None:
        """As `rerun.RecordingStream.send_columns`, with the further times in every row."""
        indexes = list(indexes)
        rows = len(indexes[0].as_arrow_array()) if indexes else 0
        indexes += [_column(name, value, rows) for name, value in self._times.items() if rows]
        super().send_columns(entity_path, indexes, columns, strict=strict)

    def reset_time(self) -> None:
        """As `rerun.RecordingStream.reset_time`, but for the further times, which stay."""
        super().reset_time()
        self._set_times()

    def _set_times(self) -> None:
        for name, value in self._times.items():
            if isinstance(value, np.timedelta64):
                self.set_time(name, duration=value)
            elif isinstance(value, np.datetime64):
                self.set_time(name, timestamp=value)
            else:
                self.set_time(name, sequence=value)


def _column(name: str, value: Time, rows: int) -> rr.TimeColumn:
    if isinstance(value, np.timedelta64):
        return rr.TimeColumn(name, duration=np.full(rows, value))
    if isinstance(value, np.datetime64):
        return rr.TimeColumn(name, timestamp=np.full(rows, value))
    return rr.TimeColumn(name, sequence=[value] * rows)
