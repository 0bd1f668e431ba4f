"""How far the back-projected depth lies from the scene's surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.loader import Scene
from avp_nerfstudio.check.agreement import TOLERANCE_M
from avp_nerfstudio.check.depth_maps import DepthMaps
from avp_nerfstudio.check.hypotheses import Cameras
from avp_nerfstudio.check.verdict import Verdict

POINTS = 300
"""Points of each frame, at most."""
NEAR_SHARE = 0.995
"""Least share of all points within 2 cm of the mesh; of ten correct rollouts in two rooms every point was."""
NEAR_SHARE_OF_FRAME = 0.98
"""The same for each single frame."""
_FRAMES_PER_CALL = 256


@dataclass(frozen=True)
class MeshDistance:
    """Distances of points to the mesh."""

    verdict: Verdict
    """Whether they are on it."""
    bad: NDArray[np.bool_]
    """`(n,)` frames whose points are not."""


def mesh_distance(maps: DepthMaps, cameras: Cameras, scene: Scene, *, named: str | None) -> MeshDistance:
    """Measure the distance of every frame's points to a mesh.

    Args:
        maps: the depth.
        cameras: poses and intrinsics.
        scene: the mesh.
        named: digest of the scene that `rollout.json` names, None where it names none.
    """
    distances = _distances(maps, cameras, scene)
    near = (distances <= TOLERANCE_M).sum(axis=1)
    counts = np.minimum(maps.counts, POINTS)
    # The points of a frame are repeated where it has few; a frame without any is not judged.
    share = np.where(counts > 0, near / distances.shape[1], np.nan)
    bad = share < NEAR_SHARE_OF_FRAME
    judged = distances[counts > 0]
    overall = float((judged <= TOLERANCE_M).mean()) if judged.size else float("nan")
    passed = not (overall < NEAR_SHARE or bad.any())
    text = (
        f"{100 * overall:.2f} % of {judged.size} points lie within 2 cm of {scene.name} (limit {100 * NEAR_SHARE} %); "
        f"{bad.sum()} of {len(bad)} frames have less than {100 * NEAR_SHARE_OF_FRAME:.0f} %"
    )
    cause = None
    if named not in (None, scene.digest):
        text += "; the file is not the one that rollout.json names (another sha256)"
        cause = f"{scene.name} is not the scene in which the rollout was captured"
    figures = {
        "near_2cm_percent": 100 * overall,
        "mean_mm": 1000 * float(judged.mean()) if judged.size else float("nan"),
        "p95_mm": 1000 * float(np.percentile(judged, 95)) if judged.size else float("nan"),
        "far_frames": float(bad.sum()),
    }
    return MeshDistance(Verdict("mesh distance", passed, text, figures, None if passed else cause), bad)


def _distances(maps: DepthMaps, cameras: Cameras, scene: Scene) -> NDArray[np.float32]:
    """`(n, POINTS)` metres."""
    import open3d as o3d

    casting = o3d.t.geometry.RaycastingScene()
    casting.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(scene.mesh.vertices, np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(scene.mesh.triangles, np.uint32)),
    )
    found = []
    for frames in np.array_split(np.arange(len(maps)), -(-len(maps) // _FRAMES_PER_CALL)):
        rotation, centre = cameras.poses[frames, :3, :3], cameras.poses[frames, None, :3, 3]
        world = maps.local_points(cameras.intrinsics, frames, POINTS) @ np.swapaxes(rotation, 1, 2) + centre
        found.append(casting.compute_distance(o3d.core.Tensor.from_numpy(world.astype(np.float32))).numpy())
    return np.concatenate(found)
