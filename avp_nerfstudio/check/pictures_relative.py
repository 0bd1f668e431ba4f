"""Relative camera poses estimated from the pictures alone."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, habitat_to_opencv
from avp_nerfstudio.check.colmap_model import colmap_camera
from avp_nerfstudio.check.pictures_matching import Matches, quiet_colmap
from avp_nerfstudio.check.pictures_rays import viewing_rays

Float = NDArray[np.floating]

# Below this shift of the features, the rotation compensated, a pair is a turn on the spot: no direction can be told.
MIN_PARALLAX_PX = 3.0
# Too few matches, or matches in a corner, leave the estimate itself uncertain by more than the limits.
MIN_RELATIVE_MATCHES = 60
MAX_ERROR_PX = 1.5
PAIRS_OF_A_FRAME = 6


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
    """Essential matrices (LO-RANSAC, then refined) of pairs with parallax, rotations alone of the others.

    Args:
        matches: verified ones.
        intrinsics: of all pictures.
    """
    rows = []
    camera = colmap_camera(intrinsics)
    with quiet_colmap():
        for first, second, pixels in _chosen_pairs(matches):
            rotation, parallax_px = _turn(viewing_rays(pixels, intrinsics), intrinsics)
            direction = np.full(3, np.nan)
            if parallax_px >= MIN_PARALLAX_PX:
                found = _essential(camera, pixels)
                if found is None:
                    continue
                rotation, direction = found
            rows.append((first, second, rotation, direction))
    return RelativePoses(
        np.array([row[0] for row in rows], dtype=int),
        np.array([row[1] for row in rows], dtype=int),
        np.array([row[2] for row in rows]).reshape(-1, 3, 3),
        np.array([row[3] for row in rows]).reshape(-1, 3),
    )


def relative_errors(estimated: RelativePoses, poses: Float) -> tuple[Float, Float]:
    """Difference of given poses from the estimated relative ones.

    Args:
        estimated: from the pictures.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, of the pictures.

    Returns:
        `(k,)` degrees between the rotations, and `(k,)` degrees between the directions of translation: NaN where
        the pictures show a turn on the spot, 90 where only the poses do.
    """
    camera = habitat_to_opencv(poses)
    from_first = np.linalg.inv(camera[estimated.second]) @ camera[estimated.first]
    between = np.einsum("kij,klj->kil", from_first[:, :3, :3], estimated.rotation)
    rotation_deg = np.degrees(_rotation_angle(between))
    moved = np.linalg.norm(from_first[:, :3, 3], axis=-1)
    cosine = np.einsum("ki,ki->k", from_first[:, :3, 3], estimated.direction) / np.maximum(moved, 1e-9)
    return rotation_deg, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def frame_medians(estimated: RelativePoses, errors: Float, count: int) -> Float:
    """`(count,)` median over each picture's pairs of `(k,)` errors, NaN for a picture without pairs."""
    medians = np.full(count, np.nan)
    for picture in set(estimated.first) | set(estimated.second):
        medians[picture] = np.median(errors[(estimated.first == picture) | (estimated.second == picture)])
    return medians


def _chosen_pairs(matches: Matches) -> list[tuple[int, int, Float]]:
    """The richest pairs of each frame: first, second, `(2, m, 2)` pixels."""
    taken = np.zeros(len(matches.names), dtype=int)
    chosen = []
    for pair in sorted(matches.pairs, key=lambda pair: -len(pair.features)):
        rich = len(pair.features) >= MIN_RELATIVE_MATCHES
        if rich and min(taken[pair.first], taken[pair.second]) < PAIRS_OF_A_FRAME:
            taken[[pair.first, pair.second]] += 1
            pixels = [matches.features[p][pair.features[:, k]] for k, p in enumerate((pair.first, pair.second))]
            chosen.append((pair.first, pair.second, np.array(pixels)))
    return chosen


def _rotation_angle(rotation: Float) -> Float:
    """`(k,)` radians of `(k, 3, 3)` rotations; exact for small angles too."""
    sine = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=-1,
    )
    return np.arctan2(np.linalg.norm(sine, axis=-1), np.trace(rotation, axis1=-2, axis2=-1) - 1)


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
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_ERROR_PX
    options.min_num_trials, options.max_num_trials = 100, 1000
    options.random_seed = 0
    found = pycolmap.estimate_relative_pose(camera, pixels[0], camera, pixels[1], options)
    if found is None or found["num_inliers"] < MIN_RELATIVE_MATCHES:
        return None
    refined = pycolmap.refine_relative_pose(
        found["cam2_from_cam1"], camera, pixels[0], camera, pixels[1], found["inlier_mask"]
    )
    pose = (refined or found)["cam2_from_cam1"].matrix()
    return pose[:, :3], pose[:, 3] / np.linalg.norm(pose[:, 3])
