"""nerfstudio's trainer with what long runs on small machines want: time left, tracking, a Ctrl-C that loses nothing."""

import contextlib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import torch
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils import comms

from avp_habitat.command import INTERRUPTED
from avp_habitat.errors import AVPError
from avp_habitat.tracking.run import Status
from avp_habitat.tracking.stores import address_of, open_store
from avp_nerfstudio.method.progress import TrainingProgress
from avp_nerfstudio.method.running import discard_outputs
from avp_nerfstudio.tracking.logger import Trackers
from avp_nerfstudio.tracking.trained_run import loading_fault, newest_checkpoint

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_GRANTED = b"\nstopping after this iteration; Ctrl-C again to stop at once\n"


class Interruption:
    """A context in which the first signal is remembered and the second, or one that comes in vain, interrupts."""

    def __init__(self, idle: Callable[[], bool]) -> None:
        """Remember how to tell that nobody will look: `idle` says so."""
        self.requested = False
        self._idle = idle
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Interruption":
        """Take the signals over; only the main thread can, elsewhere nothing happens."""
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}

    def grant(self) -> None:
        """End the loop if that was asked for.

        Raises:
            KeyboardInterrupt: it was.
        """
        if self.requested:
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """From now on nothing interrupts: something is being brought to its end."""
        for number in self._previous:
            signal.signal(number, signal.SIG_IGN)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested or self._idle():
            raise KeyboardInterrupt
        self.requested = True
        # print() may be what the signal has interrupted.
        os.write(2, _GRANTED)


class TrainingError(AVPError, SystemExit):
    """A training that cannot start.

    An ordinary error of the suite to whoever catches it; where nobody does (in `ns-train`) the interpreter ends as on
    `sys.exit(text)`: the text on one line, exit code 1 and no traceback.
    """

    def __init__(self, text: str) -> None:
        """Remember the text as the interpreter's last words."""
        super().__init__(text)
        self.code = f"error: {text}"


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

    def set_timestamp(self) -> None:
        """The first thing ns-train asks for: refuse a device that is not there before anything is written."""
        check_device(self.machine)
        super().set_timestamp()

    def print_to_terminal(self) -> None:
        """What matters of the settings; all of them would be 190 lines, and stand in config.yml."""
        data = self.data or self.pipeline.datamanager.data or "no data"
        print(f"{self.method_name}: {self.max_num_iterations} iterations with {data} on {self.machine.device_type}")


def check_device(machine: MachineConfig) -> None:
    """Hold a configuration to the devices that exist.

    Raises:
        TrainingError: there is no such device, or fewer of them than wanted.
    """
    kind = machine.device_type
    count = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available())}.get(kind)
    if count == 0:
        built = f"torch {torch.__version__} is built for CUDA {torch.version.cuda}" if kind == "cuda" else "torch"
        raise TrainingError(
            f"--machine.device-type {kind}: no such device was found ({built}); leave the option out or use cpu"
        )
    if count is not None and machine.num_devices > count:
        raise TrainingError(f"--machine.num-devices {machine.num_devices}: expected at most {count}, the devices found")


