"""An environment's finished episode as a Rerun recording shows it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics
from avp_sb3.rerun_episode import EncodedView, Episode

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.trajectory import Trajectory


def episode_of(
    trajectory: "Trajectory",
    area: "NavigableArea | None",
    intrinsics: Intrinsics,
    views: Mapping[int, EncodedView],
) -> Episode:
    """The episode of an environment; without its area no floor is shown.

    Raises:
        UsageError: the trajectory belongs to another scene than the area.
    """
    if area is not None and len(trajectory.first_seen) != len(area.centres):
        raise UsageError(
            f"the trajectory knows {len(trajectory.first_seen)} navigable cells, the environment's area "
            f"{len(area.centres)}: they belong to different scenes"
        )
    parts = {f"reward/{name}": values for name, values in trajectory.reward_parts.items()}
    episode = Episode(
        camera_to_world=trajectory.camera_to_world,
        path=np.concatenate([trajectory.start[None], trajectory.position]),
        intrinsics=intrinsics,
        views=views,
        plots={"coverage": trajectory.coverage, "action": trajectory.action, "reward/sum": trajectory.reward, **parts},
    )
    if area is None:
        return episode
    return replace(episode, cells=np.asarray(area.centres), first_seen=trajectory.first_seen, cell_m=area.cell_m)
