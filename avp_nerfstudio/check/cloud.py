"""The fused cloud of a rollout and the outlines of its cameras, for pictures and files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.images import read_rgb
from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.rollout import Rollout
from avp_nerfstudio.check.depth_maps import DepthMaps
from avp_nerfstudio.check.hypotheses import Cameras

Float = NDArray[np.floating]

BAD_COLOUR = (255, 48, 48)
"""Of frames that disagree."""
GOOD_COLOUR = (64, 160, 255)
"""Of all others."""
FRUSTUM_M = 0.2
_FRAMES = 400
_POINTS = 2400


@dataclass(frozen=True)
class Cloud:
    """Coloured points."""

    points: Float
    """`(m, 3)` metres, world frame."""
    colours: NDArray[np.uint8]
    """`(m, 3)` as photographed; those of frames that disagree are red."""


def fuse(rollout: Rollout, maps: DepthMaps, cameras: Cameras, bad: NDArray[np.bool_]) -> Cloud:
    """Back-project some points of every frame; of more than 400 frames, of those that are spread evenly."""
    n = len(maps)
    chosen = np.unique(np.linspace(0, n - 1, min(n, _FRAMES)).round().astype(int))
    chosen = np.union1d(chosen, np.flatnonzero(bad)[:_FRAMES])
    views = rollout.frames + rollout.heldout
    points: list[Float] = []
    colours: list[NDArray[np.uint8]] = []
    for frame in chosen:
        found, _ = maps.surface(int(frame), cameras.poses[frame], cameras.intrinsics, _POINTS)
        picture = read_rgb(views[frame].image)[:: maps.stride, :: maps.stride].reshape(-1, 3)
        colour = picture[maps.samples[frame, : len(found)]]
        points.append(found)
        colours.append(np.full_like(colour, BAD_COLOUR) if bad[frame] else colour)
    return Cloud(np.concatenate(points), np.concatenate(colours))


def frusta(cameras: Cameras, length_m: float = FRUSTUM_M) -> Float:
    """`(n, 11, 3)` one line per camera that draws its pyramid of view, metres, world frame."""
    k = cameras.intrinsics
    # A camera of 2x2 pixels whose centres are the corners of the picture.
    corners = pixel_directions(
        Intrinsics(2, 2, k.fx / k.width, k.fy / k.height, k.cx / k.width + 0.5, k.cy / k.height + 0.5)
    ).reshape(4, 3)
    upper_left, upper_right, lower_left, lower_right = corners * length_m
    tip = np.zeros(3)
    line = np.stack([tip, upper_left, upper_right, tip, lower_right, lower_left, tip, upper_left])
    line = np.concatenate([line, np.stack([lower_left, lower_right, upper_right])])
    return np.einsum("nij,kj->nki", cameras.poses[:, :3, :3], line) + cameras.poses[:, None, :3, 3]


def frustum_colours(bad: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """`(n, 3)` red for frames that disagree, blue for others."""
    return np.where(bad[:, None], np.array(BAD_COLOUR), np.array(GOOD_COLOUR)).astype(np.uint8)


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write the cloud as binary PLY with Open3D.

    Raises:
        OSError: it could not be written.
    """
    import open3d as o3d

    written = o3d.geometry.PointCloud()
    written.points = o3d.utility.Vector3dVector(cloud.points)
    written.colors = o3d.utility.Vector3dVector(cloud.colours / 255)
    if not o3d.io.write_point_cloud(str(path), written):  # pyright: ignore[reportArgumentType]
        raise OSError(f"Open3D could not write {path.name}")
