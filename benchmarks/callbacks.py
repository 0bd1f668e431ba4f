"""What the callbacks cost a PPO training (Table 4's values, tables): steps/s without, with each, and with all.

Every callback runs with its default options. In each repetition the trainings without and with all callbacks follow
each other directly, in turns the one or the other first, then each callback alone; all with the same seed and steps, so
that their ratios are paired. `steps/s` counts from the first step to the end of the last update and of the evaluation
after it, by the clock and by this process's CPU time (which other programs on the machine disturb less); the opening
and closing of runs and files stands beside it. Not counted: a training before the first repetition, in which a process
imports and compiles much and the tables of the scenes are made; what the first evaluation in a new scene takes is a row
of its own. The delay is the time from a point's logging until another process finds it in MLflow, while it trains.
"""

import argparse
import gc
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import reporting
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.task.rewards import find_reward
from avp_sb3.presets import TABLE_4

_BUFFER = TABLE_4.n_envs * TABLE_4.n_steps
_NONE, _ALL = "none", "all"
_ALONE = ("metrics", "MLflow", "Rerun", "evaluation")


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "callbacks")
    add = made.add_argument
    add("--scene", default="builtin:0", help=SCENES)
    add("--reward", default="proposed", help="the reward's name")
    add("--agents", default=TABLE_4.n_envs, type=int, help="stepped as one batch; divides PPO's buffer of 2048 steps")
    add("--repeats", default=5, type=int, help="repetitions")
    add("--steps", default=300_000, type=int, help="of each training; two evaluations at their default distance")
    add("--delay-steps", default=61_440, type=int, help="of the training during which MLflow is polled")
    add("--episodes", default=50, type=int, help="recorded to find their size")
    add("--seed", default=0, type=int, help="of the first repetition; repetition i uses SEED + i")
    return made


@dataclass(frozen=True)
class Timing:
    """What one training took."""

    steps: int
    """Steps of all agents together; whole buffers of PPO."""
    clock_s: float
    """Seconds from the first step to the end of the last update and the evaluation after it."""
    cpu_s: float
    """CPU seconds of this process in that time, all threads together."""
    around_s: float
    """Seconds of `learn()` besides: opening and closing runs, files and scenes."""


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, agents=1, repeats=1, steps=1, delay_steps=1, episodes=1, seed=0)
    if _BUFFER % options.agents:
        raise UsageError(f"--agents: expected a divisor of {_BUFFER}, got {options.agents}")
    find_reward(options.reward)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with reporting.own_folders(folder), reporting.reported("callbacks", options) as results:
            bench = _Bench(options, folder)
            results["evaluation"] = [bench.first_evaluation()]
            bench.train(_ALL, options.seed + options.repeats, steps=_BUFFER)
            for _ in tqdm(_repetitions(bench, results), total=options.repeats * (2 + len(_ALONE)), desc="trainings"):
                pass
            results["recording"] = [bench.recording()]
            results["delay"] = [bench.delay()]
    reporting.write_page(options.out, "What the callbacks cost", __doc__)


