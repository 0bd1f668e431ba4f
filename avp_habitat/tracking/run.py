"""An MLflow run that is filled from a program which must not wait for MLflow, nor lose anything to it."""

import json
import logging
import math
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from avp_habitat.tracking.delivery import Delivery
from avp_habitat.tracking.journal import Journal
from avp_habitat.tracking.names import Names, create, reopen, safe_name
from avp_habitat.tracking.sender import INTERVAL_S, Sender
from avp_habitat.tracking.stores import StoreUnreachableError, connect, is_missing, shown

if TYPE_CHECKING:
    import numpy as np
    from mlflow import MlflowClient
    from numpy.typing import NDArray

Status = Literal["FINISHED", "FAILED", "KILLED"]

_MAX_PARAM, _MAX_TAG = 6000, 5000
_CLOSING_S = 30.0
_NAMES_TAG = "avp.renamed"
_log = logging.getLogger(__name__)


class TrackedRun:
    """A run; everything it is told is on disk at once and with MLflow soon, in the background.

    Made by `avp_habitat.tracking.opening`. All methods may be called from any thread, one at a time.
    """

    def __init__(
        self,
        journal: Journal,
        client: "MlflowClient | None",
        *,
        uncertain: bool = False,
        interval_s: float = INTERVAL_S,
    ) -> None:
        """Fill the run of a journal.

        Args:
            journal: of the run.
            client: of its store; None connects when something is to be sent.
            uncertain: whether an earlier process may have sent some of the journal.
            interval_s: between two calls of MLflow.
        """
        self._journal = journal
        self._client = client
        self._names = Names()
        self._told: set[str] = set()
        self._sender = Sender(journal, self.address, self._open_delivery, uncertain=uncertain, interval_s=interval_s)
        self._sender.start()
        if journal.problem is not None:
            self._tell_once("disk", f"MLflow's points cannot be kept on disk ({journal.problem}), only in memory")

    @property
    def run_id(self) -> str:
        """MLflow's id; `offline-KEY` as long as MLflow does not know the run."""
        return self._journal.header["run_id"] or f"offline-{self._journal.header['key']}"

    @property
    def address(self) -> str:
        """Of the store, as MLflow is given it; it may hold a password."""
        return self._journal.header["address"]

    @property
    def folder(self) -> Path | None:
        """The journal's, while there is one."""
        return self._journal.folder

    def metrics(self, values: Mapping[str, float], step: int, *, timestamp_ms: int | None = None) -> None:
        """Add numbers at a step; names that MLflow refuses are changed, which the tag `avp.renamed` says."""
        at = int(time.time() * 1000) if timestamp_ms is None else timestamp_ms
        known = len(self._names.changed)
        points = [[self._names[name], float(value), at, int(step)] for name, value in values.items()]
        if len(self._names.changed) > known:
            changed = self._names.changed
            _log.info("MLflow does not take all names; changed: %s", changed)
            self.tags({_NAMES_TAG: json.dumps(changed)})
        for name, value, _, _ in points:
            if not math.isfinite(value):
                self._tell_once(f"value {name}", f"MLflow run {self.run_id}: {name} is {value} at step {step}")
        if points:
            self._append({"metrics": points})

    def tags(self, values: Mapping[str, str]) -> None:
        """Set tags; long texts are cut."""
        if values:
            self._append({"tags": {safe_name(name): str(value)[:_MAX_TAG] for name, value in values.items()}})

    def params(self, values: Mapping[str, Any]) -> None:
        """Set parameters; one that the run has already keeps its value, which the tag `avp.changed_params` says."""
        if values:
            self._append({"params": {safe_name(name): str(value)[:_MAX_PARAM] for name, value in values.items()}})

    def save(self, path: str, write: Callable[[Path], object]) -> bool:
        """Keep an artifact that `write` writes to a file; whether that worked, which a full disk prevents.

        Args:
            path: of the artifact within the run; one of the same name is replaced.
            write: given a path that ends like `path`, makes that file.
        """
        try:
            with self._journal.new_file(PurePosixPath(path).name) as file:
                write(file)
        except OSError as error:
            self._tell_once(f"file {path}", f"MLflow run {self.run_id}: {path} cannot be kept: {error}")
            return False
        folder = self._journal.folder
        self._append({"file": str(file.relative_to(folder) if folder else file), "path": path})
        return True

    def file(self, source: Path, path: str | None = None) -> bool:
        """Keep a copy of a file as artifact `path`, its own name when omitted."""
        return self.save(path or source.name, lambda target: shutil.copyfile(source, target))

    def image(self, name: str, rgb: "NDArray[np.uint8]", step: int) -> None:
        """Keep a `(h, w, 3)` picture at a step; MLflow shows those of one name along the steps."""
        from PIL import Image

        picture = Image.fromarray(rgb)
        small = picture.copy()
        small.thumbnail((256, 256))
        # By such names MLflow's UI knows a series of pictures: MlflowClient.log_image in mlflow/tracking/client.py.
        series = safe_name(name).replace("/", "~")
        stem = f"images/{series}+step+{step}+timestamp+{int(time.time() * 1000)}+{uuid4()}"
        self.save(f"{stem}.png", lambda file: picture.save(file, compress_level=1))
        self.save(f"{stem}+compressed.webp", lambda file: small.save(file, quality=80))
        self.tags({"mlflow.loggedImages": "True"})

    def flush(self, timeout_s: float = _CLOSING_S) -> bool:
        """Wait until MLflow has everything; whether it has."""
        return self._sender.drain(timeout_s)

    def close(self, status: Status, *, at_ms: int | None = None, timeout_s: float = _CLOSING_S) -> bool:
        """Send the rest and end the run; whether MLflow has everything. What it does not have stays on disk.

        Args:
            status: of the run; a run that is not ours keeps its own.
            at_ms: when it ended, milliseconds since 1970; now when omitted.
            timeout_s: to wait for a store at most without any progress.
        """
        header = self._journal.header
        header["ended"] = status
        try:
            with suppress(OSError):
                self._journal.save_header()
            if header["owned"]:
                self._append({"end": status, "at": at_ms or int(time.time() * 1000)})
        finally:
            delivered = self.leave(timeout_s=timeout_s)
        return delivered

    def leave(self, *, timeout_s: float = _CLOSING_S) -> bool:
        """Send the rest without ending the run; whether MLflow has everything."""
        try:
            self._sender.drain(timeout_s)
        finally:
            # A thread that hangs in a call keeps the journal until this process ends.
            self._put_away(idle=self._sender.stop())
        return not self._journal

    def _put_away(self, *, idle: bool) -> None:
        journal = self._journal
        if idle and not journal and not journal.has_rejected:
            journal.remove()
            return
        if idle:
            journal.release()
        where = f"stay in {journal.folder}; send them with: python -m avp_habitat.tracking.deliver"
        if journal.folder is None:
            where = "are lost, because the disk takes nothing either"
        if journal:
            reason = self._sender.problem or "it was too slow"
            _log.warning(
                "MLflow at %s did not take all of run %s (%s); its last points %s",
                shown(self.address),
                self.run_id,
                reason,
                where,
            )
        else:
            _log.warning("MLflow refused some of run %s; those points %s --again", self.run_id, where)

    def _open_delivery(self) -> Delivery:
        header = self._journal.header
        if self._client is None:
            if header["run_id"] is not None and is_missing(self.address):
                raise StoreUnreachableError("the database is gone")
            self._client = connect(self.address)
        if header["run_id"] is None:
            header["run_id"] = create(self._client, header)
            with suppress(OSError):
                self._journal.save_header()
        elif header.get("continue"):
            reopen(self._client, header["run_id"])
        return Delivery(self._client, header["run_id"], self._journal.folder, self._refused)

    def _refused(self, entry: dict[str, Any], reason: str) -> None:
        self._journal.reject(entry, reason)
        self._tell_once(f"refused {reason}", f"MLflow run {self.run_id} refuses some metrics or files: {reason}")

    def _append(self, entry: dict[str, Any]) -> None:
        self._journal.append(entry)
        if self._journal.folder is not None and self._journal.problem is not None:
            self._tell_once("disk", f"MLflow's points cannot be kept on disk now ({self._journal.problem})")

    def _tell_once(self, key: str, text: str) -> None:
        if key not in self._told:
            self._told.add(key)
            _log.warning(text)
