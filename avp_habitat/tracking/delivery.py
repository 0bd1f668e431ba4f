"""Entries of a journal told to MLflow so that each arrives once, however often it is told.

MLflow's databases take a point that they have already for the same point; its folder stores and the servers in front of
them do not. After a call of which nobody knows whether it worked, points that the run has are therefore left out.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from avp_habitat.tracking.stores import TrackingError, first_line

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric

CHANGED_TAG = "avp.changed_params"
_MAX_TAG = 5000
_METRICS_PER_CALL, _PARAMS_PER_CALL, _TAGS_PER_CALL = 900, 100, 100
_PERMANENT = {
    "BAD_REQUEST",
    "ENDPOINT_NOT_FOUND",
    "INVALID_PARAMETER_VALUE",
    "INVALID_STATE",
    "MALFORMED_REQUEST",
    "NOT_IMPLEMENTED",
    "PERMISSION_DENIED",
    "RESOURCE_ALREADY_EXISTS",
    "RESOURCE_DOES_NOT_EXIST",
}

Reject = Callable[[dict[str, Any], str], None]
"""Takes an entry that MLflow refuses, and why."""


class Delivery:
    """The way from a run's journal to its MLflow run."""

    def __init__(self, client: "MlflowClient", run_id: str, folder: Path | None, reject: Reject) -> None:
        """Tell `client` about the run; `folder` is the journal's, for the files that entries name."""
        self._client = client
        self._run_id = run_id
        self._folder = folder
        self._reject = reject
        self.calls = 0
        """How many calls MLflow has answered."""

    def send(self, entries: Sequence[dict[str, Any]], *, uncertain: bool) -> None:
        """Tell MLflow.

        Args:
            entries: of the journal, the oldest first.
            uncertain: whether some of them may have arrived already.

        Raises:
            Exception: MLflow cannot be reached, or fails for another reason that may pass.
        """
        self._send_values([entry for entry in entries if _is_values(entry)], uncertain=uncertain)
        # Of files that replace each other the last one is enough. A run ends after everything else.
        files = {entry["path"]: entry for entry in entries if "file" in entry}
        others = [entry for entry in entries if not _is_values(entry) and "file" not in entry]
        for entry in [*files.values(), *others]:
            self._unless_refused([entry], lambda entry=entry: self._send_one(entry))

    def _send_values(self, entries: list[dict[str, Any]], *, uncertain: bool) -> None:
        from mlflow.entities import Metric, Param, RunTag

        points = [Metric(*point) for entry in entries for point in entry.get("metrics", ())]
        if uncertain:
            points = self._missing(points)
        for chunk in _chunks(points, _METRICS_PER_CALL):
            self._unless_refused(
                [{"metrics": [[p.key, p.value, p.timestamp, p.step] for p in chunk]}],
                lambda chunk=chunk: self._client.log_batch(self._run_id, metrics=chunk),
            )
        tags: dict[str, str] = {}
        for entry in entries:
            tags |= entry.get("tags", {})
        params = [Param(*pair) for pair in self._new_params(entries, tags).items()]
        for chunk in _chunks(params, _PARAMS_PER_CALL):
            self._unless_refused(
                [{"params": {param.key: param.value for param in chunk}}],
                lambda chunk=chunk: self._client.log_batch(self._run_id, params=chunk),
            )
        for chunk in _chunks([RunTag(*pair) for pair in tags.items()], _TAGS_PER_CALL):
            self._unless_refused(
                [{"tags": {tag.key: tag.value for tag in chunk}}],
                lambda chunk=chunk: self._client.log_batch(self._run_id, tags=chunk),
            )

    def _new_params(self, entries: list[dict[str, Any]], tags: dict[str, str]) -> dict[str, str]:
        """Parameters that the run does not have; a changed one, which MLflow would refuse, is added to the tags."""
        wanted: dict[str, str] = {}
        for entry in entries:
            wanted |= entry.get("params", {})
        if not wanted:
            return {}
        known = self._client.get_run(self._run_id).data.params
        changed = {name: [known[name], value] for name, value in wanted.items() if known.get(name, value) != value}
        if changed:
            tags[CHANGED_TAG] = json.dumps(changed)[:_MAX_TAG]
        return {name: value for name, value in wanted.items() if name not in known}

    def _send_one(self, entry: dict[str, Any]) -> None:
        if "file" in entry:
            self._send_file(Path(entry["file"]), entry["path"])
        elif "end" in entry:
            self._client.set_terminated(self._run_id, entry["end"], entry["at"])
        else:
            raise TrackingError("nobody can read this line")

    def _send_file(self, file: Path, path: str) -> None:
        """An artifact; the file lies in the journal's folder, in a folder of its own, and then goes."""
        source = self._inside(file)
        if not source.is_file():
            return  # It was sent, and the process killed before it could say so.
        folder = PurePosixPath(path).parent.as_posix()
        self._client.log_artifact(self._run_id, str(source), None if folder == "." else folder)

    def _inside(self, file: Path) -> Path:
        if self._folder is None:
            return file
        source = (self._folder / file).resolve()
        if not source.is_relative_to(self._folder.resolve()):
            raise TrackingError(f"{file}: expected a file within {self._folder}")
        return source

    def forget_files(self, entries: Iterable[dict[str, Any]]) -> None:
        """Remove the files of entries that are acknowledged."""
        for entry in entries:
            if "file" in entry:
                shutil.rmtree(self._inside(Path(entry["file"])).parent, ignore_errors=True)

    def _missing(self, points: "list[Metric]") -> "list[Metric]":
        """Those of the points that the run does not have."""
        known: set[tuple[Any, ...]] = set()
        for key in {point.key for point in points}:
            known |= {_identity(point) for point in self._client.get_metric_history(self._run_id, key)}
            self.calls += 1
        missing = []
        for point in points:
            if _identity(point) not in known:
                known.add(_identity(point))
                missing.append(point)
        return missing

    def _unless_refused(self, entries: list[dict[str, Any]], call: Callable[[], object]) -> None:
        from mlflow.exceptions import MlflowException

        try:
            call()
        except (MlflowException, TrackingError) as error:
            if isinstance(error, MlflowException) and error.error_code not in _PERMANENT:
                raise
            for entry in entries:
                self._reject(entry, first_line(error))
        self.calls += 1


def _is_values(entry: dict[str, Any]) -> bool:
    return bool(entry.keys() & {"metrics", "tags", "params"})


def _chunks(items: list[Any], size: int) -> Iterable[list[Any]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def _identity(point: "Metric") -> tuple[Any, ...]:
    """What makes a point the same point; MLflow's databases keep infinity as the largest number."""
    value = point.value
    if math.isnan(value):
        return point.key, point.timestamp, point.step, None
    return point.key, point.timestamp, point.step, max(min(value, 1.7976931348623157e308), -1.7976931348623157e308)
