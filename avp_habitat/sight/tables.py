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
from functools import wraps
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
    """The simulator itself, where it casts single rays; `asker` is the option that needs them.

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

    As `SingleRays.reached`: `(k,)` for `(k, 2)` rows (eye, point) of `(n, 3)` and `(m, 3)` metres, world frame.
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
    """`(k, words)` bit sets of the `(m, 3)` points that are seen from each of `(k, 3)` places, metres.

    Points farther away than `reach_m`, one number or `(m,)`, are not seen; a hit within `tolerance_m` before a point
    still reaches it.
    """
    pairs = np.argwhere(((points[None] - eye[:, None]) ** 2).sum(axis=-1) <= np.square(reach_m))
    seen = reached_around(simulator, eye, points, pairs, tolerance_m=tolerance_m)
    members = np.zeros((len(eye), len(points)), dtype=np.bool_)
    members[pairs[seen, 0], pairs[seen, 1]] = True
    return pack(members)


_kept: weakref.WeakKeyDictionary[Simulator, dict[Hashable, Any]] = weakref.WeakKeyDictionary()


def once_per_simulator(*needed: str) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Lets a function of (simulator, settings, **options) make its result once for each open simulator.

    The result lives as long as the simulator, which it must not hold; `__wrapped__` makes one that is not kept.

    Args:
        needed: the settings on which the result depends, by name.
    """

    def decorate(make: Callable[..., Made]) -> Callable[..., Made]:
        @wraps(make)
        def kept(simulator: Simulator, settings: TaskSettings, **options: Any) -> Made:
            known = _kept.setdefault(simulator, {})
            key = make, *(getattr(settings, name) for name in needed), *sorted(options.items())
            if key not in known:
                known[key] = make(simulator, settings, **options)
            return known[key]

        return kept

    return decorate


def pitches(settings: TaskSettings) -> tuple[float, ...]:
    """Pitches of the statistics in radians: multiples of 10° up to the limit, and one beyond unless it is one."""
    most = int(np.ceil(settings.pitch_limit_deg / panorama.PITCH_STEP_DEG - 1e-9))
    return tuple(np.radians(panorama.PITCH_STEP_DEG * np.arange(-most, most + 1)).tolist())


@once_per_simulator("sensor_height_m", "intrinsics", "pitch_limit_deg", "max_range_m", "tolerance_m")
def scene_tables(simulator: SingleRays, settings: TaskSettings) -> PlaceTable:
    """The tables for a scene and a task; tasks on the same open simulator share them.

    Returns:
        Columns `visible`, `(slots, words)` bit sets of the cells seen from each place, and `statistics`, `(slots,
        yaws, pitches, 2)` least and mean depth, 65535 for the whole range.
    """
    camera = settings.sensor_height_m, astuple(settings.intrinsics), settings.pitch_limit_deg
    numbers = *camera, settings.max_range_m, settings.tolerance_m, SPACING_M
    # Bits stand for cells: another NavMesh of the same scene has others.
    cells = simulator.area.centres
    name = hashlib.sha256(cells.tobytes() + f"{simulator.scene_digest} {_VERSION} {numbers}".encode())
    return point_table(simulator, settings, cells, name.hexdigest(), statistics=True)


def point_table(
    simulator: SingleRays, settings: TaskSettings, points: Float, digest: str, *, statistics: bool = False
) -> PlaceTable:
    """A table whose column `visible` holds the bit sets of the points seen from each place.

    Args:
        simulator: casts the rays.
        settings: of the task.
        points: `(m, 3)` metres.
        digest: of all that the columns follow from, hexadecimal.
        statistics: whether it has a column `statistics` as well, as `scene_tables` describes it.
    """
    # Not held: the table lives as long as the simulator, whose users hold it.
    rays: SingleRays = weakref.proxy(simulator)
    # A place is less than a lattice diagonal away from its points, so that points a little out of range count too.
    reach_m, tolerance_m = settings.max_range_m + 2 * SPACING_M, settings.tolerance_m
    samples = panorama.view_samples(settings.intrinsics, pitches(settings))
    empty: dict[str, NDArray] = {"visible": np.zeros((0, words_for(len(points))), dtype=np.uint64)}
    if statistics:
        empty["statistics"] = np.zeros((0, panorama.YAWS, len(samples.azimuth), 2), dtype=np.uint16)

    def compute(feet: Float) -> Columns:
        eye = feet + [0.0, settings.sensor_height_m, 0.0]
        rows: dict[str, NDArray] = {"visible": seen_bits(rays, eye, points, reach_m=reach_m, tolerance_m=tolerance_m)}
        if statistics:
            around = panorama.look_around(rays, eye)
            rows["statistics"] = panorama.view_statistics(around, samples, settings.max_range_m)
        return rows

    return PlaceTable(Lattice(simulator.area, SPACING_M), digest[:32], empty, compute)
