"""A training of Stable-Baselines3 as an MLflow run."""

import atexit
import inspect
import json
import logging
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from typing import Any

import mlflow
import numpy as np
import PIL.Image
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, Image, KVWriter
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.errors import UsageError
from avp_habitat.provenance import flat
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.rollout.images import write_rgb
from avp_habitat.task.trajectory import Trajectory
from avp_habitat.tracking.deliver import recover_in_background
from avp_habitat.tracking.names import CONTINUED_TAG, KIND_TAG, RESUMED_TAG
from avp_habitat.tracking.run import NewRun, Status, TrackedRun, continue_run, join_run, may_continue, start_run
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, about_run, shown
from avp_sb3.callbacks.base import (
    LoggedFile,
    each_once,
    finished_episodes,
    is_learning,
    pool_of,
    scenes_told,
    settings_of,
)

FORMAT = "mlflow"
"""The name by which `logger.record(..., exclude="mlflow")` keeps a value away from MLflow."""
MODEL_FILE, STATISTICS_FILE, PARAMS_FILE = "model.zip", "model_vecnormalize.pkl", "params.json"
TRAJECTORY_FILE = "trajectory.png"
_NOT_HYPERPARAMETERS = {"self", "env", "policy", "verbose", "tensorboard_log", "_init_setup_model"}
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
                continue
            try:
                numbers[key] = float(value)
            except (TypeError, ValueError):
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


def _pixels(value: Image | Figure) -> NDArray[np.uint8] | None:
    """A picture as `(h, w, 3)` bytes; None for one that is not bytes in the order HWC or HW."""
    if isinstance(value, Figure):
        buffer = BytesIO()
        value.figure.savefig(buffer, format="png")
        return np.asarray(PIL.Image.open(buffer).convert("RGB"))
    pixels = np.asarray(value.image)
    if value.dataformats not in ("HWC", "HW") or pixels.dtype != np.uint8:
        return None
    return np.asarray(PIL.Image.fromarray(pixels).convert("RGB"))


