"""The figures of every finished episode as curves of a recording, kept back and sent many at a time."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Real

import rerun as rr

ROOT = "metrics"
_ROWS, _SECONDS = 512, 10.0
_RETURN = "return_"
_NUMBER_BYTES, _CURVE_BYTES = 24, 2_000


@dataclass(frozen=True)
class _Row:
    episode: int
    env_step: int
    step: int | None
    figures: Mapping[str, float]


class EpisodeFigures:
    """Figures on the time lines `episode` and `env_step`; those of recorded episodes also on `step`."""

    def __init__(self) -> None:
        """Begin with nothing to send."""
        self._rows: list[_Row] = []
        self._sent_at = time.monotonic()

    def add(self, figures: Mapping[str, object], *, episode: int, env_step: int, step: int | None = None) -> None:
        """Keep a finished episode for the next sending.

        Args:
            figures: by name; what is not a number is left out. `return_NAME` is shown as `return/NAME`.
            episode: its number.
            env_step: environment steps when it ended.
            step: of the recording's time line `step`, if the episode was recorded.
        """
        numbers = {name: float(value) for name, value in figures.items() if isinstance(value, Real)}
        self._rows.append(_Row(episode, env_step, step, numbers))

    @property
    def due(self) -> bool:
        """Whether sending is worth its time: many episodes are kept, or the last sending was a while ago."""
        if not self._rows:
            return False
        return len(self._rows) >= _ROWS or time.monotonic() - self._sent_at > _SECONDS

    @property
    def size(self) -> int:
        """About what sending will add to a file, bytes."""
        numbers = sum(len(row.figures) for row in self._rows)
        # Recorded and other episodes are two pieces of a curve.
        pieces = 2 * max((len(row.figures) for row in self._rows), default=0)
        return _NUMBER_BYTES * numbers + _CURVE_BYTES * pieces

    def send(self, recordings: Iterable[rr.RecordingStream]) -> None:
        """Add what is kept to recordings, and forget it."""
        columns = _columns(self._rows)
        for recording in recordings:
            for path, indexes, values in columns:
                recording.send_columns(path, indexes, rr.Scalars.columns(scalars=values))
        self._rows.clear()
        self._sent_at = time.monotonic()


def _columns(rows: list[_Row]) -> list[tuple[str, list[rr.TimeColumn], list[float]]]:
    """For each figure, separately for recorded and other episodes: entity, times and values."""
    found = []
    for recorded in (False, True):
        mine = [row for row in rows if (row.step is not None) == recorded]
        for name in dict.fromkeys(name for row in mine for name in row.figures):
            having = [row for row in mine if name in row.figures]
            found.append((_path(name), _times(having), [row.figures[name] for row in having]))
    return found


def _times(rows: list[_Row]) -> list[rr.TimeColumn]:
    columns = [
        rr.TimeColumn("episode", sequence=[row.episode for row in rows]),
        rr.TimeColumn("env_step", sequence=[row.env_step for row in rows]),
    ]
    if rows[0].step is not None:
        columns.append(rr.TimeColumn("step", sequence=[row.step for row in rows if row.step is not None]))
    return columns


def _path(name: str) -> str:
    group, rest = ("return/", name.removeprefix(_RETURN)) if name.startswith(_RETURN) else ("", name)
    return f"{ROOT}/{group}{rr.escape_entity_path_part(rest)}"
