"""The numbers that decide where an agent can stand: Habitat's navigation-mesh defaults with the suite's agent."""

import math
from dataclasses import dataclass
from typing import Annotated

from avp_habitat.ranges import Range, hold_ranges


@dataclass(frozen=True)
class NavigationSettings:
    """Parameters of the navigable area; the defaults are those of Habitat-Sim's `NavMeshSettings`."""

    voxel_m: Annotated[float, Range(0.005, 1)] = 0.05
    """Side of a voxel on the floor plane, in metres (Recast's cell size)."""
    voxel_height_m: Annotated[float, Range(0.005, 1)] = 0.2
    """Height of a voxel in metres: heights are compared in whole voxels."""
    agent_height_m: Annotated[float, Range(0.01, 10)] = 1.5
    """Free height that an agent needs, in metres; rounded up to whole voxels."""
    agent_radius_m: Annotated[float, Range(0, 5)] = 0.1
    """Distance that an agent keeps from obstacles, in metres; rounded up to whole voxels."""
    max_climb_m: Annotated[float, Range(0, 5)] = 0.2
    """Highest step that an agent takes, in metres; rounded down to whole voxels."""
    max_slope_deg: Annotated[float, Range(0, 89)] = 45.0
    """Steepest walkable surface, in degrees from level."""
    region_min_size: Annotated[int, Range(0, 1000)] = 20
    """Parts with fewer voxels than the square of this number are dropped."""
    edge_max_error: Annotated[float, Range(0.1, 100)] = 1.3
    """Largest distance between the outline and the voxels' border, in voxels."""
    cell_m: Annotated[float, Range(0.01, 1)] = 0.1
    """Side of a cell of the navigable mask, in metres."""

    def __post_init__(self) -> None:
        """Refuse what is outside its range."""
        hold_ranges(self)

    @property
    def height_voxels(self) -> int:
        """Free height in voxels (8 by default: 1.6 m)."""
        return math.ceil(self.agent_height_m / self.voxel_height_m - 1e-6)

    @property
    def climb_voxels(self) -> int:
        """Highest step in voxels (1 by default)."""
        return math.floor(self.max_climb_m / self.voxel_height_m + 1e-6)

    @property
    def radius_voxels(self) -> int:
        """Radius in voxels (2 by default)."""
        return math.ceil(self.agent_radius_m / self.voxel_m - 1e-6)

    @property
    def cell_voxels(self) -> int:
        """Side of a cell in voxels (2 by default)."""
        return max(1, round(self.cell_m / self.voxel_m))