class _Bench:
    """Trainings on one scene with one MLflow store."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        # Late, so that --help and a mistyped option answer at once.
        import ppo
        import torch

        from avp_habitat.simulators.registry import make_simulator
        from avp_habitat.task.settings import TaskSettings

        torch.set_num_threads(1)
        self.options = options
        self.folder = folder
        self.tracking = ppo.prepare_tracking(folder)
        self.simulator = make_simulator("raycast", options.scene)
        self.settings = TaskSettings(reward=options.reward, lookup=True)

    def model(self, seed: int) -> Any:
        """A new model in a new environment."""
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import VecMonitor

        from avp_sb3 import AVPVecEnv

        agents = self.options.agents
        env = AVPVecEnv(agents=agents, simulator=self.simulator, settings=self.settings, seed=seed)
        arguments = replace(TABLE_4, n_steps=_BUFFER // agents).arguments()
        return PPO("MlpPolicy", VecMonitor(env), device="cpu", seed=seed, **arguments)

    def callbacks(self, way: str) -> list[Any]:
        """Those of a way, with their default options but for where things are kept."""
        from avp_sb3 import EvaluationCallback, MetricsCallback, MLflowCallback, RerunCallback

        makers = {
            "metrics": MetricsCallback,
            "MLflow": lambda: MLflowCallback("benchmark", tracking_uri=self.tracking),
            "Rerun": lambda: RerunCallback(self.folder / "training.rrd"),
            "evaluation": lambda: EvaluationCallback(best_model=self.folder / "best.zip"),
        }
        return [make() for name, make in makers.items() if way in (name, _ALL)]

    def train(self, way: str, seed: int, *, steps: int) -> Timing:
        """Train once; what it leaves on disk but its MLflow run is removed."""
        from stopwatch import Stopwatch

        gc.collect()
        model, watch = self.model(seed), Stopwatch()
        start = time.perf_counter()
        try:
            model.learn(steps, callback=[watch, *self.callbacks(way)])
        finally:
            for name in ("training.rrd", "best.zip"):
                (self.folder / name).unlink(missing_ok=True)
        whole_s = time.perf_counter() - start
        return Timing(model.num_timesteps, watch.clock_s, watch.cpu_s, whole_s - watch.clock_s)

    def first_evaluation(self) -> dict[str, Any]:
        """CPU seconds of the default evaluation: opening its scene, the first time in it, and later ones."""
        from avp_sb3 import AVPVecEnv
        from avp_sb3.callbacks.evaluation import DEFAULT_EPISODES, DEFAULT_EVERY, DEFAULT_SCENES
        from avp_sb3.evaluation.batch import run_batch

        model, seconds = self.model(self.options.seed), []
        start = time.process_time()
        env = AVPVecEnv(DEFAULT_SCENES, agents=DEFAULT_EPISODES * len(DEFAULT_SCENES), settings=self.settings)
        open_s = time.process_time() - start
        for _ in range(6):
            start = time.process_time()
            run_batch(model, env, DEFAULT_EPISODES, seed=1000, deterministic=False)
            seconds.append(time.process_time() - start)
        return {
            "scenes": ", ".join(DEFAULT_SCENES),
            "episodes": DEFAULT_EPISODES,
            "every": DEFAULT_EVERY,
            "opening_cpu_s": open_s,
            "first_ever_cpu_s": seconds[0],
            "later_cpu_s": statistics.median(seconds[1:]),
        }

    def recording(self) -> dict[str, Any]:
        """Size of a recording with the default pictures, when every episode is recorded until there are enough."""
        from stable_baselines3.common.callbacks import BaseCallback

        from avp_sb3 import RerunCallback

        class Enough(BaseCallback):
            """Ends the training when enough episodes have ended."""

            def __init__(self, episodes: int) -> None:
                super().__init__()
                self.left = episodes

            def _on_step(self) -> bool:
                self.left -= int(self.locals["dones"].sum())
                return self.left > 0

        path = self.folder / "recording.rrd"
        recorder = RerunCallback(path, every=1, max_share=1)
        self.model(self.options.seed).learn(10**9, callback=[recorder, Enough(self.options.episodes)])
        size, episodes = path.stat().st_size, _recorded_episodes(path)
        path.unlink()
        return {"episodes": episodes, "bytes": size, "bytes_per_episode": size / episodes}

    def delay(self) -> dict[str, Any]:
        """Seconds until a point of a running training is visible to another process."""
        from mlflow import MlflowClient

        from avp_sb3 import MetricsCallback, MLflowCallback

        experiment = "delay"
        kept = (self.folder / "artifacts").resolve().as_uri()
        MlflowClient(self.tracking).create_experiment(experiment, artifact_location=kept)
        line = [sys.executable, str(Path(__file__).with_name("callbacks_poll.py")), self.tracking, experiment]
        stop = self.folder / "stop"
        poller = subprocess.Popen([*line, str(stop)], stdout=subprocess.PIPE, text=True)
        assert poller.stdout is not None
        try:
            poller.stdout.readline()
            callbacks = [MetricsCallback(), MLflowCallback(experiment, tracking_uri=self.tracking)]
            self.model(self.options.seed).learn(self.options.delay_steps, callback=callbacks)
            stop.touch()
            told = poller.stdout.read()
        finally:
            poller.kill()
            poller.wait()
        if not told:
            raise AVPError("callbacks_poll.py: ended without an answer; its error is above")
        delays = json.loads(told)
        return {
            "points": len(delays),
            "median_s": statistics.median(delays) if delays else None,
            "longest_s": max(delays, default=None),
        }


def _recorded_episodes(path: Path) -> int:
    from rerun.chunk import RrdReader

    reader, found = RrdReader(path), set()
    for store in reader.recordings():
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            if chunk.entity_path == "/world/agent" and "episode" in batch.schema.names:
                found.update(batch.column("episode").to_pylist())
    return len(found)


def _repetitions(bench: _Bench, results: reporting.Results) -> Iterator[None]:
    """Train in turns; the tables of the results are brought up to date after every training."""
    options = bench.options
    timings: dict[str, list[Timing]] = {way: [] for way in (_NONE, *_ALONE, _ALL)}
    for turn in range(options.repeats):
        pair = (_NONE, _ALL) if turn % 2 == 0 else (_ALL, _NONE)
        for way in (*pair, *_ALONE):
            timings[way].append(bench.train(way, options.seed + turn, steps=options.steps))
            results["training"] = [_row(way, made) for way, made in timings.items() if made]
            results["cost"] = [_cost(way, made, timings[_NONE]) for way, made in timings.items() if way != _NONE]
            yield


def _row(way: str, timings: Sequence[Timing]) -> dict[str, Any]:
    return {
        "callbacks": way,
        "steps": timings[0].steps,
        "seconds": statistics.median(timing.clock_s for timing in timings),
        "steps_per_s": statistics.median(timing.steps / timing.clock_s for timing in timings),
        "steps_per_cpu_s": statistics.median(timing.steps / timing.cpu_s for timing in timings),
        "around_s": statistics.median(timing.around_s for timing in timings),
    }


def _cost(way: str, timings: Sequence[Timing], bare: Sequence[Timing]) -> dict[str, Any]:
    """Per cent of steps/s that a way costs against no callbacks in the same repetition."""
    pairs = list(zip(timings, bare, strict=False))
    clock = [100 * (1 - without.clock_s / timing.clock_s) for timing, without in pairs]
    cpu = [100 * (1 - without.cpu_s / timing.cpu_s) for timing, without in pairs]
    return {
        "callbacks": way,
        "median_percent": statistics.median(clock) if clock else None,
        "median_percent_of_cpu": statistics.median(cpu) if cpu else None,
        "all": clock,
        "all_of_cpu": cpu,
    }


if __name__ == "__main__":
    sys.exit(command.run(main))
