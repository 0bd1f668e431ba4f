"""Trainings of nerfstudio opened again by their config.yml: settings, newest checkpoint, pipeline.

nerfstudio keeps its settings as YAML that names Python objects, which reading it creates: a config.yml is trusted like
a program, so open only those of your own trainings. The checkpoint beside it is read with torch's safe loader.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from avp_habitat.errors import AVPError

_STEP = re.compile(r"step-(\d+)\.ckpt")
_EXPECTED = "expected the config.yml that ns-train wrote"


class TrainedRunError(AVPError):
    """A training's folder that cannot be opened again."""


@dataclass(frozen=True)
class TrainedRun:
    """A training opened for rendering."""

    config: Any
    """nerfstudio's `TrainerConfig`."""
    pipeline: Any
    """nerfstudio's `Pipeline` with the checkpoint's weights, in evaluation mode."""
    checkpoint: Path
    """The file they come from."""
    step: int
    """The last iteration it has seen."""


def allow_checkpoints() -> None:
    """Let `torch.load(weights_only=True)`, the default since torch 2.6, open the checkpoints of nerfstudio 1.1.5.

    Its learning-rate schedulers remember numpy scalars (float64), because they compute with numpy: a scalar is stored
    as its type's name, its dtype and its bytes. These only hold numbers; any other type is still refused.
    """
    scalar: Any = np.float64(0).__reduce__()[0]
    # numpy 2 writes numpy._core.multiarray.scalar, numpy 1 numpy.core.multiarray.scalar: checkpoints of both exist.
    names = ("numpy._core.multiarray.scalar", "numpy.core.multiarray.scalar")
    torch.serialization.add_safe_globals([*((scalar, name) for name in names), np.dtype, type(np.dtype(np.float64))])


def config_path(path: Path) -> Path:
    """The config.yml that a path means: itself, or that inside a training's or a reconstruction's folder.

    Raises:
        TrainedRunError: there is none.
    """
    if path.is_dir():
        scores = path / "scores.json"  # that of `avp_nerfstudio.reconstruct`
        inside = path / "config.yml"
        if not inside.is_file() and scores.is_file():
            kept = json.loads(scores.read_text(encoding="utf-8")).get("config")
            if kept is None:
                raise TrainedRunError(
                    f"{path}: kept no checkpoint; reconstruct with --keep-checkpoint to open it again"
                )
            inside = path / kept
        path = inside
    if not path.is_file():
        raise TrainedRunError(f"{path}: {_EXPECTED}, found none")
    return path


def read_config(path: Path) -> Any:
    """Nerfstudio's `TrainerConfig`, which finds its checkpoints beside the file wherever the folder has moved to.

    Raises:
        TrainedRunError: the file is not what ns-train writes, or its method is not installed.
    """
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.engine.trainer import TrainerConfig

    try:
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
    except Exception as error:
        raise TrainedRunError(f"{path}: {_EXPECTED}, could not read it: {_line(error)}") from None
    if not isinstance(config, TrainerConfig):
        raise TrainedRunError(f"{path}: {_EXPECTED}, found a {type(config).__name__} instead of settings")
    if config.method_name not in all_methods:
        raise TrainedRunError(f"{path}: its method {config.method_name!r} is not installed here")
    config.pipeline.datamanager._target = all_methods[config.method_name].pipeline.datamanager._target
    config.relative_model_dir = (path.parent / config.relative_model_dir).resolve()
    return config


def newest_checkpoint(folder: Path) -> tuple[Path, int]:
    """The checkpoint with the highest step in a folder, with that step.

    Raises:
        TrainedRunError: there is none.
    """
    steps = [int(found[1]) for path in folder.glob("*.ckpt") if (found := _STEP.fullmatch(path.name))]
    if not steps:
        raise TrainedRunError(f"{folder}: expected a checkpoint (step-*.ckpt), found none; has the training saved one?")
    return folder / f"step-{max(steps):09d}.ckpt", max(steps)


def open_trained(config: Any) -> TrainedRun:
    """Build the pipeline of a training and load its newest checkpoint, on a GPU where there is one.

    Args:
        config: from `read_config`.

    Raises:
        TrainedRunError: there is no checkpoint, or it cannot be loaded into this method.
        RolloutError: the rollout it was trained on cannot be used.
    """
    from nerfstudio.utils.eval_utils import eval_load_checkpoint

    checkpoint, step = newest_checkpoint(config.get_checkpoint_dir())
    config.load_dir, config.load_step = checkpoint.parent, step
    try:
        pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode="test")
    except OSError as error:  # data that has gone, or LPIPS weights that cannot be downloaded
        raise TrainedRunError(f"{checkpoint.parent.parent}: what it was trained with cannot be had: {error}") from error
    pipeline.eval()
    try:
        eval_load_checkpoint(config, pipeline)
    except Exception as error:
        raise TrainedRunError(loading_fault(checkpoint, error)) from error
    return TrainedRun(config, pipeline, checkpoint, step)


def loading_fault(checkpoint: Path, error: Exception) -> str:
    """One line on why a checkpoint could not be loaded."""
    refused = re.search(r"GLOBAL (\S+)", str(error))
    if refused:
        return (
            f"{checkpoint}: expected the tensors and numbers of a nerfstudio checkpoint, found {refused[1]}, which "
            "could run code when it is loaded; refused"
        )
    return f"{checkpoint}: expected a checkpoint of this method, could not load it: {_line(error)}"


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
