"""Visibility of a rollout's held-out views, from its depth pictures."""

from collections.abc import Sequence

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import View
from avp_habitat.rollout.images import read_depth
from avp_habitat.sight.visibility import Visibility, grid_stride, heldout_points, visibility


def visibility_of(
    frames: Sequence[View], heldout: Sequence[View], intrinsics: Intrinsics, *, stride: int | None = None
) -> Visibility:
    """What captured frames have seen of held-out views; about 4 ms per picture of 640x480.

    On 20 views the default grid's shares differ from those of all pixels by 0.06 to 0.2 percentage points (standard
    deviation over where the grid begins), those of a single view by about 1.

    Every `stride`-th row and column of the held-out views is tested; by default about 1,200 pixels of each.

    Raises:
        RolloutError: a depth picture cannot be decoded.
    """
    decoded = ((read_depth(view.depth), view.camera_to_world) for view in heldout)
    points = heldout_points(decoded, intrinsics, stride=stride or grid_stride(intrinsics))
    return visibility(points, ((read_depth(view.depth), view.camera_to_world) for view in frames), intrinsics)
