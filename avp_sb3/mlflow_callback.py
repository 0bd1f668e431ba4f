"""A training of Stable-Baselines3 as an MLflow run."""

import atexit
import os
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import mlflow
from mlflow import MlflowClient
from mlflow.entities import Param, RunTag
from mlflow.tracking.context.registry import resolve_tags
from stable_baselines3.common.callbacks import BaseCallback

from avp_habitat.errors import UsageError
from avp_habitat.provenance import flat, git_commit
from avp_sb3.finished_episodes import finished_episodes
from avp_sb3.mlflow_writer import MLflowWriter, safe_name
from avp_sb3.run_facts import hyperparameters, scene_tags, task_settings, version_tags

if TYPE_CHECKING:
    from avp_habitat.trajectory import Trajectory

Status = Literal["FINISHED", "FAILED", "KILLED"]

DEFAULT_TRACKING_URI = "sqlite:///mlflow.db"
MODEL_FILE = "model.zip"
TRAJECTORY_FILE = "trajectory.png"
_MAX_PARAM = 6000


class _Run:
    """An open run and the way to it."""

    def __init__(self, client: MlflowClient, run_id: str, *, owned: bool) -> None:
        """`owned` runs are closed by us."""
        self.client = client
        self.run_id = run_id
        self.owned = owned
        self.writer = MLflowWriter(client, run_id)


