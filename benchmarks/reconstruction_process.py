"""One reconstruction in a process of its own: trained for so long, scored on all held-out views; by reconstruction.py.

nerfstudio's own trainer trains. With a limit in seconds, the learning rates follow the clock: they have fallen to
their last value when the time is up, whatever the speed of the method. Importing, loading and saving do not count.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from avp_habitat import command

_UNLIMITED = 10**7
_FIRST_ESTIMATE = 50


class TimeIsUp(Exception):
    """Ends nerfstudio's training loop, which has no other way out."""


class Clock:
    """Ends a training in time and makes the learning rates fall with it."""

    def __init__(self, config: Any, seconds: float, iterations: int) -> None:
        """Watch a training.

        Args:
            config: nerfstudio's `TrainerConfig`, whose schedules are to be stretched.
            seconds: to train; 0 for no limit.
            iterations: to train; 0 for no limit.
        """
        self._config, self._limit, self._iterations = config, seconds, iterations
        self._began = time.monotonic()
        self.done, self.seconds, self.loss = 0, 0.0, []

    def tick(self, step: int) -> None:
        """After an iteration.

        Raises:
            TimeIsUp: this was the last.
        """
        self.done, self.seconds = step + 1, time.monotonic() - self._began
        if self._limit and self.done >= _FIRST_ESTIMATE:
            stretch(self._config, max(self.done, round(self.done * self._limit / self.seconds)))
        if (self._limit and self.seconds >= self._limit) or self.done == self._iterations:
            raise TimeIsUp


def stretch(config: Any, iterations: int) -> None:
    """Let the learning rates of all groups fall over so many iterations."""
    for group in config.optimizers.values():
        if group["scheduler"] is not None and hasattr(group["scheduler"], "max_steps"):
            group["scheduler"].max_steps = iterations


def avp_nerfacto(config: Any) -> None:
    """The suite's method as it is."""


def avp_nerfacto_rgb(config: Any) -> None:
    """The suite's method without depth."""
    config.pipeline.model.use_depth = False


def avp_nerfacto_uncarved(config: Any) -> None:
    """The suite's method with depth in the loss only."""
    config.pipeline.model.carving_voxel_m = 0.0


def avp_nerfacto_view_dependent(config: Any) -> None:
    """The suite's method with colours that change with the viewing direction."""
    config.pipeline.model.view_dependent = True


def nerfacto_defaults(config: Any) -> None:
    """Nerfacto as nerfstudio ships it, on a CPU."""


def nerfacto_small(config: Any) -> None:
    """Nerfacto with samples, levels and tables that a CPU can bear, exact poses, the room inside the contraction."""
    _small(config)
    config.pipeline.datamanager.dataparser.scale = 0.2


def nerfacto_tiny(config: Any) -> None:
    """Smaller still, without contraction, between near and far planes that fit the room: the most iterations."""
    _small(config)
    model = config.pipeline.model
    model.num_proposal_iterations, model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = 1, (64,), 16
    model.num_levels, model.log2_hashmap_size, model.max_res = 8, 16, 512
    model.disable_scene_contraction = True
    model.proposal_initial_sampler = "uniform"
    model.near_plane, model.far_plane = 0.1, 8.0


def depth_nerfacto_small(config: Any) -> None:
    """Nerfstudio's own method with depth, as small as `nerfacto_small`."""
    nerfacto_small(config)
    config.pipeline.model.depth_loss_mult = 0.01
    config.pipeline.model.depth_sigma = 0.01


def _small(config: Any) -> None:
    config.pipeline.datamanager.train_num_rays_per_batch = 512
    model = config.pipeline.model
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (64, 32), 24
    model.num_levels, model.log2_hashmap_size = 12, 17
    model.camera_optimizer.mode = "off"
    config.optimizers.pop("camera_opt", None)


WAYS: dict[str, tuple[str, Callable[[Any], None]]] = {
    "avp-nerfacto": ("avp-nerfacto", avp_nerfacto),
    "avp-nerfacto-rgb": ("avp-nerfacto", avp_nerfacto_rgb),
    "avp-nerfacto-uncarved": ("avp-nerfacto", avp_nerfacto_uncarved),
    "avp-nerfacto-view-dependent": ("avp-nerfacto", avp_nerfacto_view_dependent),
    "nerfacto-small": ("nerfacto", nerfacto_small),
    "nerfacto-tiny": ("nerfacto", nerfacto_tiny),
    "depth-nerfacto-small": ("depth-nerfacto", depth_nerfacto_small),
    "nerfacto-defaults": ("nerfacto", nerfacto_defaults),
}
"""nerfstudio's method behind each way, and what is changed of its configuration."""


