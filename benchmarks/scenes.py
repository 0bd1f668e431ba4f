"""How costs grow with a scene: with its triangles, and with the cells of its floor.

Two series. `room`: a generated room whose triangles are each split into n², with the corners moved by up to 2 mm so
that the pieces are not coplanar. `hall`: an empty hall of growing floor. Each is written as a `.glb` and loaded from
it. Tables are made for a square of `--tables-m2` in the middle of the floor, in whole tiles; `whole_…` is what the
entire scene takes at the same cost per place: an estimate where `made_share` is below 1.
Agents start in that square. Their steps are walked twice: once to make what tables they still need, once on the clock.
"""

import argparse
import itertools
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import reporting
from numpy.typing import NDArray
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.scenes.export import export_glb
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.sight.lattice import CACHE_VARIABLE as CACHE
from avp_habitat.sight.lattice import TILE, Lattice, PlaceTable
from avp_habitat.sight.tables import scene_tables
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.task.settings import ACTION_NAMES, TaskSettings
from avp_habitat.task.task import ViewpointTask

_BUMP_M = 0.002
_HALL_HEIGHT_M = 3.0
_ROUNDS = 3


@dataclass(frozen=True)
class Case:
    """One scene to measure."""

    series: str
    """room or hall."""
    mesh: TexturedMesh
    """Its surfaces."""


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "scenes")
    add = made.add_argument
    add("--room", default="builtin:1", help=f"the room to subdivide: {SCENES}")
    add("--triangles", default=[10_000, 100_000, 1_000_000], type=int, nargs="*", help="about so many in the room")
    add("--halls", default=[25.0, 100.0, 400.0], type=float, nargs="*", help="floors of the empty halls, m²")
    add("--tables-m2", default=6.0, type=float, help="at most so much floor gets tables")
    add("--agents", default=16, type=int, help="agents stepped as one batch")
    add("--steps", default=4000, type=int, help="environment steps with lookup; a tenth of them casts all rays")
    add("--width", default=160, type=int, help="of the depth image, pixels")
    add("--height", default=120, type=int, help="of the depth image, pixels")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, tables_m2=0.01, agents=1, steps=1, width=1, height=1)
    for name in ("triangles", "halls"):
        if getattr(options, name):
            reporting.check_least(options, **{name: 1})
    with tempfile.TemporaryDirectory() as name, reporting.reported("scenes", options) as results:
        results["scenes"] = []
        results["tables"] = []
        count = len(options.triangles) + len(options.halls)
        # Not measured: what a process imports and compiles once is no scene's cost.
        _measure(Case("first", hall(4.0)), Path(name) / "first", options)
        for index, case in enumerate(tqdm(_cases(options), total=count, desc="scenes")):
            scene, tables = _measure(case, Path(name) / str(index), options)
            results["scenes"].append(scene)
            results["tables"].append(tables)


def subdivided(mesh: TexturedMesh, parts: int) -> TexturedMesh:
    """The same surfaces with every edge in so many parts, moved by up to 2 mm as a function of the place alone.

    Corners at the same place are moved alike and all edges are split alike, so that no cracks open.

    Args:
        mesh: of t triangles.
        parts: n, at least 1; there are t · n² triangles afterwards.
    """
    if parts == 1:
        return mesh
    i, j = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]).T
    weight = np.stack([parts - i - j, i, j], axis=1) / parts
    number = {place: index for index, place in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
    upright = [(number[a, b], number[a + 1, b], number[a, b + 1]) for a, b in number if a + b < parts]
    inverted = [(number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]) for a, b in number if a + b < parts - 1]
    pattern = np.array(upright + inverted)

    def spread(values: NDArray[np.floating]) -> NDArray[np.float32]:
        """`(t · corners, columns)` values of the new corners."""
        mixed = np.einsum("kc,tcd->tkd", weight, values[mesh.triangles].astype(np.float64))
        return mixed.reshape(-1, values.shape[1]).astype(np.float32)

    vertices = spread(mesh.vertices)
    # Rounded, so that both sides of an edge, which sum in another order, see the same place.
    place = np.round(vertices.astype(np.float64), 4)
    vertices = (place + _BUMP_M / np.sqrt(3) * np.sin(37.0 * place[:, [1, 2, 0]] + 53.0 * place[:, [2, 0, 1]])).astype(
        np.float32
    )
    offset = len(weight) * np.arange(len(mesh.triangles))
    return TexturedMesh(
        vertices,
        (offset[:, None, None] + pattern).reshape(-1, 3).astype(np.int32),
        spread(mesh.uv),
        spread(mesh.colours),
        np.repeat(mesh.texture_index, len(pattern)),
        mesh.textures,
    )


