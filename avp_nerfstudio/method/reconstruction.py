"""One reconstruction from an open folder to its scores: nerfstudio trains, then renders and scores in this process."""

import contextlib
import copy
import io
import json
import math
import random
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import nerfstudio.scripts.train  # noqa: F401
import numpy as np
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from tqdm import tqdm

from avp_habitat.command import INTERRUPTED
from avp_habitat.files import NewFolder
from avp_habitat.provenance import git_commit, installed_versions
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import write_rgb
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.tracking.stores import TrackingError
from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.data.heldout import HeldoutView, heldout_count, mean_scores, render_views, to_8_bit
from avp_nerfstudio.method.config import trainer_config
from avp_nerfstudio.method.hash_encoding import compile_hash_encodings
from avp_nerfstudio.method.progress import TrainingProgress
from avp_nerfstudio.method.scores import optional_lpips
from avp_nerfstudio.tracking.facts import facts_of
from avp_nerfstudio.tracking.mlflow import open_again

if TYPE_CHECKING:
    from avp_nerfstudio.reconstruct import Request


# nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.


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


# nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.


FORMAT = "avp-reconstruction"
FORMAT_VERSION = 1
SCORES = "scores.json"
_OUTPUTS = "nerfstudio"
_PACKAGES = ("avp-suite", "nerfstudio", "torch", "torchvision", "torchmetrics", "numpy", "numba", "tinycudann")


def process(request: "Request", rollout: Rollout, folder: NewFolder, *, started: float) -> dict[str, Any]:
    """Train, score, and write everything of the folder.

    Args:
        request: whose options are right.
        rollout: the one it names, as read.
        folder: open.
        started: `time.monotonic()` when the work began.

    Returns:
        What `scores.json` holds.

    Raises:
        RolloutError: nerfstudio cannot use the rollout.
    """
    count = len(rollout.frames) if request.frames is None else request.frames
    config = configure(
        request.method,
        rollout.folder.resolve(),
        folder.path(_OUTPUTS).resolve(),
        max_views=count if count < len(rollout.frames) else 0,
        iterations=request.iterations,
        seed=request.seed,
    )
    with _quiet():
        trainer = _setup(config, keep_checkpoint=request.keep_checkpoint)
        ready = time.monotonic()
        _train(trainer)
        trained = time.monotonic()
        views = _score(trainer.pipeline, folder, request.pictures)
    scored = time.monotonic()
    found: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "rollout": str(request.rollout),
        "method": request.method,
        "iterations": config.max_num_iterations,
        "frames": count,
        "seed": request.seed,
        "scores": _finite(mean_scores([scores for _, scores in views])),
        "lpips_reason": getattr(trainer.pipeline.model.lpips, "reason", None),
        "per_view": [{"name": name, **_finite(scores)} for name, scores in views],
        "visibility": _visibility(rollout, count),
        "seconds": {"start": ready - started, "train": trained - ready, "score": scored - trained},
        "device": str(trainer.device),
        "threads": torch.get_num_threads(),
        "versions": installed_versions(_PACKAGES),
        "commit": git_commit(),
    }
    if request.keep_checkpoint:
        found["config"] = str(_keep(config, folder).relative_to(folder.path("").resolve()))
    else:
        shutil.rmtree(folder.path(_OUTPUTS))
    folder.path(SCORES).write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if request.mlflow:
        _track(request.mlflow, config, folder, found)
    return found


def _setup(config: Any, *, keep_checkpoint: bool) -> Any:
    """Nerfstudio's trainer, ready to train."""
    # nerfstudio keeps its writers for the life of a process: none of an earlier run may get this run's events.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    seed = config.machine.seed
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    config.get_base_dir().mkdir(parents=True)
    trainer = config.setup(local_rank=0, world_size=1)
    with optional_lpips(), _as_interruption():  # nerfacto would end without a network for LPIPS's weights
        trainer.setup(test_mode="test")
    if not keep_checkpoint:
        trainer.save_checkpoint = lambda step: None
    return trainer


def _train(trainer: Any) -> None:
    progress = TrainingProgress(trainer.config.max_num_iterations)
    trainer.callbacks.append(
        TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: progress.update({}))
    )
    try:
        # Not the suite's own train(), which keeps an interrupted training and says how to go on with it.
        Trainer.train(trainer)
    finally:
        progress.close()


def _score(pipeline: Any, folder: NewFolder, pictures: Sequence[int]) -> list[tuple[str, dict[str, float]]]:
    """Name and scores of each held-out view."""
    pipeline.eval()
    # What ns-eval has after loading a checkpoint, which does not hold how far a short training has annealed.
    pipeline.model.proposal_sampler.set_anneal(1.0)
    # The compiled encoding gives the same colours several times as fast; on other devices it changes nothing.
    compile_hash_encodings(pipeline.model)
    views = []
    with tqdm(total=heldout_count(pipeline), unit="view", desc="scoring", disable=None) as progress:
        for view in render_views(pipeline):
            views.append((view.name, {name: value for name, value in view.scores.items() if not _absent(name, value)}))
            if view.index in pictures:
                _write_pictures(folder.path("pictures"), view)
            progress.update()
    return views


def _absent(name: str, value: float) -> bool:
    return name == "lpips" and math.isnan(value)


def _write_pictures(folder: Path, view: HeldoutView) -> None:
    folder.mkdir(exist_ok=True)
    for kind, picture in (("truth", view.truth), ("render", view.render)):
        write_rgb(folder / f"{kind}_{view.index:05d}.png", to_8_bit(picture))


def _visibility(rollout: Rollout, frames: int) -> dict[str, Any]:
    """Figures of the first so many frames, and the share seen of each held-out view."""
    seen = visibility_of(rollout.frames[:frames], rollout.heldout, rollout.intrinsics)
    per_view = [value if math.isfinite(value) else None for value in seen.per_view().tolist()]
    return {**seen.figures(), "per_view": per_view}


def _keep(config: Any, folder: NewFolder) -> Path:
    """Write `config.yml` as it is to be read where the folder goes; gives its present path."""
    path = config.get_base_dir() / "config.yml"
    config.output_dir = (folder.folder / _OUTPUTS).resolve()
    path.write_text(yaml.dump(config), encoding="utf-8")
    return path


def _track(address: str, config: Any, folder: NewFolder, found: Mapping[str, Any]) -> None:
    """Log settings and scores; a store that fails is a warning, because the scores are there."""
    try:
        run, _ = open_again(address, facts_of(config), folder=folder.path(""))
        values = {**found["scores"], **{k: v for k, v in found["visibility"].items() if k != "per_view"}}
        run.metrics({f"eval/{name}": v for name, v in values.items() if v is not None}, found["iterations"])
        run.close("FINISHED")
    except TrackingError as error:
        print(f"warning: {error}; the scores are written, not logged", file=sys.stderr)


def _finite(scores: Mapping[str, float]) -> dict[str, float | None]:
    """JSON knows no other numbers."""
    return {name: value if math.isfinite(value) else None for name, value in scores.items()}


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep nerfstudio's many lines from the screen; bars and warnings go to the other stream."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _as_interruption() -> Iterator[None]:
    """Let a Ctrl-C that the suite's trainer has made an exit of be one again."""
    try:
        yield
    except SystemExit as end:
        if end.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        raise
