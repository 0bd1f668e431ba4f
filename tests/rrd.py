"""Reading a Rerun recording back with its SDK."""

import subprocess
from pathlib import Path

import numpy as np
import rerun_cli
from rerun.chunk import RrdReader

PROGRAM = Path(rerun_cli.__file__).with_name("rerun")
"""Rerun's own; the script on the path would leave it running when it is stopped."""


def verify(path):
    """Rerun's own check."""
    done = subprocess.run([PROGRAM, "rrd", "verify", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "verified without error" in done.stdout + done.stderr


def chunks(path):
    reader = RrdReader(path)
    return [chunk for store in reader.recordings() for chunk in reader.stream(store=store)]


def entities(path):
    return {chunk.entity_path for chunk in chunks(path) if not chunk.entity_path.startswith("/__")}


def rows(path, entity, component, timeline="step"):
    """Time and flat values of each row of one component, sorted by time."""
    found = []
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names and timeline in batch.schema.names:
            times, values = batch.column(timeline).to_pylist(), batch.column(component).to_pylist()
            found += [(time, np.array(value).ravel()) for time, value in zip(times, values, strict=True)]
    return sorted(found, key=lambda row: row[0])
