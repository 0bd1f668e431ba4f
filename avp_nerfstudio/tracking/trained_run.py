"""A training of nerfstudio found again by its config.yml: settings, newest checkpoint, pipeline.

nerfstudio keeps its settings as YAML that names Python objects, which reading it creates: a config.yml is trusted like
a program, so open only those of your own trainings. The checkpoint beside it is read with torch's safe loader.
"""

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.errors import AVPError

_STEP = re.compile(r"step-(\d+)\.ckpt")


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


def config_path(path: Path) -> Path:
    """The config.yml that a path means: itself, or that inside a training's or a reconstruction's folder.

    Raises:
        TrainedRunError: there is none.
    """
    if path.is_dir():
        inside = path / "config.yml"
        path = inside if inside.is_file() else path / (_kept_by_reconstruction(path) or inside.name)
    if not path.is_file():
        raise TrainedRunError(f"{path}: expected the config.yml that ns-train wrote, found none")
    return path


def _kept_by_reconstruction(folder: Path) -> str | None:
    """Where `avp_nerfstudio.reconstruct --keep-checkpoint` left the config within its folder.

    Raises:
        TrainedRunError: the folder is a reconstruction's that has kept none.
    """
    try:
        config = json.loads((folder / "scores.json").read_text(encoding="utf-8")).get("config")
    except (OSError, ValueError, AttributeError):
        return None
    if not isinstance(config, str) or not Path(os.path.abspath(folder / config)).is_relative_to(
        os.path.abspath(folder)
    ):
        raise TrainedRunError(f"{folder}: kept no checkpoint; reconstruct with --keep-checkpoint to open it again")
    return config


def read_config(path: Path) -> Any:
    """Nerfstudio's `TrainerConfig`, which finds its checkpoints beside the file wherever the folder has moved to.

    Raises:
        TrainedRunError: the file is not what ns-train writes, or its method is not installed.
    """
    import yaml
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.engine.trainer import TrainerConfig

    try:
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
    except Exception as error:
        line = " ".join(str(error).split())
        raise TrainedRunError(
            f"{path}: expected the config.yml that ns-train wrote, could not read it: {line}"
        ) from None
    if not isinstance(config, TrainerConfig):
        raise TrainedRunError(
            f"{path}: expected the config.yml that ns-train wrote, found a {type(config).__name__} instead of settings"
        )
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
        UnsafeCheckpointError: the checkpoint holds more than numbers.
        RolloutError: the rollout it was trained on cannot be used.
    """
    import torch
    from nerfstudio.utils.eval_utils import eval_load_checkpoint

    import avp_nerfstudio.plugin  # noqa: F401  allows the types in nerfstudio's checkpoints

    checkpoint, step = newest_checkpoint(config.get_checkpoint_dir())
    config.load_dir, config.load_step = checkpoint.parent, step
    try:
        pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode="test")
    except OSError as error:  # data that has gone, or LPIPS weights that cannot be downloaded
        raise TrainedRunError(f"{checkpoint.parent.parent}: what it was trained with cannot be had: {error}") from error
    pipeline.eval()
    try:
        eval_load_checkpoint(config, pipeline)
    except AVPError:  # it holds what the safe loader refuses
        raise
    except Exception as error:
        raise TrainedRunError(loading_fault(checkpoint, error)) from error
    return TrainedRun(config, pipeline, checkpoint, step)


def loading_fault(checkpoint: Path, error: Exception) -> str:
    """One line on why a checkpoint could not be loaded."""
    line = " ".join(str(error).split())
    return f"{checkpoint}: expected a checkpoint of this method, could not load it: {line or type(error).__name__}"
