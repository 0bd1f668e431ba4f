"""The top-down map of a rollout as JSON: when each cell of the floor was first observed, and the agent's path."""

import base64
import csv
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import AVPError, RolloutError
from avp_habitat.images import read_numbers
from avp_habitat.rollout import Rollout, read_rollout

NOT_NAVIGABLE, NEVER = 0, 1
"""Numbers of a floor; one of 1 + t was first observed by view t."""
_COLUMNS = ("x_m", "z_m", "yaw_rad")


def floor_map(folder: Path) -> dict[str, Any] | None:
    """The map of a rollout as `results.json` keeps it; None for a rollout that was written without its floor.

    Args:
        folder: of the rollout.

    Raises:
        RolloutError: the folder, its floor or its `steps.csv` cannot be used.
    """
    rollout = read_rollout(folder)
    if rollout.floor is None:
        return None
    numbers = read_numbers(rollout.floor.picture)
    return {
        "cell_m": rollout.floor.cell_m,
        "origin_m": list(rollout.floor.origin_m),
        "shape": list(rollout.floor.shape),
        "floor": base64.b64encode(zlib.compress(numbers.astype("<u2").tobytes(), 9)).decode("ascii"),
        "path": _path(rollout),
    }


def floor_of(entry: dict[str, Any]) -> NDArray[np.uint16]:
    """`(rows, columns)` numbers of a map, as its rollout's `floor.png` holds them.

    Raises:
        AVPError: the entry is damaged.
    """
    try:
        packed = zlib.decompress(base64.b64decode(entry["floor"], validate=True))
        return np.frombuffer(packed, dtype="<u2").reshape(entry["shape"]).astype(np.uint16)
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise AVPError(f"a map of the results cannot be read: {error}") from None


def _path(rollout: Rollout) -> list[list[float]]:
    """`[x, z, yaw]` after each step, in metres and radians."""
    path = rollout.folder / "steps.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [[round(float(row[name]), 4) for name in _COLUMNS] for row in csv.DictReader(file)]
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise RolloutError(
            f"{path}: expected x_m, z_m and yaw_rad of every step, could not read them: {error!r}"
        ) from None
    if not np.isfinite(rows).all():
        raise RolloutError(f"{path}: expected finite positions and angles, found others")
    return rows