class AVPTrainer(Trainer):
    """nerfstudio's trainer; see `AVPTrainerConfig`."""

    config: AVPTrainerConfig

    def __init__(self, config: AVPTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        """Prepare a training.

        Raises:
            TrainingError: its device does not exist.
        """
        check_device(config.machine)
        super().__init__(config, local_rank=local_rank, world_size=world_size)
        self._interruption = Interruption(idle=lambda: self._finished or self.training_state == "paused")
        self._trackers = Trackers()
        self._progress: TrainingProgress | None = None
        self._shown: dict[str, Any] = {}
        self._trained: int | None = None
        self._within_iteration = self._finished = False

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Build everything, then open the run and the recording that are asked for.

        Raises:
            TrainingError: the checkpoint to go on from, the MLflow store or the recording cannot be used.
        """
        try:
            with _as_training_error():
                address = address_of(self.config.mlflow, default=None) if comms.is_main_process() else None
                if address is not None:
                    open_store(address)  # before the pipeline is built, which takes long
                super().setup(test_mode)
                self._fit_schedules()
                if comms.is_main_process():
                    self._trackers = Trackers.of(self.config, address, self.pipeline)
        except TrainingError:
            discard_outputs(self.config)
            raise
        except KeyboardInterrupt:
            raise SystemExit(INTERRUPTED) from None

    def _fit_schedules(self) -> None:
        """Let the learning rates reach their last values when the training ends, however long it is asked to be."""
        for group in self.config.optimizers.values():
            if hasattr(group["scheduler"], "max_steps"):
                group["scheduler"].max_steps = self._start_step + self.config.max_num_iterations

    def train(self) -> None:
        """Train; Ctrl-C saves a checkpoint after the iteration it came in, and a second one ends at once."""
        for locations, function in (
            ([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self._before_iteration),
            ([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], self._after_iteration),
            ([TrainingCallbackLocation.AFTER_TRAIN], self._after_training),
        ):
            self.callbacks.append(TrainingCallback(locations, function))
        self._trackers.listen(self.config.logging.steps_per_log)
        if comms.is_main_process() and not self.config.logging.local_writer.enable:
            self._progress = TrainingProgress(self.config.max_num_iterations)
        with self._interruption:
            try:
                super().train()
            except KeyboardInterrupt:
                self._end_interrupted()
            finally:
                # Whatever has not closed them by now is an error on its way out.
                self._close("FAILED")

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One iteration, its loss and PSNR remembered for the bar."""
        loss, loss_dict, metrics_dict = super().train_iteration(step)
        self._shown = {"loss": loss.detach()}
        if "psnr" in metrics_dict:
            self._shown["psnr"] = metrics_dict["psnr"]
        return loss, loss_dict, metrics_dict

    def _load_checkpoint(self) -> None:
        config = self.config
        path = config.load_checkpoint
        if config.load_dir is not None and config.load_step is None:
            path, config.load_step = newest_checkpoint(config.load_dir)
        elif config.load_dir is not None:
            path = config.load_dir / f"step-{config.load_step:09d}.ckpt"
        if path is not None and not path.is_file():
            raise TrainingError(f"{path}: expected a checkpoint to go on from, found none")
        try:
            super()._load_checkpoint()
        except AVPError:  # it holds what the safe loader refuses
            raise
        except Exception as error:
            assert path is not None
            raise TrainingError(loading_fault(path, error)) from error

    def _before_iteration(self, step: int) -> None:
        self._within_iteration = True

    def _after_iteration(self, step: int) -> None:
        self._within_iteration, self._trained = False, step
        if self._progress is not None:
            self._progress.update(self._shown)
        self._interruption.grant()

    def _after_training(self, step: int) -> None:
        self._finished = True
        self._close("FINISHED")
        if comms.is_main_process():
            _print_next_steps(self.base_dir / "config.yml")

    def _end_interrupted(self) -> None:
        if self._finished:  # the viewer was still open
            return
        self._interruption.ignore()
        if self._trained is not None and not self._within_iteration:
            self.save_checkpoint(self._trained)
        self._close("KILLED")
        if comms.is_main_process():
            self._print_interrupted()
        raise SystemExit(INTERRUPTED)

    def _print_interrupted(self) -> None:
        saved = sorted(self.checkpoint_dir.glob("*.ckpt"))
        if not saved:
            print("interrupted before the first iteration was done; nothing was saved", file=sys.stderr)
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
        if self._progress is not None:
            self._progress.close()
            self._progress = None
        self._trackers.close(status, self.base_dir)


@contextlib.contextmanager
def _as_training_error() -> Iterator[None]:
    """Let the suite's errors end nerfstudio's own commands with their text."""
    try:
        yield
    except SystemExit:
        raise
    except AVPError as error:
        raise TrainingError(str(error)) from error


def _print_next_steps(config: Path) -> None:
    path, scores = shlex.quote(str(config)), shlex.quote(str(config.with_name("scores.json")))
    print(f"score:    ns-eval --load-config {path} --output-path {scores}")
    print(f"pictures: python -m avp_nerfstudio.log {path}")
    print(f"look:     ns-viewer --load-config {path}")
