"""nerfstudio's settings of one reconstruction: the method's own, with nothing that follows or shows the training."""

import copy
from pathlib import Path
from typing import Any

# nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
import nerfstudio.scripts.train  # noqa: F401
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager

from avp_nerfstudio.config import trainer_config
from avp_nerfstudio.dataparser import AVPDataParserConfig

_NEVER = 1 << 40


def configure(method: str, data: Path, outputs: Path, *, max_views: int, iterations: int | None, seed: int) -> Any:
    """The `TrainerConfig` of a training.

    Args:
        method: `avp-nerfacto`, or `nerfacto` with nerfstudio's own settings and `avp-data`.
        data: the rollout's folder.
        outputs: nerfstudio's folder for outputs.
        max_views: train on the first so many captured frames; 0 for all.
        iterations: of the training; None for the method's own number.
        seed: of nerfstudio's random numbers.
    """
    config: Any = trainer_config() if method == "avp-nerfacto" else _nerfacto()
    manager = config.pipeline.datamanager
    config.data = manager.data = manager.dataparser.data = data
    manager.dataparser.max_views = max_views
    config.output_dir, config.experiment_name, config.timestamp = outputs, data.name, "run"
    config.machine.seed = seed
    if iterations is not None:
        config.max_num_iterations = iterations
    config.vis = "none"
    config.logging.local_writer.enable, config.logging.profiler = False, "none"
    # Views are scored once, at the end; a checkpoint, where it is wanted, is written then too.
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = _NEVER
    if hasattr(config, "mlflow"):
        config.mlflow = "off"
    return config


def _nerfacto() -> Any:
    config = copy.deepcopy(all_methods["nerfacto"])
    manager = config.pipeline.datamanager
    manager.dataparser = AVPDataParserConfig()
    # The same rays, drawn in this process: nerfstudio's own process for them is not given the seed, imports everything
    # again, and may not be started by workers of a pool.
    manager._target = VanillaDataManager
    if not torch.cuda.is_available():
        config.machine.device_type, config.mixed_precision = "cpu", False
        config.pipeline.model.implementation = "torch"
    return config
