"""Space that the rollout's depth leaves for surfaces: a grid of voxels, empty wherever no frame has measured one."""

from collections.abc import Iterable

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

_MOST_VOXELS_PER_AXIS = 256
_MARGIN_VOXELS = 2
"""Around measured points; surfaces seen at a grazing angle have points only so often."""


class SurfaceGrid(nn.Module):
    """Which voxels of the scene box may hold matter; all of them until `fill` is called.

    It is part of the checkpoint, so rendering needs no depth.
    """

    occupied: Tensor
    """`(x, y, z)` bool."""
    carved: Tensor
    """`()` bool, whether `fill` has been called."""
    low: Tensor
    """`(3,)` least corner of the scene box, units of the scene."""

    def __init__(self, aabb: Tensor, voxel: float) -> None:
        """Make a grid.

        Args:
            aabb: `(2, 3)` least and greatest corner of the scene box, units of the scene.
            voxel: edge of the voxels, units of the scene; larger where an axis would need more than 256 of them.
        """
        super().__init__()
        extent = (aabb[1] - aabb[0]).cpu()
        self.voxel = max(voxel, float(extent.max()) / _MOST_VOXELS_PER_AXIS)
        shape = torch.ceil(extent / self.voxel).long().clamp_min(1)
        self.register_buffer("low", aabb[0].clone().cpu(), persistent=False)
        self.register_buffer("occupied", torch.ones(tuple(shape.tolist()), dtype=torch.bool))
        self.register_buffer("carved", torch.zeros((), dtype=torch.bool))

    def forward(self, positions: Tensor) -> Tensor:
        """Whether `(..., 3)` positions lie in voxels that may hold matter: `(...)` bool; outside the box none may."""
        index = torch.floor((positions - self.low) / self.voxel).long()
        shape = torch.tensor(self.occupied.shape, device=index.device)
        inside = ((index >= 0) & (index < shape)).all(dim=-1)
        x, y, z = index.clamp_min(0).minimum(shape - 1).unbind(-1)
        return self.occupied[x, y, z] & inside

    @torch.no_grad()
    def fill(self, frames: Iterable[Tensor]) -> None:
        """Leave matter only in the voxels of measured points and two voxels around them.

        Args:
            frames: `(n, 3)` points each, units of the scene; one frame is held in memory at a time.
        """
        near = torch.zeros(self.occupied.shape, device=self.occupied.device)
        shape = torch.tensor(self.occupied.shape, device=self.occupied.device)
        for points in frames:
            index = torch.floor((points.to(self.low.device) - self.low) / self.voxel).long()
            index = index[((index >= 0) & (index < shape)).all(dim=-1)]
            near[index[:, 0], index[:, 1], index[:, 2]] = 1.0
        near = nn.functional.max_pool3d(
            near[None, None], kernel_size=2 * _MARGIN_VOXELS + 1, stride=1, padding=_MARGIN_VOXELS
        )
        self.occupied.copy_(near[0, 0] > 0)
        self.carved.fill_(True)


def measured_points(cameras: Cameras, index: int, depth: Tensor) -> Tensor:
    """What a frame's depth image shows, `(n, 3)` in units of the scene.

    Args:
        cameras: of all frames.
        index: of this frame.
        depth: `(height, width, 1)` planar depth in units of the scene, 0 = none.
    """
    height, width = depth.shape[:2]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rows, columns = rows.reshape(-1), columns.reshape(-1)
    planar = depth[rows, columns]
    measured = planar[:, 0] > 0
    rows, columns, planar = rows[measured], columns[measured], planar[measured]
    pixels = torch.stack([rows, columns], dim=-1) + 0.5
    rays = cameras.generate_rays(torch.full((len(pixels), 1), index), coords=pixels)
    return rays.origins + rays.directions * rays.metadata["directions_norm"] * planar
