"""Per scene: which floor cells can be seen from a place, and the depth statistics of every view from it.

From each point of a lattice over the floor, rays to all cells in range and all around are cast once. A place between
the points takes its depth statistics from the four around it by bilinear interpolation. A cell that all four see is
visible, one that none of them sees is hidden; the few on which they differ are left to a ray from the place itself.
Tables are made tile by tile where agents come, so large scenes cost what is visited of them, and are kept on disk.
"""

import hashlib
import weakref
from collections.abc import Callable, Hashable
from dataclasses import astuple
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.sight import panorama
from avp_habitat.sight.bits import Bits, pack, words_for
from avp_habitat.sight.lattice import Columns, Lattice, PlaceTable
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.floating]
Made = TypeVar("Made")

SPACING_M = 0.1
"""Distance between lattice points in metres. At 0.2 m the least depth is off by twice as much (docs/training.md)."""

_VERSION = 3
# Six square images around a place; a little wider than a quarter turn, so that no point falls between two of them.
_AROUND = camera_to_world(
    np.zeros((6, 3)), yaw=np.radians([0.0, 90, 180, 270, 0, 0]), pitch=np.radians([0.0, 0, 0, 0, 90, -90])
)
_SIDE = Intrinsics.from_hfov(640, 640, hfov_deg=91.0)


def single_rays(simulator: Simulator, asker: str) -> SingleRays:
    """The simulator itself, where it casts single rays.

    Args:
        simulator: any.
        asker: option that needs them, for the error's text.

    Raises:
        UsageError: it shows whole images only.
    """
    if isinstance(simulator, SingleRays):
        return simulator
    raise UsageError(
        f"{asker}: needs single rays in all directions, which the simulator {simulator.name!r} does not cast; leave "
        f"{asker} off, or use the simulator 'raycast'"
    )


def reached_around(
    simulator: Simulator, eye: Float, points: Float, pairs: NDArray[np.integer], *, tolerance_m: float
) -> NDArray[np.bool_]:
    """Whether rays reach points in any direction: cast one by one where the simulator can, else read in panoramas.

    Args:
        simulator: of the scene.
        eye: `(n, 3)` metres, world frame.
        points: `(m, 3)` metres, world frame.
        pairs: `(k, 2)` rows (eye, point).
        tolerance_m: a hit this close before the point still reaches it, metres along the ray.

    Returns:
        `(k,)`.
    """
    if isinstance(simulator, SingleRays):
        return simulator.reached(eye, points, pairs, tolerance_m=tolerance_m)
    pose = np.tile(_AROUND, (len(eye), 1, 1))
    pose[:, :3, 3] = np.repeat(eye, len(_AROUND), axis=0)
    ahead = -_AROUND[:, :3, 2]
    side = ((points[pairs[:, 1]] - eye[pairs[:, 0]]) @ ahead.T).argmax(axis=1)
    images = np.stack([len(_AROUND) * pairs[:, 0] + side, pairs[:, 1]], axis=1)
    return simulator.visible(pose, _SIDE, points, images, tolerance_m=tolerance_m)


def seen_bits(simulator: Simulator, eye: Float, points: Float, *, reach_m: Float | float, tolerance_m: float) -> Bits:
    """Look from every place at every point in reach.

    Args:
        simulator: of the scene.
        eye: `(k, 3)` places, metres.
        points: `(m, 3)` metres.
        reach_m: points farther away are not seen, metres; one number, or `(m,)`.
        tolerance_m: a hit this close before a point still reaches it, metres along the ray.

    Returns:
        `(k, words)` bit sets of the points that are seen from each place.
    """
    pairs = np.argwhere(((points[None] - eye[:, None]) ** 2).sum(axis=-1) <= np.square(reach_m))
    seen = reached_around(simulator, eye, points, pairs, tolerance_m=tolerance_m)
    members = np.zeros((len(eye), len(points)), dtype=np.bool_)
    members[pairs[seen, 0], pairs[seen, 1]] = True
    return pack(members)


