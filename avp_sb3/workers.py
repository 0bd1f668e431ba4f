"""Worker processes and what passes between them and their parent: requests, answers, failures, deaths."""

import multiprocessing
import weakref
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from avp_habitat.errors import SimulatorError, UsageError
from avp_sb3.worker_death import end_processes, named_deaths
from avp_sb3.worker_process import Failure, Order, serve

START_METHODS = ("forkserver", "spawn")
_GUARD = '; a script that starts workers needs the guard `if __name__ == "__main__":`, because they import it'


class Workers:
    """Processes that each hold one simulator; none is left when this object is closed, lost, or its program ends."""

    def __init__(self, orders: Sequence[Order], *, start_method: str) -> None:
        """Start a process for each order, and wait until all have opened their scenes.

        Args:
            orders: at least one.
            start_method: `forkserver` or `spawn`; a forked process cannot use a graphics device.

        Raises:
            UsageError: another start method.
            AVPError: as a worker's `AVPVecEnv` raised it, with the worker and its scene.
            SimulatorError: a worker has ended.
        """
        if start_method not in START_METHODS:
            raise UsageError(f"start_method: expected one of {', '.join(START_METHODS)}, got {start_method!r}")
        self._orders = list(orders)
        self._ticket = 0
        context = multiprocessing.get_context(start_method)
        self._pipes: list[Connection] = []
        self.processes: list[Any] = []
        self._ending = weakref.finalize(self, end_processes, self.processes, self._pipes)
        try:
            for order in self._orders:
                ours, theirs = context.Pipe()
                self._pipes.append(ours)
                process = context.Process(target=serve, args=(theirs, order), daemon=True)  # type: ignore[attr-defined]
                process.start()
                self.processes.append(process)
                theirs.close()
            self._receive(range(len(self.processes)), 0)
        except BaseException:
            self.close()
            raise

    def send(self, requests: Mapping[int, tuple[Any, ...]], name: str) -> None:
        """Ask some workers; `receive` waits for what they answer.

        Args:
            requests: arguments by the worker's number.
            name: of the command.

        Raises:
            SimulatorError: a worker has ended.
        """
        self._check_open()
        self._ticket += 1
        with self._deaths():
            for worker, arguments in requests.items():
                self._pipes[worker].send((self._ticket, name, arguments))

    def receive(self, workers: Iterable[int]) -> dict[int, Any]:
        """The answers to what was sent last, by the worker's number.

        Raises:
            AVPError: as a worker raised it, with the worker and its scene.
            AttributeError: as a worker raised it.
            SimulatorError: a worker has ended, or made a mistake of its own.
        """
        self._check_open()
        return self._receive(workers, self._ticket)

    def ask(self, requests: Mapping[int, tuple[Any, ...]], name: str) -> dict[int, Any]:
        """`send` and `receive`."""
        self.send(requests, name)
        return self.receive(requests)

    def close(self) -> None:
        """End all workers: those that work get some seconds to leave by themselves."""
        self._ending()

    def _check_open(self) -> None:
        if not self._ending.alive:
            raise SimulatorError("AVPSubprocVecEnv: its workers were ended; make a new one")

    def _receive(self, workers: Iterable[int], ticket: int) -> dict[int, Any]:
        waiting = {self._pipes[worker]: worker for worker in workers}
        answers: dict[int, Any] = {}
        with self._deaths():
            while waiting:
                # Whoever answers first: a failure is told without waiting for workers that are busy.
                for pipe in wait(list(waiting)):
                    answered, value = pipe.recv()  # type: ignore[union-attr]
                    if answered != ticket:
                        continue  # To a request whose asker was interrupted.
                    worker = waiting.pop(pipe)  # type: ignore[arg-type]
                    if isinstance(value, Failure):
                        raise value.error(self._name(worker))
                    answers[worker] = value
        return answers

    def _deaths(self) -> Any:
        return named_deaths(self.processes, self._name, self.close, hint="" if self._ticket else _GUARD)

    def _name(self, worker: int) -> str:
        return f"worker {worker} of {len(self._orders)} (scene {self._orders[worker].scene})"
