"""Steps/s of PPO training (Table 4's values) in five ways, its peak memory and its start-up time.

The ways take turns, A B C D E A B …, with the same seed in a turn, so that their ratios are paired; one training
before the first turn is not measured, because a process imports and compiles much when it trains first. `steps_per_s`
counts from the first step to the end of the last update; the whole `learn()`, with the opening and closing of the
MLflow run and the Rerun file, is given beside it. Memory and start-up are measured in fresh processes, with tables in
a temporary folder. Numba's compiled code is cached beside the sources: the very first run on a machine starts later.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import reporting
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.sight.lattice import CACHE_VARIABLE as CACHE
from avp_habitat.task.rewards import find_reward
from avp_sb3.presets import TABLE_4

_BUFFER = TABLE_4.n_envs * TABLE_4.n_steps
_WHOLE_TRAINING = 300_000
_FAST, _TRACKED, _BARE = "tables, all callbacks", "tables, metrics + MLflow", "tables"
_CAST, _SINGLE = "rays", "single, rays, all callbacks"
_WAYS = 5


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "training")
    add = made.add_argument
    add("--scene", default="builtin:0", help=SCENES)
    add("--reward", default="proposed", help="the reward's name")
    add("--agents", default=TABLE_4.n_envs, type=int, help="of the batched ways; divides PPO's buffer of 2048 steps")
    add("--repeats", default=3, type=int, help="turns of the five ways")
    add("--steps", default=61_440, type=int, help="of the ways with tables; PPO completes its buffer of 2048")
    add("--cast-steps", default=6144, type=int, help="of the way that casts all rays")
    add("--single-steps", default=2048, type=int, help="of the single environment")
    add("--raw-seconds", default=1.5, type=float, help="of casting rays alone, in each turn")
    add("--memory-agents", default=[16, 64], type=int, nargs="*", help="measure memory and start-up for these")
    add("--memory-steps", default=4096, type=int, help="of the trainings whose memory is measured")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    least = dict.fromkeys(("agents", "repeats", "steps", "cast_steps", "single_steps", "memory_steps"), 1)
    reporting.check_least(options, **least, raw_seconds=0.0)
    for agents in [options.agents, *options.memory_agents]:
        if agents < 1 or _BUFFER % agents:
            raise UsageError(f"--agents, --memory-agents: expected divisors of {_BUFFER}, got {agents}")
    find_reward(options.reward)
    with tempfile.TemporaryDirectory() as name, reporting.reported("training", options) as results:
        folder = Path(name)
        with reporting.own_folders(folder):
            for _ in tqdm(_trainings(options, folder, results), total=_WAYS * options.repeats, desc="trainings"):
                pass
            _processes(options, folder, results)


def _trainings(options: argparse.Namespace, folder: Path, results: reporting.Results) -> Iterator[None]:
    """Train in turns; the tables of the results are brought up to date after every training."""
    # Late, so that --help and a mistyped option answer at once.
    import ppo
    from rays import RecordingSimulator

    from avp_habitat.scenes.loader import load_scene
    from avp_habitat.sight.tables import scene_tables
    from avp_habitat.task.settings import TaskSettings

    simulator = RecordingSimulator(load_scene(options.scene))
    start = time.perf_counter()
    scene_tables(simulator, TaskSettings()).around(simulator.area.centres)
    build_s = time.perf_counter() - start
    tracking = ppo.prepare_tracking(folder)
    ways = {
        ppo.Way(_FAST, options.agents, batched=True, lookup=True, callbacks="all"): options.steps,
        ppo.Way(_TRACKED, options.agents, batched=True, lookup=True, callbacks="tracking"): options.steps,
        ppo.Way(_BARE, options.agents, batched=True, lookup=True, callbacks="none"): options.steps,
        ppo.Way(_CAST, options.agents, batched=True, lookup=False, callbacks="none"): options.cast_steps,
        ppo.Way(_SINGLE, 1, batched=False, lookup=False, callbacks="all"): options.single_steps,
    }
    timings: dict[str, list[ppo.Timing]] = {way.name: [] for way in ways}
    rays_per_step: list[float] = []
    raw_rates: list[float] = []
    _warm_up(options, list(ways), simulator, folder, tracking)
    for turn in range(options.repeats):
        for way, steps in ways.items():
            if way.name == _CAST:
                simulator.start()
            timing = ppo.train(
                way,
                simulator,
                reward=options.reward,
                steps=steps,
                seed=turn,
                folder=folder,
                tracking=tracking,
            )
            timings[way.name].append(timing)
            if way.name == _CAST:
                simulator.stop()
                rays_per_step.append(simulator.count / timing.steps)
                cast, took = simulator.replay(options.raw_seconds)
                raw_rates.append(cast / took)
            results["training"] = [_row(way, timings[way.name]) for way in ways if timings[way.name]]
            rates = {name: [entry.steps / entry.loop_s for entry in entries] for name, entries in timings.items()}
            results["comparison"] = _comparison(rates, rays_per_step, raw_rates)
            yield
    results["tables"] = [{"scene": simulator.scene, "area_m2": simulator.area.area_m2, "build_s": build_s}]


def _warm_up(options: argparse.Namespace, ways: list[Any], simulator: Any, folder: Path, tracking: str) -> None:
    """Train with tables and callbacks for one buffer: what a process imports and compiles once is no way's cost."""
    import ppo

    ppo.train(
        ways[0], simulator, reward=options.reward, steps=_BUFFER, seed=options.repeats, folder=folder, tracking=tracking
    )