class MLflowCallback(BaseCallback):
    """Makes each `learn()` one MLflow run: parameters, everything SB3 logs by environment step, model, last trajectory.

    One line is enough:

        model.learn(300_000, callback=[MetricsCallback(), MLflowCallback()])

    SB3 tells its callbacks nothing when `learn()` is left by an exception or Ctrl-C. To have the run closed at that
    moment and with the right status (FAILED, or KILLED for an interruption), make it a context:

        with MLflowCallback() as mlflow_callback:
            model.learn(300_000, callback=mlflow_callback)

    Without it an unfinished run is closed when the host cleans up (rl_zoo3), at the next `learn()` with this callback,
    by `close()`, or else when Python exits: FAILED if an exception ended the program, KILLED otherwise.
    """

    def __init__(
        self,
        experiment: str = "avp",
        run_name: str | None = None,
        tracking_uri: str | None = None,
        *,
        log_model: bool = True,
        params: Mapping[str, Any] | None = None,
        tags: Mapping[str, str] | None = None,
        verbose: int = 0,
    ) -> None:
        """Describe the run; nothing is contacted before the training starts.

        Args:
            experiment: MLflow experiment, made when it does not exist. Not used within an active run.
            run_name: name of the run; MLflow invents one when omitted.
            tracking_uri: where runs are kept; when omitted, what `mlflow.set_tracking_uri` or `MLFLOW_TRACKING_URI`
                say, else `sqlite:///mlflow.db` in the current folder.
            log_model: keep the model as artifact `model.zip`, unless the training failed.
            params: further parameters; nested mappings become dotted names.
            tags: further tags.
            verbose: 1 prints where the run is.
        """
        super().__init__(verbose)
        self.run_id: str | None = None
        self._experiment = experiment
        self._run_name = run_name
        self._tracking_uri = tracking_uri
        self._log_model = log_model
        self._params = dict(params or {})
        self._tags = dict(tags or {})
        self._run: _Run | None = None
        self._last_episode: tuple[int, Trajectory] | None = None

    def __enter__(self) -> "MLflowCallback":
        """Promise that the run is closed when the block is left."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close a run that is still open with the status that the exception deserves."""
        self.close("KILLED" if kind is None else _status_of(error))

    def close(self, status: Status = "KILLED") -> None:
        """Flush the metrics and close the run with this status, if it is still open."""
        if self._run is None:
            return
        run, self._run = self._run, None
        atexit.unregister(self._close_at_exit)
        try:
            self._write_pending_values(run)
            if status != "FAILED":
                self._log_artifacts(run)
        except Exception as error:
            status = "FAILED"
            warnings.warn(f"MLflow run {run.run_id}: closing it went wrong: {error!r}", stacklevel=2)
        finally:
            if run.writer in self.logger.output_formats:
                self.logger.output_formats.remove(run.writer)
            if run.owned:
                run.client.set_terminated(run.run_id, status)

    def _on_training_start(self) -> None:
        self.close("KILLED")
        self._last_episode = None
        self._run = run = self._open_run()
        self.run_id = run.run_id
        atexit.register(self._close_at_exit)
        try:
            self._log_facts(run)
        except BaseException as error:
            self.close(_status_of(error))
            raise
        self.logger.output_formats.append(run.writer)
        # Kept inside the model's .zip, so that a rollout can name the run its policy comes from.
        self.model.avp_mlflow_run_id = run.run_id  # type: ignore[attr-defined]
        if self.verbose:
            print(f"MLflow run {run.run_id} at {run.client.tracking_uri}")

    def _on_step(self) -> bool:
        for index, info in finished_episodes(self.locals):
            if "avp_trajectory" in info:
                self._last_episode = index, info["avp_trajectory"]
        return True

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this once more in a `finally`, whatever ended `learn()`.
        self.close("FINISHED" if _is_learning(self.model) else _status_of(sys.exc_info()[1]))

    def _open_run(self) -> "_Run":
        """The active run, or a new one."""
        active = mlflow.active_run()
        if active is None:
            configured = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_TRACKING_URI
            client = MlflowClient(self._tracking_uri or configured)
            return _Run(client, self._create_run(client), owned=True)
        if self._tracking_uri not in (None, mlflow.get_tracking_uri()):
            raise UsageError(
                f"tracking_uri {self._tracking_uri}: the active MLflow run {active.info.run_id} is kept at "
                f"{mlflow.get_tracking_uri()}; end that run or leave tracking_uri out"
            )
        return _Run(MlflowClient(), active.info.run_id, owned=False)

    def _create_run(self, client: MlflowClient) -> str:
        experiment = client.get_experiment_by_name(self._experiment)
        identity = experiment.experiment_id if experiment else client.create_experiment(self._experiment)
        return client.create_run(identity, tags=resolve_tags(), run_name=self._run_name).info.run_id

    def _log_facts(self, run: "_Run") -> None:
        env = self.training_env
        params = hyperparameters(self.model) | task_settings(env) | flat(self._params)
        tags = version_tags() | scene_tags(env)
        if (commit := git_commit()) is not None:
            tags["mlflow.source.git.commit"] = commit
        if (earlier := getattr(self.model, "avp_mlflow_run_id", None)) not in (None, run.run_id):
            tags["avp.continued_from"] = earlier
        run.client.log_batch(
            run.run_id,
            params=[Param(safe_name(key), str(value)[:_MAX_PARAM]) for key, value in params.items()],
            tags=[RunTag(safe_name(key), value) for key, value in (tags | self._tags).items()],
        )

    def _write_pending_values(self, run: "_Run") -> None:
        """Values recorded after the logger's last dump: the last update's losses, or what an interruption cut off."""
        run.writer.write(self.logger.name_to_value, self.logger.name_to_excluded, self.model.num_timesteps)
        run.writer.flush()

    def _log_artifacts(self, run: "_Run") -> None:
        with tempfile.TemporaryDirectory() as name:
            if self._log_model:
                path = Path(name) / MODEL_FILE
                self.model.save(path)
                run.client.log_artifact(run.run_id, os.fspath(path))
            if self._last_episode is not None and self.training_env.has_attr("area"):
                path = Path(name) / TRAJECTORY_FILE
                self._draw(path, *self._last_episode)
                run.client.log_artifact(run.run_id, os.fspath(path))

    def _draw(self, path: Path, index: int, trajectory: "Trajectory") -> None:
        from avp_habitat.drawing import draw_trajectory
        from avp_habitat.images import write_rgb

        write_rgb(path, draw_trajectory(self.training_env.get_attr("area", index)[0], trajectory))

    def _close_at_exit(self) -> None:
        error = getattr(sys, "last_value", None)
        self.close("KILLED" if error is None else _status_of(error))


def _status_of(error: BaseException | None) -> Status:
    interrupted = error is None or isinstance(error, (KeyboardInterrupt, SystemExit))
    return "KILLED" if interrupted else "FAILED"


def _is_learning(model: Any) -> bool:
    """Whether `model.learn` is among the callers, that is, whether the training came to its own end."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
            return True
        frame = frame.f_back
    return False