_kept: weakref.WeakKeyDictionary[Simulator, dict[Hashable, Any]] = weakref.WeakKeyDictionary()


def once_per_simulator(simulator: Simulator, key: Hashable, make: Callable[[], Made]) -> Made:
    """What was made of an open simulator before, or is made now; it lives as long as the simulator.

    Args:
        simulator: which the result must not hold.
        key: what is made, and all that it depends on besides the simulator.
        make: makes it.
    """
    known = _kept.setdefault(simulator, {})
    if key not in known:
        known[key] = make()
    return known[key]


def pitches(settings: TaskSettings) -> tuple[float, ...]:
    """Pitches of the statistics in radians: multiples of 10° up to the limit, and one beyond unless it is one."""
    most = int(np.ceil(settings.pitch_limit_deg / panorama.PITCH_STEP_DEG - 1e-9))
    return tuple(np.radians(panorama.PITCH_STEP_DEG * np.arange(-most, most + 1)).tolist())


def scene_tables(simulator: SingleRays, settings: TaskSettings) -> PlaceTable:
    """The tables for a scene and a task; tasks on the same open simulator share them.

    Returns:
        Columns `visible`, `(slots, words)` bit sets of the cells seen from each place, and `statistics`, `(slots,
        yaws, pitches, 2)` least and mean depth, 65535 for the whole range.
    """
    key = ("cells", *_numbers(settings))
    return once_per_simulator(simulator, key, lambda: make_scene_tables(simulator, settings))


def _numbers(settings: TaskSettings) -> tuple[Any, ...]:
    """What the tables depend on besides the scene."""
    camera = settings.sensor_height_m, astuple(settings.intrinsics), settings.pitch_limit_deg
    return *camera, settings.max_range_m, settings.tolerance_m, SPACING_M


def make_scene_tables(simulator: SingleRays, settings: TaskSettings) -> PlaceTable:
    """Tables as `scene_tables` gives them, shared with nobody."""
    # Bits stand for cells: another NavMesh of the same scene has others.
    cells = simulator.area.centres
    name = hashlib.sha256(cells.tobytes() + f"{simulator.scene_digest} {_VERSION} {_numbers(settings)}".encode())
    samples = panorama.view_samples(settings.intrinsics, pitches(settings))
    empty = {"statistics": np.zeros((0, panorama.YAWS, len(pitches(settings)), 2), dtype=np.uint16)}

    def statistics(rays: SingleRays, eye: Float) -> Columns:
        return {"statistics": panorama.view_statistics(panorama.look_around(rays, eye), samples, settings.max_range_m)}

    return point_table(simulator, settings, cells, name.hexdigest(), empty, statistics)


def point_table(
    simulator: SingleRays,
    settings: TaskSettings,
    points: Float,
    digest: str,
    empty: Columns | None = None,
    further: Callable[[SingleRays, Float], Columns] = lambda rays, eye: {},
) -> PlaceTable:
    """A table whose column `visible` holds the bit sets of the points seen from each place.

    Args:
        simulator: casts the rays.
        settings: of the task.
        points: `(m, 3)` metres.
        digest: of all that the columns follow from, hexadecimal.
        empty: further columns by name, without rows.
        further: those columns, of a simulator and `(k, 3)` places of cameras in metres.
    """
    # Not held: the table lives as long as the simulator, whose users hold it.
    rays: SingleRays = weakref.proxy(simulator)
    # A place is less than a lattice diagonal away from its points, so that points a little out of range count too.
    reach_m, tolerance_m = settings.max_range_m + 2 * SPACING_M, settings.tolerance_m

    def compute(feet: Float) -> Columns:
        eye = feet + [0.0, settings.sensor_height_m, 0.0]
        return {"visible": seen_bits(rays, eye, points, reach_m=reach_m, tolerance_m=tolerance_m), **further(rays, eye)}

    columns = {"visible": np.zeros((0, words_for(len(points))), dtype=np.uint64), **(empty or {})}
    return PlaceTable(Lattice(simulator.area, SPACING_M), digest[:32], columns, compute)
