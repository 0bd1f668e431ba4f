"""The course of a training: which of nerfstudio's scalars are kept, taken while it runs or from its event files."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# nerfstudio's modules import each other in circles; the trainer has to come before the writers.
import nerfstudio.engine.trainer  # noqa: F401
from nerfstudio.utils.writer import EventName, Writer

Sink = Callable[[str, float, int], None]
"""Takes name, value and iteration."""

# Its remaining time counts down from the wrong end when a training is resumed, and nobody plots it.
_DROPPED = {EventName.ETA.value}
_EVERY_ITERATION = {EventName.ITER_TRAIN_TIME.value, EventName.TRAIN_RAYS_PER_SEC.value}


@dataclass(frozen=True)
class Scalar:
    """A number that nerfstudio logged."""

    name: str
    """nerfstudio's."""
    value: float
    """In nerfstudio's unit."""
    step: int
    """Iteration."""
    timestamp: float
    """Seconds since 1970."""


class ScalarWriter(Writer):
    """One of nerfstudio's event writers: hands the numbers that are kept to others."""

    def __init__(self, sinks: Sequence[Sink], every: int) -> None:
        """Hand each number to all `sinks`, those that arrive in each iteration only `every` so many iterations."""
        self._sinks = tuple(sinks)
        self._every = every

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        """Hand a number on; a tensor of one element counts as one."""
        if is_kept(name, step, self._every):
            for sink in self._sinks:
                sink(name, float(scalar), step)

    def write_image(self, name: str, image: Any, step: int) -> None:
        """Nothing: pictures are rendered once, after the training."""

    def write_config(self, name: str, config_dict: dict[str, Any], step: int) -> None:
        """Nothing: settings are logged as facts of the run."""


def is_kept(name: str, step: int, every: int) -> bool:
    """Whether a number is kept: nerfstudio logs times and learning rates in each iteration, losses every so many."""
    each = name in _EVERY_ITERATION or name.startswith("learning_rate/")
    return name not in _DROPPED and (not each or step % every == 0)


def read_events(folder: Path, every: int) -> Iterator[Scalar]:
    """The kept numbers of a training's TensorBoard event files; none when it wrote none."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not any(folder.glob("events.out.tfevents.*")):
        return
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    for name in events.Tags()["scalars"]:
        for event in events.Scalars(name):
            if is_kept(name, event.step, every):
                yield Scalar(name, event.value, event.step, event.wall_time)