def hall(floor_m2: float) -> TexturedMesh:
    """An empty square hall, 3 m high and closed on all sides.

    Args:
        floor_m2: of its floor.
    """
    side = np.sqrt(floor_m2)
    corner = np.array([[x, y, z] for y in (0.0, _HALL_HEIGHT_M) for z in (0.0, side) for x in (0.0, side)])
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = np.array([part for a, b, c, d in faces for part in ((a, b, c), (a, c, d))], np.int32)
    return TexturedMesh(
        corner.astype(np.float32),
        triangles,
        np.zeros((8, 2), np.float32),
        np.full((8, 3), 0.7, np.float32),
        np.full(len(triangles), -1, np.int32),
    )


def _cases(options: argparse.Namespace) -> Iterator[Case]:
    if options.triangles:
        room = load_scene(options.room).mesh
        for wanted in options.triangles:
            parts = max(1, round(np.sqrt(wanted / len(room.triangles))))
            yield Case("room", subdivided(room, parts))
    for floor_m2 in options.halls:
        yield Case("hall", hall(floor_m2))


def _measure(case: Case, folder: Path, options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rows for the scene and for its tables; the scene's file and the cache are in the new `folder`."""
    folder.mkdir()
    # Only this process, which is the whole benchmark, uses the cache.
    os.environ[CACHE] = str(folder)
    path = folder / "scene.glb"
    export_glb(case.mesh, path)
    start = time.perf_counter()
    simulator = RaycastSimulator(load_scene(str(path)))
    load_s = time.perf_counter() - start
    start = time.perf_counter()
    area = simulator.area
    area_s = time.perf_counter() - start
    row = {
        "series": case.series,
        "triangles": len(case.mesh.triangles),
        "cells": len(area.centres),
        "area_m2": area.area_m2,
    }
    settings = TaskSettings(width=options.width, height=options.height)
    middle = _middle(area.centres, round(options.tables_m2 / area.cell_m**2))
    tables = scene_tables(simulator, settings)
    figures = _make_tables(tables, middle, folder)
    speed = {
        "lookup_steps_per_s": _speed(simulator, replace(settings, lookup=True), middle, options, options.steps),
        "cast_steps_per_s": _speed(simulator, settings, middle, options, max(1, options.steps // 10)),
    }
    return row | {"load_s": load_s, "area_s": area_s} | speed, row | figures


def _middle(centres: NDArray[np.floating], count: int) -> NDArray[np.floating]:
    """The cells of a square around the middle of the floor; at least one."""
    away = np.abs(centres - np.median(centres, axis=0))[:, [0, 2]].max(axis=1)
    return centres[np.argsort(away, kind="stable")[: max(1, count)]]


def _make_tables(tables: PlaceTable, places: NDArray[np.floating], folder: Path) -> dict[str, float]:
    """Tables for some places, and what the whole scene would cost at the same cost per place."""
    start = time.perf_counter()
    tables.around(places)
    took = time.perf_counter() - start
    made = len(tables.columns["visible"])
    made_m2 = made * tables.lattice.spacing_m**2
    memory_mb = sum(column.nbytes for column in tables.columns.values()) / 1e6
    disk_mb = sum(file.stat().st_size for file in (folder / "tables").rglob("*.npz")) / 1e6
    share = made / _all_places(tables.lattice)
    return {
        "made_share": share,
        "table_s_per_m2": took / made_m2,
        "memory_mb_per_m2": memory_mb / made_m2,
        "disk_mb_per_m2": disk_mb / made_m2,
        "whole_s": took / share,
        "whole_memory_mb": memory_mb / share,
        "whole_disk_mb": disk_mb / share,
    }


def _all_places(lattice: Lattice) -> int:
    along_x, along_z = (range(-(-points // TILE)) for points in lattice.shape)
    return sum(len(lattice.points_of_tile(tile)) for tile in itertools.product(along_x, along_z))


def _speed(
    simulator: RaycastSimulator,
    settings: TaskSettings,
    starts: NDArray[np.floating],
    options: argparse.Namespace,
    steps: int,
) -> float:
    """Median steps/s of random actions, after the same walk was made once before."""
    task = ViewpointTask(simulator, settings, options.agents)
    calls = -(-steps // (options.agents * _ROUNDS))
    rounds = [_walk(task, starts, calls, seed) for seed in [*range(_ROUNDS), *range(_ROUNDS)]]
    return statistics.median(rounds[_ROUNDS:])


def _walk(task: ViewpointTask, starts: NDArray[np.floating], calls: int, seed: int) -> float:
    """Steps/s; the same seed walks the same way."""
    generator = np.random.default_rng(seed)
    rows = np.arange(task.agents)

    def restart(rows: NDArray[np.integer]) -> None:
        task.reset(rows, generator.choice(starts, len(rows)), generator.uniform(-np.pi, np.pi, len(rows)))

    restart(rows)
    start = time.perf_counter()
    for _ in range(calls):
        outcome = task.step(generator.integers(len(ACTION_NAMES), size=task.agents))
        if (ended := np.flatnonzero(outcome.terminated | outcome.truncated)).size:
            restart(ended)
    return calls * task.agents / (time.perf_counter() - start)


if __name__ == "__main__":
    sys.exit(command.run(main))
