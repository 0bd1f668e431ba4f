"""Rooms of a few quads whose floors, roofs and heights are known, and a data set with an object in one of them."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avp_habitat.scenes.export import export_glb
from avp_habitat.scenes.mesh import TexturedMesh

Quad = tuple[Sequence[Sequence[float]], Sequence[float]]
"""Four corners, anticlockwise as seen from the visible side, and a colour."""


def mesh_of(quads: Sequence[Quad]) -> TexturedMesh:
    """Two triangles for each quad, no vertex shared, so that colours end at edges."""
    count = len(quads)
    vertices = np.array([corners for corners, _ in quads], np.float32).reshape(-1, 3)
    colours = np.repeat(np.array([colour for _, colour in quads], np.float32), 4, axis=0)
    triangles = (4 * np.arange(count)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3).astype(np.int32)
    return TexturedMesh(
        vertices, triangles, np.zeros((len(vertices), 2), np.float32), colours, np.full(2 * count, -1, np.int32)
    )


def block(low: Sequence[float], high: Sequence[float], colour: Sequence[float], *, room: bool = False) -> list[Quad]:
    """Six sides, each a little darker than the one before, seen from outside, or from inside of a `room`."""
    (x, y, z), (a, b, c) = low, high
    sides = [
        [(x, b, z), (x, b, c), (a, b, c), (a, b, z)],
        [(x, y, z), (a, y, z), (a, y, c), (x, y, c)],
        [(x, y, z), (x, y, c), (x, b, c), (x, b, z)],
        [(a, y, c), (a, y, z), (a, b, z), (a, b, c)],
        [(x, y, c), (a, y, c), (a, b, c), (x, b, c)],
        [(a, y, z), (x, y, z), (x, b, z), (a, b, z)],
    ]
    return [
        (side[::-1] if room else side, [part * (1 - 0.1 * number) for part in colour])
        for number, side in enumerate(sides)
    ]


def furnished() -> list[Quad]:
    """A room of 6 x 2.8 x 4 m with a cupboard off its middle; floor at y = 0, no symmetry."""
    return [
        *block((-3, 0, -2), (3, 2.8, 2), (0.8, 0.7, 0.6), room=True),
        *block((0.5, 0, -2), (2, 1.9, -0.8), (0.3, 0.5, 0.9)),
    ]


def roofed() -> list[Quad]:
    """A room below a flat roof that is larger than it and that an agent could stand on."""
    return [*furnished(), *block((-4, 2.85, -3), (4, 3, 3), (0.4, 0.2, 0.2))]


def storeys() -> list[Quad]:
    """Two rooms on each other, the lower one larger, below a roof larger than both."""
    return [
        *furnished(),
        *block((-2, 3, -2), (2, 5.8, 2), (0.7, 0.8, 0.6), room=True),
        *block((-4, 5.85, -3), (4, 6, 3), (0.4, 0.2, 0.2)),
    ]


RAMP = ((-4.0, -2.0, 2.0, 4.0), (0.0, 0.0, 1.0, 1.0))
"""x and y of the corners of `ramp`, metres."""


def ramp() -> list[Quad]:
    """A slope of 1 in 4 between two level floors, 2 m wide, under the open sky."""
    ends = list(zip(*RAMP, strict=True))
    return [
        ([(x, y, -1), (x, y, 1), (a, b, 1), (a, b, -1)], (0.5 + 0.1 * number, 0.6, 0.6))
        for number, ((x, y), (a, b)) in enumerate(itertools.pairwise(ends))
    ]


def wall() -> list[Quad]:
    """Nothing that anybody could stand on."""
    return [([(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 0)], (0.5, 0.5, 0.5))]


def write_json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def write_room(path: Path, quads: Sequence[Quad]) -> Path:
    """A `.glb`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    export_glb(mesh_of(quads), path)
    return path


def small_dataset(folder: Path, **placed: object) -> Path:
    """A stage `room`, an object `box` of 0.8 x 1 x 0.8 m, and scenes with it at x = -1.5 and without it.

    Args:
        folder: of the data set.
        placed: changes to the object's place in the scene `with`.
    """
    write_room(folder / "stages/room.glb", furnished())
    write_room(folder / "objects/box.glb", block((-0.4, -0.5, -0.4), (0.4, 0.5, 0.4), (0.9, 0.1, 0.1)))
    for kind, name in (("stage", "stages/room"), ("object", "objects/box")):
        asset = {"render_asset": f"{Path(name).name}.glb", "up": [0, 1, 0], "front": [0, 0, -1]}
        write_json(folder / f"{name}.{kind}_config.json", asset)
    place = {"template_name": "box", "translation": [-1.5, 0.5, 0], "translation_origin": "COM", **placed}
    stage = {"stage_instance": {"template_name": "room"}}
    write_json(folder / "scenes/with.scene_instance.json", {**stage, "object_instances": [place]})
    write_json(folder / "scenes/without.scene_instance.json", stage)
    cells = {"stages": "stages", "objects": "objects", "scene_instances": "scenes"}
    config = {cell: {"paths": {".json": [name]}} for cell, name in cells.items()}
    return write_json(folder / "small.scene_dataset_config.json", config)