def _config(way: str, data: Path, output: Path) -> Any:
    import torch
    from nerfstudio.configs.method_configs import all_methods

    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    method, change = WAYS[way]
    config = all_methods[method]
    cuda = torch.cuda.is_available()
    if method != "avp-nerfacto":
        config.pipeline.datamanager.dataparser = AVPDataParserConfig()
        if not cuda:
            config.machine.device_type, config.mixed_precision = "cpu", False
            config.pipeline.model.implementation = "torch"
    change(config)
    config.data = config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = data
    config.output_dir, config.vis, config.max_num_iterations = output, "tensorboard", _UNLIMITED
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = _UNLIMITED
    config.logging.local_writer.enable = True
    config.logging.steps_per_log = 200
    return config


def _train(config: Any, clock_of: Callable[[], Clock]) -> tuple[Any, Clock]:
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    from avp_nerfstudio.method.scores import optional_lpips

    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    with optional_lpips():  # nerfstudio's own methods would ask the network for LPIPS's weights
        trainer.setup(test_mode="test")
    clock = clock_of()
    trainer.callbacks.append(
        TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: clock.tick(step))
    )
    try:
        trainer.train()
    except TimeIsUp:
        trainer.save_checkpoint(clock.done - 1)
        config.save_config()
    return trainer, clock


def _score(trainer: Any, pictures: Path, views: Sequence[int], every: int) -> list[dict[str, Any]]:
    from avp_habitat.rollout.images import write_rgb
    from avp_nerfstudio.method.hash_encoding import compile_hash_encodings
    from avp_nerfstudio.method.scores import render_views, to_8_bit

    trainer.pipeline.eval()
    # The compiled encoding gives the same colours (a test holds it to that), several times as fast.
    compile_hash_encodings(trainer.pipeline.model)
    loader = trainer.pipeline.datamanager.fixed_indices_eval_dataloader
    loader.image_indices = loader.image_indices[::every]
    rows = []
    for view in render_views(trainer.pipeline):
        rows.append({"view": view.index, **view.scores, "seconds": view.seconds})
        print(f"view {view.index}: {view.scores['psnr']:.2f} dB in {view.seconds:.0f} s", flush=True)
        if view.index in views:
            pictures.mkdir(parents=True, exist_ok=True)
            write_rgb(pictures / f"view_{view.index:02d}.png", to_8_bit(view.render))
            write_rgb(pictures / f"truth_{view.index:02d}.png", to_8_bit(view.truth))
    return rows


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = made.add_argument
    add("--way", required=True, choices=list(WAYS), help="method and settings")
    add("--data", required=True, type=Path, help="the rollout")
    add("--seconds", default=0.0, type=float, help="time to train; 0 for no limit")
    add("--iterations", default=0, type=int, help="iterations to train; 0 for no limit")
    add("--score-every", default=1, type=int, help="score every n-th held-out view only")
    add("--pictures", nargs="*", default=[], type=int, help="held-out views to keep as pictures")
    add("--output", required=True, type=Path, help="folder of the training; result.json and pictures go there")
    return made


def main(argv: Sequence[str]) -> None:
    """Train, score, write result.json."""
    options = _parser().parse_args(argv)
    # nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
    import nerfstudio.scripts.train  # noqa: F401
    import numpy as np
    import torch

    torch.manual_seed(0)
    np.random.seed(0)
    config = _config(options.way, options.data, options.output)
    trainer, clock = _train(config, lambda: Clock(config, options.seconds, options.iterations))
    rows = _score(trainer, options.output / "pictures", options.pictures, options.score_every)
    names = [name for name in rows[0] if name not in ("view", "seconds")]
    result = {
        "iterations": clock.done,
        "train_seconds": clock.seconds,
        "rays_per_batch": config.pipeline.datamanager.train_num_rays_per_batch,
        "score_seconds": sum(row["seconds"] for row in rows),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "device": str(trainer.device),
        "mean": {name: float(np.mean([row[name] for row in rows])) for name in names},
        "views": rows,
    }
    (options.output / "result.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(command.run(main))