def _row(way: Any, timings: Sequence[Any]) -> dict[str, Any]:
    rates = [timing.steps / timing.loop_s for timing in timings]
    return {
        "way": way.name,
        "agents": way.agents,
        "steps": timings[0].steps,
        "steps_per_s": statistics.median(rates),
        "all": rates,
        "around_the_steps_s": statistics.median(timing.learn_s - timing.loop_s for timing in timings),
        f"s_for_{_WHOLE_TRAINING}_steps": statistics.median(
            _WHOLE_TRAINING / rate + timing.learn_s - timing.loop_s for rate, timing in zip(rates, timings, strict=True)
        ),
    }


def _comparison(
    rates: dict[str, list[float]], rays_per_step: list[float], raw_rates: list[float]
) -> list[dict[str, Any]]:
    """Ratios of each turn, as far as it has come."""

    def row(what: str, values: list[float]) -> list[dict[str, Any]]:
        return [{"what": what, "median": statistics.median(values), "all": values}] if values else []

    def paired(above: str, below: str) -> list[float]:
        return [a / b for a, b in zip(rates[above], rates[below], strict=False)]

    shares = [rate * rays / raw for rate, rays, raw in zip(rates[_FAST], rays_per_step, raw_rates, strict=False)]
    return [
        *row("metrics + MLflow cost, % of steps/s", [100 * (1 - ratio) for ratio in paired(_TRACKED, _BARE)]),
        *row("all callbacks cost, % of steps/s", [100 * (1 - ratio) for ratio in paired(_FAST, _BARE)]),
        *row("tables over rays, both without callbacks, x", paired(_BARE, _CAST)),
        *row("tables over single, both with all callbacks, x", paired(_FAST, _SINGLE)),
        *row("rays of the definition per step", rays_per_step),
        *row("raw rays/s", raw_rates),
        *row("raw steps/s", [raw / rays for raw, rays in zip(raw_rates, rays_per_step, strict=True)]),
        *row("share of the raw rate, tables with all callbacks", shares),
    ]


def _processes(options: argparse.Namespace, folder: Path, results: reporting.Results) -> None:
    """Start-up without tables once, then start-up and memory with them."""
    results["processes"] = []
    cases = [(agents, True) for agents in options.memory_agents]
    cases[:0] = [(agents, False) for agents in options.memory_agents[:1]]
    for agents, kept in tqdm(cases, desc="processes"):
        cache = folder / CACHE if kept else folder / "no tables"
        row = _process(options, agents, cache)
        results["processes"].append({"tables_on_disk": kept} | row)


def _process(options: argparse.Namespace, agents: int, cache: Path) -> dict[str, Any]:
    script = Path(__file__).with_name("training_process.py")
    words = {"scene": options.scene, "reward": options.reward, "agents": agents, "steps": options.memory_steps}
    line = [sys.executable, str(script), *(str(word) for key, value in words.items() for word in (f"--{key}", value))]
    done = subprocess.run(
        [*line, "--started", repr(time.time())],
        env={**os.environ, CACHE: str(cache)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        raise AVPError(f"{script.name} --agents {agents}: ended with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(command.run(main))
