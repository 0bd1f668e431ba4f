"""One training in a process of its own, for its start-up time and peak memory; started by training.py."""

import argparse
import importlib
import json
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from avp_habitat import command

_LATE = (
    "mlflow.store.tracking.sqlalchemy_store",
    "open3d",
    "rerun",
    "avp_habitat.rollout.drawing",
    "avp_habitat.task.motion",
    "avp_habitat.task.cast",
    "avp_habitat.navigation.build",
    "avp_habitat.scenes.loader",
)


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = made.add_argument
    add("--started", required=True, type=float, help="when this process was started, seconds since the epoch")
    add("--scene", default="builtin:0", help="a mesh, or builtin:SEED")
    add("--reward", default="proposed", help="the reward's name")
    add("--agents", default=16, type=int, help="agents stepped as one batch, with tables and all callbacks")
    add("--steps", default=4096, type=int, help="environment steps")
    return made


def main(argv: Sequence[str]) -> None:
    """Train and print one line of JSON."""
    options = _parser().parse_args(argv)
    import ppo

    _import_the_rest()
    imported, _ = memory()
    from avp_habitat.simulators.registry import make_simulator

    with tempfile.TemporaryDirectory() as name:
        timing = ppo.train(
            ppo.Way("", options.agents, batched=True, lookup=True, callbacks="all"),
            make_simulator("raycast", options.scene),
            reward=options.reward,
            steps=options.steps,
            seed=0,
            folder=Path(name),
            tracking=ppo.prepare_tracking(Path(name)),
        )
    _, peak = memory()
    print(
        json.dumps(
            {
                "agents": options.agents,
                "steps": timing.steps,
                "startup_s": timing.first_step_at - options.started,
                "imports_mb": imported / 1e6,
                "peak_mb": peak / 1e6,
                "above_imports_mb": (peak - imported) / 1e6,
            }
        )
    )


def memory() -> tuple[int, int]:
    """Bytes of this process in memory now, and the most there were; the most for both where only that is known."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        # Without /proc: kilobytes, but bytes on macOS.
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        return most, most
    # Not getrusage on Linux: there a new process inherits the most that its parent had.
    values = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith(("VmRSS:", "VmHWM:"))}
    return int(values["VmRSS"]) * 1024, int(values["VmHWM"]) * 1024


def _import_the_rest() -> None:
    """What a training imports late, so that none of it counts as the training's memory."""
    for name in _LATE:
        importlib.import_module(name)


if __name__ == "__main__":
    sys.exit(command.run(main))
