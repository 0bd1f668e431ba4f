"""Steps/s of the bare environment under random actions, beside the rate at which its rays are cast by themselves.

Rows with lookup `off` cast all rays of the definition; the same rays are cast again through the simulator alone, in
turns with the steps, and `share` is the environment's rate over theirs. Rows with lookup `on` read the tables of the
scene; the resolution does not matter to them, so they are made for the middle one of `--resolutions`, and `share` is
over the rays that the definition would cast for the same number of agents at that resolution: above 1, the tables
are faster than any casting of those rays could be.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import reporting
from rays import RecordingSimulator
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.sight.lattice import CACHE_VARIABLE as CACHE
from avp_habitat.sight.tables import scene_tables
from avp_habitat.task.settings import ACTION_NAMES, TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv

_ROUNDS = 3


@dataclass(frozen=True)
class Case:
    """One row to measure."""

    agents: int
    """Stepped as one batch."""
    settings: TaskSettings
    """With the resolution, and with lookup on or off."""

    @property
    def image(self) -> str:
        """Size of the depth image."""
        return f"{self.settings.width}x{self.settings.height}"


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "environment")
    add = made.add_argument
    add("--scene", default="builtin:0", help=SCENES)
    add("--agents", default=[1, 4, 16, 64], type=int, nargs="+", help="agents stepped as one batch")
    add("--resolutions", default=["64x48", "160x120", "320x240"], nargs="+", help="depth images, WIDTHxHEIGHT")
    add("--seconds", default=3.0, type=float, help="of steps per row; casting the rays again takes up to as long")
    add("--seed", default=0, type=int, help="of the starts and the actions")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, agents=1, seconds=0.001)
    resolutions = [_resolution(text) for text in options.resolutions]
    # Nothing is kept on disk, so that the time to build the tables is measured and no earlier tables are used.
    os.environ[CACHE] = ""
    simulator = RecordingSimulator(load_scene(options.scene))
    with reporting.reported("environment", options) as results:
        results["tables"] = []
        results["environment"] = []
        reference = TaskSettings(
            width=resolutions[len(resolutions) // 2][0], height=resolutions[len(resolutions) // 2][1]
        )
        results["tables"].append(_build_tables(simulator, reference))
        raw: dict[int, dict[str, Any]] = {}
        for case in tqdm(list(_cases(options.agents, resolutions, reference)), desc="environment", unit="row"):
            row = _measure(simulator, case, seconds=options.seconds, seed=options.seed)
            if case.settings == reference:
                raw[case.agents] = row
            if case.settings.lookup:
                row = _over_definition(row, raw[case.agents])
            results["environment"].append(row)


def _resolution(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise UsageError(f"--resolutions: expected WIDTHxHEIGHT in pixels, for example 160x120, got {text!r}")
    return int(width), int(height)


def _cases(agents: list[int], resolutions: list[tuple[int, int]], reference: TaskSettings) -> Iterator[Case]:
    for count in agents:
        for width, height in resolutions:
            yield Case(count, replace(reference, width=width, height=height))
        yield Case(count, replace(reference, lookup=True))


def _build_tables(simulator: RecordingSimulator, settings: TaskSettings) -> dict[str, Any]:
    """Make the tables of the whole scene."""
    area = simulator.area
    tables = scene_tables(simulator, settings)
    print(f"tables of {area.area_m2:.0f} m² are being built", file=sys.stderr)
    start = time.perf_counter()
    tables.around(area.centres)
    return {
        "scene": simulator.scene,
        "cells": len(area.centres),
        "area_m2": area.area_m2,
        "build_s": time.perf_counter() - start,
        "places": len(tables.columns["visible"]),
        "memory_mb": sum(column.nbytes for column in tables.columns.values()) / 1e6,
    }


def _measure(simulator: RecordingSimulator, case: Case, *, seconds: float, seed: int) -> dict[str, Any]:
    """Steps and the same rays alone, in turns; medians over the rounds."""
    env = AVPVecEnv(agents=case.agents, simulator=simulator, settings=case.settings, seed=seed)
    generator = np.random.default_rng(seed)
    env.reset()
    # Once before the clock: compiled functions are loaded, memory is touched.
    env.step(generator.integers(len(ACTION_NAMES), size=case.agents))
    rates, raw_rates, steps, rays = [], [], 0, 0
    for _ in range(_ROUNDS):
        simulator.start()
        done, took = _steps(env, generator, seconds / _ROUNDS)
        simulator.stop()
        rates.append(done / took)
        steps += done
        rays += simulator.count
        if not case.settings.lookup:
            cast, took = simulator.replay()
            raw_rates.append(cast / took)
    row = {
        "agents": case.agents,
        "lookup": "on" if case.settings.lookup else "off",
        "image": case.image,
        "steps_per_s": statistics.median(rates),
        "rays_cast_per_step": rays / steps,
    }
    return row if case.settings.lookup else row | _raw(row, rates, raw_rates)


def _steps(env: AVPVecEnv, generator: np.random.Generator, seconds: float) -> tuple[int, float]:
    """Steps of all agents together, and the time they took."""
    done, start = 0, time.perf_counter()
    while True:
        env.step(generator.integers(len(ACTION_NAMES), size=env.num_envs))
        done += env.num_envs
        if (took := time.perf_counter() - start) >= seconds:
            return done, took


def _raw(row: dict[str, Any], rates: list[float], raw_rates: list[float]) -> dict[str, Any]:
    """What casting the row's rays alone allows, and the share of it that the environment reaches."""
    per_step = row["rays_cast_per_step"]
    return {
        "raw_rays_per_s": statistics.median(raw_rates),
        "raw_steps_per_s": statistics.median(raw_rates) / per_step,
        "share": statistics.median(rate * per_step / raw for rate, raw in zip(rates, raw_rates, strict=True)),
    }


def _over_definition(row: dict[str, Any], cast: dict[str, Any]) -> dict[str, Any]:
    """A row with lookup beside the raw rate of the row that casts the rays of the same views."""
    raw = {key: cast[key] for key in ("raw_rays_per_s", "raw_steps_per_s")}
    return row | raw | {"share": row["steps_per_s"] / raw["raw_steps_per_s"]}


if __name__ == "__main__":
    sys.exit(command.run(main))
