"""One reconstruction from an open folder to its scores: nerfstudio trains, then renders and scores in this process.

Importing it imports and compiles everything heavy, so that a program with many reconstructions can do so once and fork:

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["avp_nerfstudio.method.reconstruction"])

Set `OMP_NUM_THREADS=1` before the first fork: torch's threads do not survive one, and none is started while importing.
"""

import contextlib
import copy
import io
import json
import math
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

# nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
import nerfstudio.scripts.train  # isort: skip
import nerfstudio.scripts.eval  # isort: skip
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer

from avp_habitat.command import progress
from avp_habitat.provenance import git_commit, installed_versions
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import write_rgb
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.simulators.base import Simulator
from avp_habitat.tracking.stores import TrackingError
from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.method.config import trainer_config
from avp_nerfstudio.method.hash_encoding import compile_hash_encodings, compile_loops
from avp_nerfstudio.method.scores import heldout_count, mean_scores, optional_lpips, render_views, to_8_bit
from avp_nerfstudio.method.shape import model_figures
from avp_nerfstudio.tracking import facts_of, open_again

if TYPE_CHECKING:
    from avp_nerfstudio.reconstruct import Reconstruct

_NEVER = 1 << 40
_OUTPUTS = "nerfstudio"
_PACKAGES = ("avp-suite", "nerfstudio", "torch", "torchvision", "torchmetrics", "numpy", "numba", "tinycudann")


def process(
    options: "Reconstruct",
    rollout: Rollout,
    folder: Path,
    scene: Simulator | None,
    *,
    started: float,
    address: str | None,
) -> dict[str, Any]:
    """Train, score, and write everything of the folder, which becomes `options.out`; gives what `scores.json` holds.

    The shape is measured in the scene, where one is given.

    Raises:
        RolloutError: nerfstudio cannot use the rollout.
    """
    config = _configuration(options, rollout, folder.resolve() / _OUTPUTS)
    # Of nerfstudio's many lines none is for the screen; bars and warnings go to the other stream.
    with contextlib.redirect_stdout(io.StringIO()):
        trainer = _set_up(config, keep_checkpoint=options.keep_checkpoint)
        ready = time.monotonic()
        with progress(total=config.max_num_iterations, desc="training", unit="iteration", smoothing=0.05) as bar:
            trainer.callbacks.append(
                TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: bar.update())
            )
            # Not the suite's own train(), which keeps an interrupted training and says how to go on with it.
            Trainer.train(trainer)
        trained = time.monotonic()
        views = _score(trainer.pipeline, folder, options.pictures)
        shape = {} if scene is None else model_figures(trainer.pipeline, rollout, scene)
    scored = time.monotonic()
    count = len(rollout.frames) if options.frames is None else options.frames
    seen = visibility_of(rollout.frames[:count], rollout.heldout, rollout.intrinsics)
    found: dict[str, Any] = {
        "format": "avp-reconstruction",
        "format_version": 1,
        "rollout": str(options.rollout),
        "method": options.method,
        "depth": options.depth and options.method == "avp-nerfacto",
        "iterations": config.max_num_iterations,
        "frames": count,
        "seed": options.seed,
        "scores": mean_scores([scores for _, scores in views]),
        "geometry": shape,
        "lpips_reason": getattr(trainer.pipeline.model.lpips, "reason", None),
        "per_view": [{"name": name, **scores} for name, scores in views],
        "visibility": {**seen.figures(), "per_view": seen.per_view().tolist()},
        "seconds": {"start": ready - started, "train": trained - ready, "score": scored - trained},
        "device": str(trainer.device),
        "threads": torch.get_num_threads(),
        "versions": installed_versions(_PACKAGES),
        "commit": git_commit(),
    }
    if options.keep_checkpoint:
        found["config"] = _keep(config, folder, options.out)
    else:
        shutil.rmtree(folder / _OUTPUTS)
    found = _finite(found)
    (folder / "scores.json").write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if address is not None:
        _track(address, config, folder, found)
    return found


