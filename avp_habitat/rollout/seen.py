"""Visibility of a rollout's held-out views, from its depth pictures."""

from collections.abc import Sequence

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import Rollout, View, name_of
from avp_habitat.rollout.images import read_depth
from avp_habitat.sight.visibility import Visibility, grid_stride, heldout_points, visibility
from avp_habitat.simulators.base import Simulator


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


def expect_scene(rollout: Rollout, simulator: Simulator) -> None:
    """Refuse a rollout of another scene than the open one.

    Raises:
        RolloutError: its scene has another digest.
    """
    if rollout.meta.get("scene", {}).get("sha256") != simulator.scene_digest:
        found = name_of(rollout.meta, "scene")
        raise RolloutError(
            f"{rollout.folder}: expected a rollout of {simulator.scene}, found one of {found} of another digest"
        )
