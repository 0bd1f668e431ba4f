"""An output format of Stable-Baselines3's logger that writes to an MLflow run."""

import logging
from io import BytesIO
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import Figure, Image, KVWriter

from avp_habitat.tracking.run import TrackedRun
from avp_sb3.logged_file import LoggedFile

FORMAT = "mlflow"
"""The name by which `logger.record(..., exclude="mlflow")` keeps a value away from MLflow."""
_log = logging.getLogger(__name__)


class MLflowWriter(KVWriter):
    """Hands what the logger dumps to a run: numbers, texts (as tags), pictures (by step) and files."""

    def __init__(self, run: TrackedRun) -> None:
        """Write to a run, which stays open."""
        self._run = run
        self._told: set[str] = set()

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Take one dump at `step` (environment steps); values of other kinds are named once."""
        numbers, texts = {}, {}
        for key, value in key_values.items():
            if FORMAT in (key_excluded.get(key) or ()):
                continue
            if isinstance(value, str):
                texts[key] = value
            elif (number := _number(value)) is not None:
                numbers[key] = number
            else:
                self._keep(key, value, step)
        self._run.metrics(numbers, step)
        self._run.tags(texts)

    def close(self) -> None:
        """Nothing: the run is closed by whoever opened it."""

    def _keep(self, key: str, value: Any, step: int) -> None:
        if isinstance(value, LoggedFile):
            self._run.file(value.path, value.name)
        elif isinstance(value, (Image, Figure)) and (rgb := _pixels(value)) is not None:
            self._run.image(key, rgb, step)
        elif key not in self._told:
            self._told.add(key)
            _log.warning("%s: MLflow takes numbers, texts, pictures and files here, not %s", key, type(value).__name__)


def _number(value: Any) -> float | None:
    """A Python, numpy or one-element tensor number as float; None for anything else."""
    if isinstance(value, Real):
        return float(value)
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        return float(value.item())
    return None


def _pixels(value: Image | Figure) -> NDArray[np.uint8] | None:
    """A picture as `(h, w, 3)` bytes; None for an arrangement of axes other than HWC, CHW and HW."""
    if isinstance(value, Figure):
        from PIL import Image as Files

        buffer = BytesIO()
        value.figure.savefig(buffer, format="png")
        return np.asarray(Files.open(buffer).convert("RGB"))
    pixels = np.asarray(value.image)
    order = {"HWC": (0, 1, 2), "CHW": (1, 2, 0), "HW": (0, 1)}.get(value.dataformats.upper())
    if order is None or pixels.ndim != len(order):
        return None
    pixels = pixels.transpose(order)
    # As TensorBoard reads them: floats within [0, 1], whole numbers within [0, 255].
    if np.issubdtype(pixels.dtype, np.floating):
        pixels = np.clip(255 * pixels, 0, 255).round()
    pixels = pixels.astype(np.uint8).reshape(*pixels.shape[:2], -1)[..., :3]
    return np.repeat(pixels, 3, axis=-1) if pixels.shape[-1] == 1 else pixels
