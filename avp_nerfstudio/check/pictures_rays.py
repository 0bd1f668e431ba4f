"""How well matched features agree with given poses, as angles between viewing rays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, habitat_to_opencv
from avp_nerfstudio.check.pictures_matching import Matches

Float = NDArray[np.floating]

# Nothing that a frame shows well is nearer than this: it bounds where a feature of one picture can lie in another.
NEAREST_M = 0.2


@dataclass(frozen=True)
class Stacked:
    """The matches of all pairs in one array each."""

    pair: NDArray[np.int64]
    """`(m,)` pair of each match."""
    first: NDArray[np.int64]
    """`(p,)` first picture of each pair."""
    second: NDArray[np.int64]
    """`(p,)` second picture of each pair."""
    start: NDArray[np.int64]
    """`(p + 1,)` where the matches of each pair begin."""
    count: NDArray[np.int64]
    """`(p,)` all matches of each pair, of which some are here."""
    pixels: NDArray[np.float64]
    """`(2, m, 2)` pixels in the first and in the second picture."""


def stack_matches(matches: Matches, *, limit: int = 60) -> Stacked:
    """At most `limit` matches of each pair, evenly chosen, side by side."""
    kept = [pair.features[:: -(-len(pair.features) // limit)] for pair in matches.pairs]
    counts = np.array([len(rows) for rows in kept], dtype=int)
    sides = [
        [matches.features[picture][rows[:, side]] for picture, rows in zip(pictures, kept, strict=True)]
        for side, pictures in enumerate(
            ([pair.first for pair in matches.pairs], [pair.second for pair in matches.pairs])
        )
    ]
    pixels = np.array([np.concatenate([np.empty((0, 2)), *side]) for side in sides])
    return Stacked(
        np.repeat(np.arange(len(kept)), counts),
        np.array([pair.first for pair in matches.pairs], dtype=int),
        np.array([pair.second for pair in matches.pairs], dtype=int),
        np.concatenate([[0], np.cumsum(counts)]),
        np.array([len(pair.features) for pair in matches.pairs], dtype=int),
        pixels,
    )


def viewing_rays(pixels: Float, intrinsics: Intrinsics) -> Float:
    """`(..., 3)` unit directions in opencv camera axes of `(..., 2)` pixels."""
    rays = np.ones((*pixels.shape[:-1], 3))
    rays[..., 0] = (pixels[..., 0] - intrinsics.cx) / intrinsics.fx
    rays[..., 1] = (pixels[..., 1] - intrinsics.cy) / intrinsics.fy
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def ray_errors(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> Float:
    """How far each match lies from where the poses allow it, in pixels at the image centre.

    A feature of the first picture lies somewhere on its viewing ray, from `NEAREST_M` to infinity; the second camera
    sees that as an arc of a great circle. The error is the angle from the match's ray to this arc, times the focal
    length. Unlike an epipolar distance, it is defined for cameras that only turned and for any pair of axes.

    Args:
        stacked: the matches.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, of the n pictures.
        intrinsics: of all pictures.

    Returns:
        `(m,)` pixels.
    """
    camera = habitat_to_opencv(poses)
    first, second = stacked.first[stacked.pair], stacked.second[stacked.pair]
    rays = viewing_rays(stacked.pixels, intrinsics)
    far = np.einsum("mij,mj->mi", camera[first, :3, :3], rays[0])
    seen = np.einsum("mij,mj->mi", camera[second, :3, :3], rays[1])
    near = NEAREST_M * far - (camera[second, :3, 3] - camera[first, :3, 3])
    near /= np.maximum(np.linalg.norm(near, axis=-1, keepdims=True), 1e-12)
    return _angle_to_arc(seen, far, near) * np.sqrt(intrinsics.fx * intrinsics.fy)


def pair_medians(stacked: Stacked, errors: Float) -> Float:
    """`(p,)` median of the `(m,)` errors of each pair's matches."""
    ranked = errors[np.lexsort((errors, stacked.pair))]
    count = np.diff(stacked.start)
    return (ranked[stacked.start[:-1] + (count - 1) // 2] + ranked[stacked.start[:-1] + count // 2]) / 2


def _angle(a: Float, b: Float) -> Float:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def _angle_to_arc(point: Float, start: Float, end: Float) -> Float:
    """`(m,)` radians from unit vectors to the shorter great-circle arcs between two unit vectors."""
    normal = np.cross(start, end)
    length = np.linalg.norm(normal, axis=-1)
    unit = normal / np.maximum(length, 1e-12)[:, None]
    height = np.sum(point * unit, axis=-1)
    inside = (np.sum(np.cross(start, point) * unit, axis=-1) >= 0) & (np.sum(np.cross(point, end) * unit, axis=-1) >= 0)
    to_ends = np.minimum(_angle(point, start), _angle(point, end))
    return np.where(inside & (length > 1e-9), np.arcsin(np.clip(np.abs(height), 0, 1)), to_ends)
