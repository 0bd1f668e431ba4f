"""How much of what held-out views show the captured frames have seen, from depth and poses alone.

A held-out pixel is *seen* by a frame when the point of its surface projects into the frame's image, in front of the
camera, and the frame's depth there is that point's depth within `max(TOLERANCE_M, TOLERANCE_SHARE * depth)`. Depth is
read between pixels (`rules.inverse_depths`), so that no slope widens the tolerance. Of the tolerances tried, from 5 mm
to 5 cm, this one came closest to occlusion rays (within 0.5 % of the pixels in cluttered rooms): a wider one sees
through cloth, books and panels, a narrower one loses curved surfaces.

Reconstruction cannot show what no frame has seen, so the share of seen pixels predicts its quality before any training.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.metrics import ALIKE_DEG, ALIKE_DISTANCE, PARALLAX_DEG
from avp_habitat.poses import Intrinsics, pixel_directions

Float = NDArray[np.floating]
DepthView = tuple[Float, Float]
"""`(height, width)` planar depth in metres, 0 = none, and its `(4, 4)` habitat camera_to_world."""

TOLERANCE_M = 0.01
"""Depths this close are of the same surface, metres."""
TOLERANCE_SHARE = 0.005
"""Or this close as a share of the depth, whichever is more."""
PIXELS_PER_VIEW = 1200
"""About so many pixels of each held-out view are tested by default: every 16th row and column of 640x480."""

# Multiples of these, without their whole parts, fill the unit square evenly: the powers of 1 / 1.3247…, the root of
# x³ = x + 1 (the R2 sequence).
_SPREAD = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True)
class HeldoutPoints:
    """The surface points of m pixels of held-out views."""

    xyz: Float
    """`(m, 3)` metres, world frame."""
    view: NDArray[np.int64]
    """`(m,)` index of the view of each."""
    eyes: Float
    """`(n, 3)` the views' camera centres, metres, world frame."""


@dataclass(frozen=True)
class Visibility:
    """What the captured frames have seen of m held-out pixels."""

    view: NDArray[np.int64]
    """`(m,)` index of each pixel's held-out view."""
    views: int
    """Number of held-out views."""
    frames: int
    """Number of captured frames."""
    first: NDArray[np.int64]
    """`(m,)` index of the first frame that saw the pixel's surface; `frames` where none did."""
    count: NDArray[np.int64]
    """`(m,)` how many frames saw it."""
    likeness: NDArray[np.float64]
    """`(m,)` within [0, 1]: the greatest cos(turn of the ray) · min(1, held-out distance / frame's distance)."""
    alike: NDArray[np.bool_]
    """`(m,)` whether a frame saw it from within `ALIKE_DEG` and `ALIKE_DISTANCE` times the distance."""
    aside: NDArray[np.int64]
    """`(m,)` index of the first frame that saw it along a ray `PARALLAX_DEG` or more from that of the first frame that
    did; `frames` where none did."""

    @property
    def parallax(self) -> NDArray[np.bool_]:
        """`(m,)` whether a frame saw it along a ray `PARALLAX_DEG` or more from that of the first frame that did."""
        return self.aside < self.frames

    def figures(self) -> dict[str, float]:
        """Shares of the tested pixels, within [0, 1]; no figure at all when no pixel shows a surface.

        visibility: seen by a frame; visibility_2_frames: by two or more; visibility_weighted: mean likeness.
        """
        if not len(self.view):
            return {}
        figures = {
            "visibility": self.count >= 1,
            "visibility_2_frames": self.count >= 2,
            "visibility_3_frames": self.count >= 3,
            "visibility_alike": self.alike,
            "visibility_parallax": self.parallax,
            "visibility_weighted": self.likeness,
        }
        return {name: float(np.mean(values)) for name, values in figures.items()}

    def per_view(self) -> NDArray[np.float64]:
        """`(views,)` share of each held-out view's tested pixels that a frame saw; NaN where it shows no surface."""
        tested = np.bincount(self.view, minlength=self.views)
        seen = np.bincount(self.view, self.count >= 1, minlength=self.views)
        return np.divide(seen, tested, out=np.full(self.views, np.nan), where=tested > 0)

    def curve(self, *, parallax: bool = False) -> NDArray[np.float64]:
        """`(frames,)` share of the tested pixels seen by the first 1, 2, 3, … frames; NaN without tested pixels.

        With `parallax`, the share that they have seen along two rays `PARALLAX_DEG` or more apart.
        """
        new = np.bincount(self.aside if parallax else self.first, minlength=self.frames + 1)[: self.frames]
        return np.cumsum(new) / len(self.view) if len(self.view) else np.full(self.frames, np.nan)


