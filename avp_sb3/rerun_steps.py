"""The table `steps.csv` of a rollout as arrays, with every fault of it named."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.settings import ACTION_NAMES


class Steps:
    """The rows of a `steps.csv`."""

    def __init__(self, path: Path, frames: int) -> None:
        """Read a table.

        Args:
            path: of the file.
            frames: how many rows it must have.

        Raises:
            RolloutError: it is missing, unreadable, ragged, or has another number of rows.
        """
        self.path = path
        try:
            with path.open(newline="", encoding="utf-8") as file:
                lines = list(csv.reader(file))
        except FileNotFoundError:
            raise RolloutError(f"{path}: expected a table of steps, found no such file") from None
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise RolloutError(f"{path}: expected a table of steps, could not read it: {error}") from None
        self.names, self.rows = (lines[0], lines[1:]) if lines else ([], [])
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.names):
                raise RolloutError(f"{path}: expected {len(self.names)} columns, found {len(row)} in row {number}")
        if len(self.rows) != frames:
            raise RolloutError(f"{path}: expected one row per frame ({frames}), found {len(self.rows)}")

    def numbers(self, name: str) -> NDArray[np.float64]:
        """`(t,)` a column.

        Raises:
            RolloutError: there is no such column, or something in it is no finite number.
        """
        words = self._column(name)
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise RolloutError(f"{self.path}: expected numbers in column {name!r}: {error}") from None
        if bad := np.flatnonzero(~np.isfinite(values)).tolist():
            raise RolloutError(
                f"{self.path}: expected finite numbers in column {name!r}, found {words[bad[0]]} in row {bad[0] + 1}"
            )
        return values

    def actions(self) -> NDArray[np.float64]:
        """`(t,)` the actions' numbers.

        Raises:
            RolloutError: there is an action that no agent has.
        """
        words = self._column("action")
        if unknown := sorted({repr(word) for word in words if word not in ACTION_NAMES}):
            expected = ", ".join(ACTION_NAMES)
            raise RolloutError(f"{self.path}: expected actions out of {expected}, found {', '.join(unknown)}")
        return np.array([float(ACTION_NAMES.index(word)) for word in words])

    def plots(self) -> dict[str, NDArray[np.float64]]:
        """`(t,)` the figures of the steps, named as those of a training's episodes.

        Raises:
            RolloutError: a column is missing or wrong.
        """
        parts = {f"reward/{name.removeprefix('reward_')}": name for name in self.names if name.startswith("reward_")}
        columns = {"coverage": "coverage", "reward/sum": "reward", **parts}
        return {"action": self.actions()} | {plot: self.numbers(name) for plot, name in columns.items()}

    def feet(self) -> NDArray[np.float64]:
        """`(t, 3)` where the agent stood after each step, metres, world frame.

        Raises:
            RolloutError: a column is missing or wrong.
        """
        return np.stack([self.numbers(name) for name in ("x_m", "y_m", "z_m")], axis=-1)

    def _column(self, name: str) -> list[str]:
        if self.names.count(name) != 1:
            found = ", ".join(self.names) or "none"
            raise RolloutError(f"{self.path}: expected a column {name!r}, found {found}")
        index = self.names.index(name)
        return [row[index] for row in self.rows]
