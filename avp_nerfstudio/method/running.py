"""What a dataparser can find out about the command of nerfstudio that it runs in, and say when that must fail.

nerfstudio 1.1.5 tells a dataparser its own options only. Which device is to be used, where results go and which
config.yml was loaded stand in the functions that are calling it.
"""

import contextlib
import shlex
import sys
import traceback
from pathlib import Path
from typing import Any

import torch

from avp_habitat.errors import AVPError, RolloutError
from avp_habitat.gpu import WITHOUT_GPU

_OUTPUTS = Path("outputs")
_LOADING = ("eval_setup", "open_trained")


class DeviceError(AVPError):
    """A training for a device that is not there."""


def _training() -> Any:
    """The `TrainerConfig` of the training that is being set up; None outside of one."""
    from nerfstudio.engine.trainer import Trainer

    for frame, _ in traceback.walk_stack(None):
        if isinstance(found := frame.f_locals.get("self"), Trainer):
            return found.config
    return None


def _loaded() -> tuple[Any, Path] | None:
    """The `TrainerConfig` that is being opened again, and the config.yml that it comes from."""
    for frame, _ in traceback.walk_stack(None):
        if frame.f_code.co_name in _LOADING and "config" in frame.f_locals:
            config = frame.f_locals["config"]
            return config, Path(frame.f_locals.get("config_path") or config.relative_model_dir.parent / "config.yml")
    return None


def check_device(data: Path) -> None:
    """Hold the training that is being set up to the devices that exist, as the driver would with a traceback.

    Args:
        data: the rollout.

    Raises:
        DeviceError: it wants a GPU where there is none; the text has the commands that work here.
    """
    config = _training()
    if config is None or config.machine.device_type != "cuda" or torch.cuda.is_available():
        return
    ours = f"`{shlex.join(['ns-train', 'avp-nerfacto', '--data', str(data)])}`"
    on_cpu = ""
    if hasattr(config.pipeline.model, "implementation"):  # the others need compiled CUDA code
        words = _words_on_cpu(str(config.method_name), data)
        on_cpu = f", or (seconds per iteration) `{shlex.join(['ns-train', *words])}`"
    raise DeviceError(
        f"{config.method_name} trains on a GPU by default, and none was found here (torch {torch.__version__} is built "
        f"for CUDA {torch.version.cuda}); use {ours}, made for this machine{on_cpu}"
    )


def _words_on_cpu(method: str, data: Path) -> list[str]:
    """The words after `ns-train`, with those for a CPU: as they were typed, if it is `ns-train` that is running."""
    options, words = WITHOUT_GPU.split(), sys.argv[1:]
    if method not in words or any(option.strip("-") in word for option in options[::2] for word in words):
        return [method, *options, "avp-data", "--data", str(data)]
    after = words.index(method) + 1
    return [*words[:after], *options, *words[after:]]


def check_is_there(path: Path) -> None:
    """Hold a rollout to being where it is looked for, and say where that is.

    Raises:
        RolloutError: there is none; of a training that is opened again, its checkpoints are held to the same.
    """
    loaded, here = _loaded(), Path.cwd()
    if path.exists():
        if loaded is not None and not loaded[0].get_checkpoint_dir().is_dir():
            checkpoints = loaded[0].get_checkpoint_dir()
            raise RolloutError(f"{checkpoints}: expected the checkpoints of {_elsewhere(checkpoints, *loaded)}")
        return
    if loaded is not None:
        raise RolloutError(f"{path}: expected the rollout of {_elsewhere(path, *loaded)}")
    where = "" if path.is_absolute() else f"; the path is relative to {here}"
    raise RolloutError(
        f"{path}: expected a rollout folder (made by `python -m avp_habitat.collect`), found none{where}"
    )


def _elsewhere(path: Path, config: Any, config_path: Path) -> str:
    """The rest of the sentence about what a config.yml names and is not there."""
    link = f"put it there again, or a link (ln -s WHERE_IT_LIES {shlex.quote(str(path))})"
    if path.is_absolute():
        return f"{config_path}, found none; {link}"
    relative = f"{config_path}, found none: the path is relative to the folder in which ns-train ran, now {Path.cwd()}"
    base, folder = config.get_base_dir(), config_path.resolve().parent
    if not base.is_absolute() and folder.parts[-len(base.parts) :] == base.parts:
        trained_in = folder.parents[len(base.parts) - 1]
        if (trained_in / path).exists():
            return f"{relative}; run this command in {shlex.quote(str(trained_in))}"
    return f"{relative}; if it was moved, {link}"


def discard_outputs(config: Any = None) -> None:
    """Remove the folder that `ns-train` made for a training that cannot start, if there is nothing but its settings.

    Args:
        config: the training's `TrainerConfig`; by default that of the training that is being set up, if any.
    """
    config = config or _training()
    if config is None:
        return
    base = config.get_base_dir()
    with contextlib.suppress(OSError):
        if [path.name for path in base.iterdir()] != ["config.yml"]:
            return
        (base / "config.yml").unlink()
        base.rmdir()
        # Those above may hold other trainings; `outputs` is nerfstudio's, any other name the user's own folder.
        for folder in base.parents[: len(base.parts) - len(config.output_dir.parts) - 1]:
            folder.rmdir()
        if config.output_dir == _OUTPUTS:
            config.output_dir.rmdir()
