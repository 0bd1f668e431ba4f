"""Per scene: which floor cells can be seen from a place, and the depth statistics of every view from it.

From each point of a lattice over the floor, rays to all cells in range and all around are cast once. A place between
the points takes its depth statistics from the four around it by bilinear interpolation. A cell that all four see is
visible, one that none of them sees is hidden; the few on which they differ are left to a ray from the place itself.
Tables are made tile by tile where agents come, so large scenes cost what is visited of them, and are kept on disk.
"""

import hashlib
import weakref
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.sight import panorama
from avp_habitat.sight.rows import Lattice, PlaceRows, TileFiles, words_for
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.floating]

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


def seen_bits(
    simulator: Simulator, eye: Float, points: Float, *, reach_m: Float | float, tolerance_m: float
) -> NDArray[np.uint64]:
    """Look from every place at every point in reach.

    Args:
        simulator: of the scene.
        eye: `(k, 3)` places, metres.
        points: `(m, 3)` metres.
        reach_m: points farther away are not seen, metres; one number, or `(m,)`.
        tolerance_m: a hit this close before a point still reaches it, metres along the ray.

    Returns:
        `(k, words)`: bit j % 64 of word j // 64 says whether point j is seen from the place.
    """
    pairs = np.argwhere(((points[None] - eye[:, None]) ** 2).sum(axis=-1) <= np.square(reach_m))
    seen = reached_around(simulator, eye, points, pairs, tolerance_m=tolerance_m)
    bits = np.zeros((len(eye), words_for(len(points)) * 64), dtype=np.bool_)
    bits[pairs[seen, 0], pairs[seen, 1]] = True
    return np.packbits(bits, axis=1, bitorder="little").view("<u8").astype(np.uint64)


SPACING_M = 0.1
"""Distance between lattice points in metres. At 0.2 m the least depth is off by twice as much (docs/training.md)."""
_VERSION = 3


@dataclass(frozen=True)
class ViewKey:
    """What the tables depend on besides the scene."""

    sensor_height_m: float
    """Height of the camera above the floor, metres."""
    intrinsics: Intrinsics
    """Of the depth image whose statistics are looked up."""
    pitch_limit_deg: float
    """Greatest pitch, degrees."""
    max_range_m: float
    """Range of the depth and of the coverage, metres."""
    tolerance_m: float
    """Of the coverage, metres."""
    spacing_m: float = SPACING_M
    """Of the lattice, metres."""

    @property
    def pitches(self) -> tuple[float, ...]:
        """Pitches of the statistics in radians: multiples of 10° up to the limit, and one beyond unless it is one."""
        most = int(np.ceil(self.pitch_limit_deg / panorama.PITCH_STEP_DEG - 1e-9))
        return tuple(np.radians(panorama.PITCH_STEP_DEG * np.arange(-most, most + 1)).tolist())


class SceneTables:
    """The tables of one scene, growing with the places that were asked for."""

    def __init__(self, simulator: SingleRays, key: ViewKey) -> None:
        """Make empty tables.

        Args:
            simulator: casts the rays.
            key: of the views.
        """
        # Not held: the tables live as long as their simulator, whose users hold it.
        self._simulator: SingleRays = weakref.proxy(simulator)
        self.key = key
        self._samples = panorama.view_samples(key.intrinsics, key.pitches)
        self._directions = panorama.directions().reshape(-1, 3)
        self.lattice = Lattice(simulator.area, key.spacing_m)
        centres = simulator.area.centres
        # Bits stand for cells: another NavMesh of the same scene has others.
        content = hashlib.sha256(centres.tobytes())
        content.update(f"{simulator.scene_digest} {_VERSION} {astuple(key)}".encode())
        empty = {
            "visible": np.zeros((0, words_for(len(centres))), dtype=np.uint64),
            "statistics": np.zeros((0, panorama.YAWS, len(key.pitches), 2), dtype=np.uint16),
        }
        self._rows = PlaceRows(self.lattice, TileFiles(content.hexdigest()[:32]), empty, self._compute)

    @property
    def visible(self) -> NDArray[np.uint64]:
        """`(slots, words)`: bit c % 64 of word c // 64 says whether cell c is seen from the slot's place."""
        return self._rows.columns["visible"]

    @property
    def statistics(self) -> NDArray[np.uint16]:
        """`(slots, yaws, pitches, 2)` least and mean depth, 65535 for the whole range."""
        return self._rows.columns["statistics"]

    def around(self, position: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The slots around places; see `PlaceRows.around`."""
        return self._rows.around(position)

    def _compute(self, feet: NDArray[np.floating]) -> dict[str, NDArray]:
        eye = feet + [0.0, self.key.sensor_height_m, 0.0]
        centres = self._simulator.area.centres
        # A place is less than a lattice diagonal away from its points, so that cells a little out of range count too.
        reach = self.key.max_range_m + 2 * self.key.spacing_m
        visible = seen_bits(self._simulator, eye, centres, reach_m=reach, tolerance_m=self.key.tolerance_m)
        return {"visible": visible, "statistics": self._statistics_from(eye)}

    def _statistics_from(self, eye: NDArray[np.floating]) -> NDArray[np.uint16]:
        origin = np.repeat(eye, len(self._directions), axis=0)
        distance = self._simulator.distance(origin, np.tile(self._directions, (len(eye), 1)))
        around = distance.reshape(len(eye), panorama.AZIMUTHS, panorama.ELEVATIONS)
        return panorama.view_statistics(around, self._samples, self.key.max_range_m)


_shared: weakref.WeakKeyDictionary[SingleRays, dict[ViewKey, SceneTables]] = weakref.WeakKeyDictionary()


def scene_tables(simulator: SingleRays, settings: TaskSettings) -> SceneTables:
    """The tables for a scene and a task; tasks on the same open simulator share them."""
    key = ViewKey(
        sensor_height_m=settings.sensor_height_m,
        intrinsics=settings.intrinsics,
        pitch_limit_deg=settings.pitch_limit_deg,
        max_range_m=settings.max_range_m,
        tolerance_m=settings.tolerance_m,
    )
    known = _shared.setdefault(simulator, {})
    if key not in known:
        known[key] = SceneTables(simulator, key)
    return known[key]
