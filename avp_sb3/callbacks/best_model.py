"""The best model of a training so far, kept in one file that nothing half-written ever replaces."""

import json
import os
import uuid
import warnings
import zipfile
from collections.abc import Iterable
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.files import atomic_file, check_writable
from avp_habitat.policies.saved_model import statistics_names
from avp_sb3.evaluation.policy import figures_of

WHEN = "DATE-TIME"
_TRAINING, _BEST = "avp_training_id", "avp_best"


class BestModelError(AVPError):
    """A best model that cannot be kept where it was asked for."""


class BestModel:
    """Compares scores, and keeps the model with the best one.

    A model carries an identity of its training in `avp_training_id`, and the score in `avp_best`; both are in its
    `.zip`, so that a resumed training goes on with its own file and never touches another's.
    """

    def __init__(self, path: str | Path | None, score: str) -> None:
        """Compare a score; keep the model in a file, in whose name `DATE-TIME` becomes when the training started."""
        self.path: Path | None = None
        self.value: float | None = None
        self._wanted = None if path is None else Path(path)
        self._score = score

    def start(self, model: BaseAlgorithm, metrics: Iterable[Any] = ()) -> None:
        """Find the file's name, and go on from the file that is there when it is this training's own.

        The score may be one of the user's metrics, as `TaskSettings.metrics` has them.

        Raises:
            UsageError: there is no such score, or the file is another training's, or its best by another score.
            BestModelError: the folder cannot be written.
        """
        known = figures_of(metrics)
        if self._score not in known:
            raise unknown_name("score", self._score, known)
        self._lower = known[self._score].better == "lower"
        if not hasattr(model, _TRAINING):
            # From the system: the training's own random numbers stay as they are.
            setattr(model, _TRAINING, uuid.uuid4().hex)
        self.value = None
        if self._wanted is None:
            return
        self.path = path = self._path()
        files = [path] if model.get_vec_normalize_env() is None else [path, statistics_names(path)[0]]
        if found := [file for file in files if file.is_symlink() or file.exists()]:
            self.value = self._own_value(path, found[0], getattr(model, _TRAINING))
        check_writable(path, failure=BestModelError, option="best_model")

    def offer(self, model: BaseAlgorithm, value: float) -> bool:
        """Keep the model if its score is better than all before; whether it was kept.

        A score of nan is never better. A file that cannot be written is a warning; the training goes on.
        """
        if not self._is_better(value):
            return False
        if self.path is not None:
            setattr(model, _BEST, {"score": self._score, "value": value, "step": model.num_timesteps})
            try:
                save_model(model, self.path)
            except OSError as error:
                warnings.warn(f"best_model {self.path}: not written: {error}", stacklevel=2)
                return False
        self.value = value
        return True

    def _is_better(self, value: float) -> bool:
        if self.value is None or value != value:
            return value == value
        return value < self.value if self._lower else value > self.value

    def _path(self) -> Path:
        assert self._wanted is not None
        wanted = self._wanted if self._wanted.suffix == ".zip" else Path(f"{self._wanted}.zip")
        if WHEN not in wanted.name:
            return wanted
        named = wanted.with_name(wanted.name.replace(WHEN, f"{datetime.now():%Y%m%d-%H%M%S}"))
        names = (named.with_stem(f"{named.stem}-{number}") for number in count(2))
        return next(path for path in chain([named], names) if not path.exists())

    def _own_value(self, path: Path, found: Path, training: str) -> float:
        held = _held(path)
        if held.get(_TRAINING) != training:
            raise UsageError(f"best_model {found}: exists already and is not of this training; choose another name")
        best = held.get(_BEST) or {}
        if best.get("score") != self._score:
            told = f"holds this training's best by {best.get('score')!r}, asked for is {self._score!r}"
            raise UsageError(f"best_model {path}: {told}; choose another name")
        return float(best["value"])


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Write a model, and beside it the statistics of a training with `VecNormalize`; each is whole or not there."""
    normalised = model.get_vec_normalize_env()
    if normalised is not None:
        with atomic_file(statistics_names(path)[0]) as file:
            normalised.save(os.fspath(file))
    with atomic_file(path) as file:
        model.save(file)


def _held(path: Path) -> dict[str, Any]:
    """What a model's file says in plain JSON, without unpickling anything; empty for another kind of file."""
    try:
        with zipfile.ZipFile(path) as archive:
            held = json.loads(archive.read("data"))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        return {}
    return held if isinstance(held, dict) else {}