def _configuration(options: "Reconstruct", rollout: Rollout, outputs: Path) -> Any:
    """The `TrainerConfig` of a training that writes to a folder `outputs`."""
    config: Any = trainer_config() if options.method == "avp-nerfacto" else _nerfacto()
    manager = config.pipeline.datamanager
    if options.method == "avp-nerfacto":
        config.pipeline.model.use_depth = options.depth
    config.data = manager.data = manager.dataparser.data = rollout.folder.resolve()
    if options.frames is not None and options.frames < len(rollout.frames):
        manager.dataparser.max_views = options.frames
    config.output_dir, config.experiment_name, config.timestamp = outputs, config.data.name, "run"
    config.machine.seed = options.seed
    if options.iterations is not None:
        config.max_num_iterations = options.iterations
    config.vis = "none"
    config.logging.local_writer.enable, config.logging.profiler = False, "none"
    # Views are scored once, at the end; a checkpoint, where it is wanted, is written then too.
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = _NEVER
    if hasattr(config, "mlflow"):
        config.mlflow = "off"
    return config


def _nerfacto() -> Any:
    """Nerfstudio's own settings, with `avp-data`."""
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


def _set_up(config: Any, *, keep_checkpoint: bool) -> Any:
    """Nerfstudio's trainer, ready to train."""
    # nerfstudio keeps its writers for the life of a process: none of an earlier run may get this run's events.
    for kept in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
        kept.clear()
    nerfstudio.scripts.train._set_random_seed(config.machine.seed)
    config.get_base_dir().mkdir(parents=True)
    trainer = config.setup(local_rank=0, world_size=1)
    with optional_lpips():  # nerfacto would end without a network for LPIPS's weights
        trainer.setup(test_mode="test")
    if not keep_checkpoint:
        trainer.save_checkpoint = lambda step: None
    return trainer


def _score(pipeline: Any, folder: Path, pictures: tuple[int, ...]) -> list[tuple[str, dict[str, float]]]:
    """Name and scores of each held-out view."""
    pipeline.eval()
    # What ns-eval has after loading a checkpoint, which does not hold how far a short training has annealed.
    pipeline.model.proposal_sampler.set_anneal(1.0)
    # The compiled encoding gives the same colours several times as fast; on other devices it changes nothing.
    compile_hash_encodings(pipeline.model)
    views = []
    for view in progress(render_views(pipeline), total=heldout_count(pipeline), unit="view", desc="scoring"):
        scores = dict(view.scores)
        if math.isnan(scores.get("lpips", 0.0)):
            del scores["lpips"]
        views.append((view.name, scores))
        if view.index in pictures:
            (folder / "pictures").mkdir(exist_ok=True)
            for kind, picture in (("truth", view.truth), ("render", view.render)):
                write_rgb(folder / "pictures" / f"{kind}_{view.index:05d}.png", to_8_bit(picture))
    return views


def _keep(config: Any, folder: Path, final: Path) -> str:
    """Write `config.yml` as it is to be read where the folder goes; gives its path within the folder."""
    path = config.get_base_dir() / "config.yml"
    config.output_dir = final.resolve() / _OUTPUTS
    path.write_text(yaml.dump(config), encoding="utf-8")
    return str(path.relative_to(folder.resolve()))


def _track(address: str, config: Any, folder: Path, found: Mapping[str, Any]) -> None:
    """Log settings and scores; a store that fails is a warning, because the scores are there."""
    try:
        run, _ = open_again(address, facts_of(config), folder=folder)
        seen = {name: share for name, share in found["visibility"].items() if name != "per_view"}
        values = {**found["scores"], **found["geometry"], **seen}
        run.metrics({f"eval/{name}": v for name, v in values.items() if v is not None}, found["iterations"])
        run.close("FINISHED")
    except TrackingError as error:
        print(f"warning: {error}; the scores are written, not logged", file=sys.stderr)


def _finite(value: Any) -> Any:
    """A tree of values with None for NaN and infinity, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


compile_loops()
