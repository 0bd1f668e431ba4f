"""Matches as viewing rays: how far they are from where poses allow them, and relative poses from them alone."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from avp_habitat.poses import Intrinsics, habitat_to_opencv
from avp_nerfstudio.check.colmap import colmap_camera
from avp_nerfstudio.check.pictures.matching import Matches, best_pairs, quiet_colmap, ransac_options

Float = NDArray[np.floating]

# Nothing that a frame shows well is nearer than this: it bounds where a feature of one picture can lie in another.
NEAREST_M = 0.2
# Below this shift of the features, the rotation compensated, a pair is a turn on the spot: no direction can be told.
MIN_PARALLAX_PX = 3.0
# Too few matches, or matches in a corner, leave the estimate itself uncertain by more than the limits.
MIN_RELATIVE_MATCHES = 60
MAX_ERROR_PX = 1.5
PAIRS_OF_A_FRAME = 6
_STACKED = 60


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


def stack_matches(matches: Matches) -> Stacked:
    """At most 60 matches of each pair, evenly chosen, side by side."""
    pixels = [matches.pixels(pair)[:, :: -(-len(pair.features) // _STACKED)] for pair in matches.pairs]
    counts = np.array([part.shape[1] for part in pixels], dtype=int)
    return Stacked(
        np.repeat(np.arange(len(pixels)), counts),
        np.array([pair.first for pair in matches.pairs], dtype=int),
        np.array([pair.second for pair in matches.pairs], dtype=int),
        np.concatenate([[0], np.cumsum(counts)]),
        np.array([len(pair.features) for pair in matches.pairs], dtype=int),
        np.concatenate([np.empty((2, 0, 2)), *pixels], axis=1),
    )


def viewing_rays(pixels: Float, intrinsics: Intrinsics) -> Float:
    """`(..., 3)` unit directions in opencv camera axes of `(..., 2)` pixels."""
    rays = np.ones((*pixels.shape[:-1], 3))
    rays[..., 0] = (pixels[..., 0] - intrinsics.cx) / intrinsics.fx
    rays[..., 1] = (pixels[..., 1] - intrinsics.cy) / intrinsics.fy
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def ray_errors(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> Float:
    """How far each match lies from where `(n, 4, 4)` habitat poses allow it, `(m,)` in pixels at the image centre.

    A feature of the first picture lies somewhere on its viewing ray, from `NEAREST_M` to infinity; the second camera
    sees that as an arc of a great circle. The error is the angle from the match's ray to this arc, times the focal
    length. Unlike an epipolar distance, it is defined for cameras that only turned and for any pair of axes.
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


@dataclass(frozen=True)
class RelativePoses:
    """What the pictures alone say of k pairs: second camera from first, opencv axes."""

    first: NDArray[np.int64]
    """`(k,)` place of the first picture in `Matches.names`."""
    second: NDArray[np.int64]
    """`(k,)` place of the second picture in `Matches.names`."""
    rotation: NDArray[np.float64]
    """`(k, 3, 3)`."""
    direction: NDArray[np.float64]
    """`(k, 3)` unit translation; NaN where the camera only turned."""


def estimate_relative_poses(matches: Matches, intrinsics: Intrinsics) -> RelativePoses:
    """Essential matrices (LO-RANSAC, then refined) of pairs with parallax, rotations alone of the others."""
    rows = []
    camera = colmap_camera(intrinsics)
    with quiet_colmap():
        for pair in best_pairs(matches.pairs, PAIRS_OF_A_FRAME, least=MIN_RELATIVE_MATCHES):
            pixels = matches.pixels(pair)
            rotation, parallax_px = _turn(viewing_rays(pixels, intrinsics), intrinsics)
            direction = np.full(3, np.nan)
            if parallax_px >= MIN_PARALLAX_PX:
                found = _essential(camera, pixels)
                if found is None:
                    continue
                rotation, direction = found
            rows.append((pair.first, pair.second, rotation, direction))
    return RelativePoses(
        np.array([row[0] for row in rows], dtype=int),
        np.array([row[1] for row in rows], dtype=int),
        np.array([row[2] for row in rows]).reshape(-1, 3, 3),
        np.array([row[3] for row in rows]).reshape(-1, 3),
    )


def relative_errors(estimated: RelativePoses, poses: Float) -> tuple[Float, Float]:
    """Difference of `(n, 4, 4)` poses with habitat axes from the estimated relative ones.

    Returns:
        `(k,)` degrees between the rotations, and `(k,)` degrees between the directions of translation: NaN where
        the pictures show a turn on the spot, 90 where only the poses do.
    """
    camera = habitat_to_opencv(poses)
    from_first = np.linalg.inv(camera[estimated.second]) @ camera[estimated.first]
    between = np.einsum("kij,klj->kil", from_first[:, :3, :3], estimated.rotation)
    rotation_deg = np.degrees(Rotation.from_matrix(between).magnitude())
    moved = np.linalg.norm(from_first[:, :3, 3], axis=-1)
    cosine = np.einsum("ki,ki->k", from_first[:, :3, 3], estimated.direction) / np.maximum(moved, 1e-9)
    return rotation_deg, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def frame_medians(estimated: RelativePoses, errors: Float, count: int) -> Float:
    """`(count,)` median over each picture's pairs of `(k,)` errors, NaN for a picture without pairs."""
    medians = np.full(count, np.nan)
    for picture in set(estimated.first) | set(estimated.second):
        medians[picture] = np.median(errors[(estimated.first == picture) | (estimated.second == picture)])
    return medians


def _turn(rays: Float, intrinsics: Intrinsics) -> tuple[Float, float]:
    """Rotation that best carries `(2, m, 3)` rays of the first camera to the second's, and the parallax it leaves.

    Kabsch's solution, three times over the half that fits best, so that near things and false matches do not pull.
    """
    kept = np.ones(rays.shape[1], dtype=bool)
    rotation, left = np.eye(3), np.zeros(rays.shape[1])
    for _ in range(3):
        u, _, vt = np.linalg.svd(rays[1][kept].T @ rays[0][kept])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        left = np.linalg.norm(rays[1] - rays[0] @ rotation.T, axis=-1)
        kept = left <= np.median(left)
    return rotation, float(np.percentile(left, 75) * np.sqrt(intrinsics.fx * intrinsics.fy))


def _essential(camera: pycolmap.Camera, pixels: Float) -> tuple[Float, Float] | None:
    options = ransac_options(MAX_ERROR_PX, most=1000)
    found = pycolmap.estimate_relative_pose(camera, pixels[0], camera, pixels[1], options)
    if found is None or found["num_inliers"] < MIN_RELATIVE_MATCHES:
        return None
    refined = pycolmap.refine_relative_pose(
        found["cam2_from_cam1"], camera, pixels[0], camera, pixels[1], found["inlier_mask"]
    )
    pose = (refined or found)["cam2_from_cam1"].matrix()
    return pose[:, :3], pose[:, 3] / np.linalg.norm(pose[:, 3])