class MLflowCallback(BaseCallback):
    """Makes each `learn()` one MLflow run: parameters, everything SB3 logs by environment step, model, last trajectory.

    One line is enough:

        model.learn(300_000, callback=[MetricsCallback(), MLflowCallback()])

    and in rl_zoo3's hyper-parameters `callback: avp_sb3.MLflowCallback`. Nothing waits for MLflow, and what a server
    misses is sent when it is back (docs/tracking.md). `learn(reset_num_timesteps=False)` with a model whose run was
    interrupted goes on in the same run.

    SB3 tells its callbacks nothing when `learn()` is left by an exception or Ctrl-C. To have the run closed at that
    moment and with the right status (FAILED, or KILLED for an interruption), make it a context:

        with MLflowCallback() as mlflow_callback:
            model.learn(300_000, callback=mlflow_callback)

    Without it an unfinished run is closed when the host cleans up (rl_zoo3), at the next `learn()` with this callback,
    by `close()`, or else when Python exits.
    """

    def __init__(
        self,
        experiment: str | None = None,
        run_name: str | None = None,
        tracking_uri: str | None = None,
        *,
        run_id: str | None = None,
        log_model: bool = True,
        checkpoint_s: float = 30.0,
        offline: bool | None = None,
        params: Mapping[str, Any] | None = None,
        tags: Mapping[str, str] | None = None,
        verbose: int = 1,
    ) -> None:
        """Describe the run; nothing is contacted before the training starts.

        Args:
            experiment: made when it does not exist; when omitted, what MLflow's functions or variables say, else `avp`.
                Not used within an active run.
            run_name: when omitted, algorithm, reward, scene and seed.
            tracking_uri: when omitted, what MLflow's functions or variables say, else `sqlite:///mlflow.db`.
            run_id: go on with this run; when omitted, with the model's own if it was interrupted.
            log_model: keep the model (with the statistics of `VecNormalize`) as artifact `model.zip`, on the way and at
                the end unless the training failed.
            checkpoint_s: seconds between two models that are kept on the way, each in place of the one before.
            offline: True goes on when the server does not answer at the start, and sends everything later; when
                omitted, as the variable `AVP_MLFLOW_OFFLINE` says.
            params: further parameters; nested mappings become dotted names.
            tags: further tags.
            verbose: 1 prints at the end which run it was and how to look at it, 2 also at the start; 0 prints nothing.

        Raises:
            UsageError: a number that cannot be right.
        """
        super().__init__(verbose)
        if not checkpoint_s > 0:
            raise UsageError(f"MLflowCallback checkpoint_s: expected seconds above 0, got {checkpoint_s}")
        self.run_id: str | None = None
        self._new = NewRun(experiment=experiment, name=run_name)
        self._tracking_uri = tracking_uri
        self._wanted_run = run_id
        self._log_model = log_model
        self._checkpoint_s = checkpoint_s
        self._offline = offline
        self._params = dict(params or {})
        self._tags = dict(tags or {})
        self._run: TrackedRun | None = None
        self._writer: MLflowWriter | None = None
        self._saved_at = 0.0
        self._last_episode: tuple[int, Trajectory] | None = None

    def __enter__(self) -> "MLflowCallback":
        """Promise that the run is closed when the block is left."""
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Close a run that is still open with the status that the exception deserves."""
        self.close(_status_of(error))

    def close(self, status: Status = "KILLED") -> None:
        """Send what is left and close the run with this status, if it is still open."""
        if self._run is None:
            return
        run, self._run = self._run, None
        atexit.unregister(self._close_at_exit)
        try:
            if self._writer is not None:
                # What came after the logger's last dump: the last update's losses, or what an interruption cut off.
                pending, excluded = self.logger.name_to_value, self.logger.name_to_excluded
                self._writer.write(pending, excluded, self.model.num_timesteps)
            if status != "FAILED":
                self._save_model(run)
                self._save_trajectory(run)
        except Exception as error:
            status = "FAILED"
            _log.warning("MLflow run %s: closing it went wrong: %r", run.run_id, error)
        finally:
            if self._writer in self.logger.output_formats:
                self.logger.output_formats.remove(self._writer)
            delivered = run.close(status)
            self._remember(run)
            if self.verbose:
                print(about_run(run.run_id, run.address, delivered=delivered), flush=True)

    def _on_training_start(self) -> None:
        self.close("KILLED")
        self._last_episode = None
        earlier = getattr(self.model, "avp_mlflow_run_id", None)
        self._run = run = self._open_run(earlier)
        self._remember(run)
        atexit.register(self._close_at_exit)
        self._log_facts(run, earlier)
        self._writer = MLflowWriter(run)
        self.logger.output_formats.append(self._writer)
        self._saved_at = time.monotonic()
        # The usual case, a store on this machine, is a matter of milliseconds; a slow server is not waited for.
        recover_in_background().join(0.5)
        if self.verbose > 1:
            print(f"MLflow:   run {run.run_id} at {shown(run.address)}", flush=True)

    def _on_rollout_start(self) -> None:
        # Here the model is as it was after its last update, for which the step count stands.
        if self._run is not None and time.monotonic() - self._saved_at >= self._checkpoint_s:
            self._save_model(self._run)
            self._saved_at = time.monotonic()

    def _on_step(self) -> bool:
        for index, info in finished_episodes(self.locals):
            if "avp_trajectory" in info:
                self._last_episode = index, info["avp_trajectory"]
        return True

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this once more in a `finally`, whatever ended `learn()`.
        self.close("FINISHED" if is_learning(self.model) else _status_of(sys.exc_info()[1]))

    def _open_run(self, earlier: str | None) -> TrackedRun:
        """The active run, the one to go on with, or a new one; `earlier` trained the model so far."""
        active = mlflow.active_run()
        configured = mlflow.get_tracking_uri() if active or mlflow.is_tracking_uri_set() else DEFAULT_ADDRESS
        address = self._tracking_uri or configured
        if active is not None:
            if address != configured:
                kept = f"the active MLflow run {active.info.run_id} is kept at {configured}"
                raise UsageError(f"tracking_uri {address}: {kept}; end that run or leave tracking_uri out")
            return join_run(address, active.info.run_id)
        if self._wanted_run is not None:
            return continue_run(address, self._wanted_run, offline=self._offline)
        if earlier is not None and self.model.num_timesteps > 0 and may_continue(address, earlier):
            return continue_run(address, earlier, offline=self._offline)
        name = self._new.name or run_name(self.model, self.training_env)
        return start_run(address, replace(self._new, name=name), offline=self._offline)

    def _remember(self, run: TrackedRun) -> None:
        """Keep the run's id, also within the model's .zip, so that a rollout can name the run of its policy."""
        self.run_id = run.run_id
        self.model.avp_mlflow_run_id = run.run_id  # type: ignore[attr-defined]

    def _log_facts(self, run: TrackedRun, earlier: str | None) -> None:
        env = self.training_env
        params = hyperparameters(self.model) | _task_facts(env) | flat(self._params)
        scenes = {"avp.scene": scenes_told(env)}
        if pool_of(env) is None:
            scenes["avp.scene_digest"] = each_once(env, "scene_digest")
        tags = {KIND_TAG: "training"} | {tag: ", ".join(values) for tag, values in scenes.items() if values}
        steps = self.model.num_timesteps
        if earlier is not None and earlier != run.run_id:
            tags[CONTINUED_TAG] = earlier
        elif steps > 0:
            tags[RESUMED_TAG] = str(steps)
        run.params(params)
        run.tags(tags | self._tags)
        # MLflow keeps parameters as texts; here they are numbers, lists and truth values.
        text = json.dumps(params, indent=1, default=str) + "\n"
        run.save(PARAMS_FILE, lambda file: file.write_text(text, encoding="utf-8"))

    def _save_model(self, run: TrackedRun) -> None:
        if self._log_model:
            if (normalised := self.model.get_vec_normalize_env()) is not None:
                run.save(STATISTICS_FILE, lambda file: normalised.save(str(file)))
            run.save(MODEL_FILE, self.model.save)

    def _save_trajectory(self, run: TrackedRun) -> None:
        if self._last_episode is not None and self.training_env.has_attr("area"):
            index, trajectory = self._last_episode
            picture = draw_trajectory(self.training_env.get_attr("area", index)[0], trajectory)
            run.save(TRAJECTORY_FILE, lambda file: write_rgb(file, picture))

    def _close_at_exit(self) -> None:
        self.close(_status_of(getattr(sys, "last_value", None)))


def _status_of(error: BaseException | None) -> Status:
    interrupted = error is None or isinstance(error, (KeyboardInterrupt, SystemExit))
    return "KILLED" if interrupted else "FAILED"


def hyperparameters(model: BaseAlgorithm) -> dict[str, Any]:
    """The arguments of the algorithm's constructor with the values in use, flat, plus `algo`, `policy`, `n_envs`.

    A constant schedule is its number; a changing one reads `start -> end`.
    """
    facts: dict[str, Any] = {
        "algo": type(model).__name__,
        "policy": model.policy_class.__name__,
        "n_envs": model.n_envs,
        "total_timesteps": model._total_timesteps,
    }
    for name in inspect.signature(type(model).__init__).parameters:
        if name not in _NOT_HYPERPARAMETERS and hasattr(model, name):
            facts[name] = _plain(getattr(model, name))
    return flat(facts)


def _task_facts(env: VecEnv) -> dict[str, Any]:
    """`env.*`: the settings of the first environment, flat, and its gymnasium id."""
    settings = settings_of(env)
    facts = {} if settings is None else settings.facts()
    spec = env.get_attr("spec", 0)[0] if env.has_attr("spec") else None
    if spec is not None:
        facts["id"] = spec.id
    return flat({"env": facts})


def run_name(model: BaseAlgorithm, env: VecEnv) -> str:
    """Algorithm, reward, scene and seed, as far as there are any: `ppo proposed builtin:0 seed 0`.

    MLflow would draw a name at random, the same one after each training with the same seed.
    """
    task, scenes = _task_facts(env), scenes_told(env)
    words = [type(model).__name__.lower(), task.get("env.reward"), scenes[0] if scenes else task.get("env.id")]
    words += [f"and {len(scenes) - 1} more"] if len(scenes) > 1 else []
    words += [] if model.seed is None else [f"seed {model.seed}"]
    return " ".join(str(word) for word in words if word is not None)


def _plain(value: Any) -> Any:
    """A value whose text says what it is, without memory addresses."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, type) or not callable(value):
        return getattr(value, "__name__", value)
    try:
        start, end = (float(value(progress)) for progress in (1.0, 0.0))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return getattr(value, "__name__", type(value).__name__)
    return start if start == end else f"{start:g} -> {end:g}"