def grid_stride(intrinsics: Intrinsics, pixels: int = PIXELS_PER_VIEW) -> int:
    """Every how many-th row and column gives about so many pixels of a picture, at least 1."""
    return max(1, round((intrinsics.width * intrinsics.height / pixels) ** 0.5))


def heldout_points(views: Iterable[DepthView], intrinsics: Intrinsics, *, stride: int) -> HeldoutPoints:
    """The surface points of every `stride`-th row and column of each held-out view; pixels without depth are left out.

    Each view's grid begins at a row and column of its own, the same ones every time, so that edges that lie alike in
    many views do not fall through all grids together.

    Raises:
        ValueError: the stride is below 1.
    """
    if stride < 1:
        raise ValueError(f"expected a stride of at least 1, got {stride}")
    directions = pixel_directions(intrinsics)
    points: list[Float] = [np.zeros((0, 3))]
    eyes: list[Float] = [np.zeros((0, 3))]
    index = [np.zeros(0, np.int64)]
    for number, (depth, pose) in enumerate(views):
        row, column = ((number + 0.5) * _SPREAD % 1 * stride).astype(int)
        grid = (slice(row, None, stride), slice(column, None, stride))
        planar = np.asarray(depth)[grid]
        shown = planar > 0
        local = directions[grid][shown] * planar[shown, None]
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        index.append(np.full(len(points[-1]), number))
        eyes.append(pose[None, :3, 3])
    return HeldoutPoints(np.concatenate(points), np.concatenate(index), np.concatenate(eyes))


def points_seen(depth: Float, camera_to_world: Float, intrinsics: Intrinsics, points: Float) -> NDArray[np.int64]:
    """`(k,)` which points a frame sees, by ascending index.

    Args:
        depth: `(height, width)` planar depth in metres, 0 where nothing was hit.
        camera_to_world: `(4, 4)` habitat pose.
        intrinsics: of the frame.
        points: `(m, 3)` metres, world frame.
    """
    # Late, so that who only asks for the limits above, as every table of figures does, loads no Numba.
    from avp_habitat.sight.rules import agreeing_depths, camera_numbers

    pose, camera = np.ascontiguousarray(camera_to_world, np.float64), camera_numbers(intrinsics)
    tolerances = TOLERANCE_M, TOLERANCE_SHARE
    return np.flatnonzero(agreeing_depths(np.ascontiguousarray(depth), pose, camera, points, *tolerances))


def visibility(points: HeldoutPoints, frames: Iterable[DepthView], intrinsics: Intrinsics) -> Visibility:
    """Look for the surfaces of held-out pixels in captured frames, in the order of capture, one in memory at a time."""
    total, number = len(points.xyz), 0
    count, first = np.zeros(total, np.int64), np.zeros(total, np.int64)
    likeness, alike = np.zeros(total), np.zeros(total, bool)
    aside = np.full(total, np.iinfo(np.int64).max)
    wanted, wanted_m = _rays(points.xyz, points.eyes[points.view])
    first_ray = np.zeros((total, 3))
    for number, (depth, pose) in enumerate(frames, start=1):
        seen = points_seen(depth, pose, intrinsics, points.xyz)
        ray, distance_m = _rays(points.xyz[seen], pose[:3, 3])
        new = count[seen] == 0
        first[seen[new]], first_ray[seen[new]] = number - 1, ray[new]
        count[seen] += 1
        cosine, ratio = _cosine(ray, wanted[seen]), distance_m / wanted_m[seen]
        likeness[seen] = np.maximum(likeness[seen], cosine / np.maximum(ratio, 1.0))
        alike[seen] |= (cosine >= np.cos(np.radians(ALIKE_DEG))) & (ratio <= ALIKE_DISTANCE)
        apart = seen[_cosine(ray, first_ray[seen]) <= np.cos(np.radians(PARALLAX_DEG))]
        aside[apart] = np.minimum(aside[apart], number - 1)
    first[count == 0] = number
    return Visibility(points.view, len(points.eyes), number, first, count, likeness, alike, np.minimum(aside, number))


def _rays(points: Float, eyes: Float) -> tuple[Float, Float]:
    """Unit vectors from eyes to `(k, 3)` points and the `(k,)` distances in metres."""
    offset = points - eyes
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    return offset / distance[:, None], distance


def _cosine(a: Float, b: Float) -> Float:
    return np.einsum("ki,ki->k", a, b)
