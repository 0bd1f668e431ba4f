"""nerfstudio's trainer with what long runs on small machines want: time left, tracking, a Ctrl-C that loses nothing."""

import os
import shlex
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils import comms

from avp_habitat.command import INTERRUPTED, progress
from avp_habitat.errors import AVPError
from avp_habitat.tracking.run import Status
from avp_habitat.tracking.stores import address_of, open_store
from avp_nerfstudio.data.refusals import CommandError, discard_outputs
from avp_nerfstudio.method.checkpoints import loading_fault, newest_checkpoint
from avp_nerfstudio.tracking import Trackers

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPING = b"\nstopping after this iteration; Ctrl-C again to stop at once\n"


@dataclass
class AVPTrainerConfig(TrainerConfig):
    """nerfstudio's options of a training, and where it is tracked."""

    _target: type = field(default_factory=lambda: AVPTrainer)
    mlflow: str = "auto"
    """Where MLflow keeps the run: an address such as sqlite:///mlflow.db; auto: MLFLOW_TRACKING_URI if that is set,
    else nowhere; off: nowhere. AVP_MLFLOW_OFFLINE=1 trains without it and sends everything later. Give a server's
    password in MLFLOW_TRACKING_PASSWORD, since options are written to config.yml."""
    mlflow_experiment: str | None = None
    """MLflow experiment; by default that of the rollout's run, below which this run then appears: the one in which the
    rollout's policy was trained, else MLFLOW_EXPERIMENT_NAME or MLFLOW_EXPERIMENT_ID, else `avp`."""
    rerun: Path | None = None
    """Write a Rerun recording of losses and cameras to this file (.rrd), which must not exist."""

    def print_to_terminal(self) -> None:
        """What matters of the settings; all of them would be 190 lines, and stand in config.yml."""
        data = self.data or self.pipeline.datamanager.data or "no data"
        print(f"{self.method_name}: {self.max_num_iterations} iterations with {data} on {self.machine.device_type}")


class AVPTrainer(Trainer):
    """nerfstudio's trainer; see `AVPTrainerConfig`.

    The first Ctrl-C or SIGTERM ends the training after the iteration it came in, with a checkpoint. The second one ends
    it at once, without.
    """

    config: AVPTrainerConfig

    def __init__(self, config: AVPTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        """Prepare a training."""
        super().__init__(config, local_rank=local_rank, world_size=world_size)
        self._trackers: Trackers | None = None
        self._bar: Any = None
        self._shown: dict[str, Any] = {}
        self._trained: int | None = None
        self._stopping = self._finished = False

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Build everything, then open the run and the recording that are asked for.

        Raises:
            CommandError: the device, the rollout, the checkpoint to go on from, the MLflow store or the recording
                cannot be used.
        """
        try:
            address = address_of(self.config.mlflow, default=None) if comms.is_main_process() else None
            if address is not None:
                open_store(address)  # before the pipeline is built, which takes long
            super().setup(test_mode)
            for group in self.config.optimizers.values():
                # The learning rates reach their last values when the training ends, however long it is asked to be.
                if hasattr(group["scheduler"], "max_steps"):
                    group["scheduler"].max_steps = self._start_step + self.config.max_num_iterations
            if comms.is_main_process():
                self._trackers = Trackers(self.config, address, self.pipeline)
        except AVPError as error:
            discard_outputs(self.config)
            if isinstance(error, CommandError):
                raise
            raise CommandError(str(error)) from error

    def train(self) -> None:
        """Train; Ctrl-C saves a checkpoint after the iteration it came in, and a second one ends at once."""
        self.callbacks += [
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._after_iteration),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], self._after_training),
        ]
        if self._trackers is not None:
            self._trackers.listen(self.config.logging.steps_per_log)
            if not self.config.logging.local_writer.enable:
                total = self.config.max_num_iterations
                self._bar = progress(total=total, desc="training", unit="iteration", smoothing=0.05)
        previous = {number: signal.signal(number, self._stop) for number in _SIGNALS}
        try:
            super().train()
        except KeyboardInterrupt:
            if not self._finished:  # else the viewer was still open
                self._end_interrupted()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
            # Whatever has not closed them by now is an error on its way out.
            self._close("FAILED")

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One iteration, its loss and PSNR remembered for the bar."""
        loss, loss_dict, metrics_dict = super().train_iteration(step)
        self._shown = {
            "loss": loss.detach(),
            **{name: metrics_dict[name] for name in ("psnr",) if name in metrics_dict},
        }
        return loss, loss_dict, metrics_dict

    def _load_checkpoint(self) -> None:
        config = self.config
        if config.load_dir is not None and config.load_step is None:
            config.load_step = newest_checkpoint(config.load_dir)[1]
        try:
            super()._load_checkpoint()
        except Exception as error:
            path = config.load_checkpoint or config.load_dir or self.checkpoint_dir
            raise CommandError(loading_fault(path, error)) from error

    def _stop(self, number: int, frame: object) -> None:
        if self._stopping or self._finished:
            raise KeyboardInterrupt
        self._stopping = self.stop_training = True
        # print() may be what the signal has interrupted.
        os.write(2, _STOPPING)

    def _after_iteration(self, step: int) -> None:
        self._trained = step
        # nerfstudio sets it to False when the loop begins, before which a signal may have come.
        self.stop_training |= self._stopping
        if self._bar is not None and self._bar.update():
            self._bar.set_postfix_str(", ".join(f"{k} {float(v):.4g}" for k, v in self._shown.items()), refresh=False)

    def _after_train(self) -> None:
        if not self._stopping:
            super()._after_train()
            return
        for number in _SIGNALS:  # nothing interrupts the last checkpoint
            signal.signal(number, signal.SIG_IGN)
        if self._trained is not None:
            self.save_checkpoint(self._trained)
        raise KeyboardInterrupt

    def _after_training(self, step: int) -> None:
        self._finished = True
        self._close("FINISHED")
        if comms.is_main_process():
            _print_next_steps(self.base_dir / "config.yml")

    def _end_interrupted(self) -> None:
        self._close("KILLED")
        if comms.is_main_process():
            self._print_interrupted()
        raise SystemExit(INTERRUPTED)

    def _print_interrupted(self) -> None:
        if not any(self.checkpoint_dir.glob("*.ckpt")):
            print("interrupted before a checkpoint was due; nothing was saved", file=sys.stderr)
            return
        step = newest_checkpoint(self.checkpoint_dir)[1]
        left = self._start_step + self.config.max_num_iterations - step - 1
        data = self.config.data or self.config.pipeline.datamanager.data
        words = ["ns-train", str(self.config.method_name), "--load-dir", str(self.checkpoint_dir)]
        words += ["--data", str(data)] if data else []
        print(f"interrupted after iteration {step}; the checkpoint is in {self.checkpoint_dir}", file=sys.stderr)
        print(f"go on:    {shlex.join([*words, '--max-num-iterations', str(left)])}", file=sys.stderr)
        _print_next_steps(self.base_dir / "config.yml")

    def _close(self, status: Status) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        if self._trackers is not None:
            self._trackers.close(status, self.base_dir)


def _print_next_steps(config: Path) -> None:
    path, scores = shlex.quote(str(config)), shlex.quote(str(config.with_name("scores.json")))
    print(f"score:    ns-eval --load-config {path} --output-path {scores}")
    print(f"pictures: python -m avp_nerfstudio.log {path}")
    print(f"look:     ns-viewer --load-config {path}")
