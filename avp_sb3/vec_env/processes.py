"""A worker process of `AVPSubprocVecEnv`: agents in one scene, in a simulator of the process's own."""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any

from avp_habitat import errors
from avp_habitat.errors import AVPError, SimulatorError
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.settings import TaskSettings

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from avp_sb3.vec_env.batched import AVPVecEnv


GRACE_S = 5.0
"""How long a worker may take to end by itself, seconds."""
GONE = (EOFError, BrokenPipeError, ConnectionResetError)
"""What a pipe raises when the process at its other end has ended."""
_HINTS = {
    "SIGKILL": "by somebody, or by the system for want of memory",
    "SIGSEGV": "a crash inside the simulator",
    "SIGABRT": "a crash inside the simulator",
}


def how_it_ended(process: BaseProcess) -> str:
    """The end of a process whose pipe is broken, as a phrase: by which signal, or with which exit code."""
    process.join(GRACE_S)
    code = process.exitcode
    if code is None:
        return "does not answer any more"
    if code >= 0:
        return f"ended with exit code {code}; what it said last stands above"
    name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
    hint = _HINTS.get(name)
    return f"was killed by {name}{f' ({hint})' if hint else ''}"


def end_processes(processes: Sequence[BaseProcess], pipes: Sequence[Connection]) -> None:
    """Close the pipes, by which a worker learns that it is not needed, and end who has not ended after a while."""
    for pipe in pipes:
        pipe.close()
    _join(processes)
    for stop in ("terminate", "kill"):
        late = [process for process in processes if process.is_alive()]
        for process in late:
            getattr(process, stop)()
        _join(late)


def _join(processes: Sequence[BaseProcess]) -> None:
    until = time.monotonic() + GRACE_S
    for process in processes:
        process.join(max(0.0, until - time.monotonic()))


@contextmanager
def named_deaths(
    processes: Sequence[BaseProcess], name: Callable[[int], str], end: Callable[[], None], *, hint: str = ""
) -> Iterator[None]:
    """Within the block, a broken pipe becomes an error that names the worker; the others are ended, too.

    Args:
        processes: the workers.
        name: of a worker by its number, for the error's text.
        end: ends them all.
        hint: at the end of the error's text.

    Raises:
        SimulatorError: a worker has ended.
    """
    try:
        yield
    except GONE:
        dead = _first_dead(processes)
        how = "a worker does not answer any more" if dead is None else how_it_ended(processes[dead])
        with suppress(OSError):
            end()
        who = "" if dead is None else f"{name(dead)} "
        raise SimulatorError(f"{who}{how}; the other workers were ended{hint}") from None


def _first_dead(processes: Sequence[BaseProcess]) -> int | None:
    """The number of a worker that has ended; it may take a moment until the system tells."""
    until = time.monotonic() + GRACE_S
    while time.monotonic() < until:
        for number, process in enumerate(processes):
            if not process.is_alive():
                return number
        time.sleep(0.01)
    return None


# Nothing heavy here: until `serve` runs, an interruption would end in a traceback of this process.


@dataclass(frozen=True)
class Order:
    """What a worker has to open."""

    scene: str
    """As the user gave it."""
    choice: SimulatorChoice
    """Of the simulator."""
    agents: int
    """At least 1."""
    settings: TaskSettings
    """Of the task."""


@dataclass(frozen=True)
class Failure:
    """An answer that is an error; exceptions themselves do not all survive the way to another process."""

    kind: str
    """Name of the exception's class."""
    text: str
    """Of the exception."""

    def error(self, worker: str) -> Exception:
        """The same as an exception of this process: one of ours as it was, another one as a `SimulatorError`.

        Args:
            worker: what the worker is called.
        """
        if self.kind == "AttributeError":
            return AttributeError(self.text)
        kind = getattr(errors, self.kind, None)
        if isinstance(kind, type) and issubclass(kind, AVPError):
            return kind(f"{self.text} [{worker}]")
        return SimulatorError(f"{worker}: {self.kind}: {self.text}")


def serve(pipe: "Connection", order: Order) -> None:
    """Open the scene, then answer requests until the pipe is closed.

    Requests are `(ticket, name, arguments)`, answers `(ticket, value or Failure)`. The first answer, of ticket 0,
    says that the scene is open, or why not. Ctrl-C is left to the parent, which ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    opened: list[AVPVecEnv] = []
    try:
        ready = _attempt(lambda: opened.append(_open(order)))
        pipe.send((0, ready))
        while opened:
            ticket, name, arguments = pipe.recv()
            _answer(pipe, ticket, name, _attempt(lambda: _COMMANDS[name](opened[0], *arguments)))  # noqa: B023
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # The parent has closed its end, or is gone.
    finally:
        # Python's own cleaning at exit is not done in such a process.
        for simulator in opened[0].simulators if opened else []:
            simulator.close()


def _leave(_signum: int, _frame: object) -> None:
    sys.exit(128 + signal.SIGTERM)


def _open(order: Order) -> "AVPVecEnv":
    from avp_sb3.vec_env.batched import AVPVecEnv

    choice = order.choice
    return AVPVecEnv(
        order.scene,
        agents=order.agents,
        simulator=choice.simulator,
        gpu=choice.gpu,
        navmesh=choice.navmesh,
        up=choice.up,
        settings=order.settings,
    )


def _attempt(work: Callable[[], Any]) -> Any:
    try:
        return work()
    except (AVPError, AttributeError) as error:
        return Failure(type(error).__name__, str(error))
    except Exception as error:
        # A mistake of ours: where it happened is worth more than one line.
        traceback.print_exc()
        return Failure(type(error).__name__, f"{error} (process {os.getpid()}; its traceback stands above)")


def _answer(pipe: "Connection", ticket: int, name: str, value: Any) -> None:
    try:
        pipe.send((ticket, value))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise
    except Exception as error:  # Pickle raises whatever the object's own code raises.
        text = f"{name}: the answer cannot leave the process of its simulator: {error}"
        pipe.send((ticket, Failure("UsageError", text)))


def _reset(env: "AVPVecEnv", seeds: list[int | None]) -> Any:
    env.seed_agents(seeds)
    return env.reset()


_COMMANDS: dict[str, Callable[..., Any]] = {
    "reset": _reset,
    "step": lambda env, actions: env.step(actions),
    "has_attr": lambda env, name: env.has_attr(name),
    "get_attr": lambda env, name, rows: env.get_attr(name, rows),
    "env_method": lambda env, name, rows, args, kwargs: env.env_method(name, *args, indices=rows, **kwargs),
}
