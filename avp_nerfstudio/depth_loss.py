"""The loss that makes rays end where the rollout's depth says."""

import torch
from torch import Tensor

_LEAST_SHARE = 1e-3


def termination_loss(weights: Tensor, starts: Tensor, ends: Tensor, distance: Tensor, tolerance: float) -> Tensor:
    """How little of the rays' weight lies at the measured surface: the mean of -log(share within the tolerance).

    The share sums the weights of all samples whose interval touches [distance - tolerance, distance + tolerance], so
    that coarse samples are not pushed beyond their own resolution. Rays without a measured distance do not count.

    Args:
        weights: `(rays, samples)` shares of the ray that end in each sample; their sum is at most 1.
        starts: `(rays, samples)` distances at which the samples begin, units of the scene.
        ends: `(rays, samples)` distances at which they end.
        distance: `(rays,)` along the ray to the surface, 0 where none was measured.
        tolerance: half the width of the surface, units of the scene.

    Returns:
        A scalar; 0 when all weight lies at the surface.
    """
    surface = distance[:, None]
    touching = (starts <= surface + tolerance) & (ends >= surface - tolerance)
    share = (weights * touching).sum(dim=-1)
    measured = distance > 0
    loss = torch.log((1 + _LEAST_SHARE) / (share + _LEAST_SHARE)) * measured
    return loss.sum() / measured.sum().clamp_min(1)
