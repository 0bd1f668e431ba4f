"""The settings of the task, with the design's defaults."""

from dataclasses import dataclass, field
from typing import Literal

from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.poses import Intrinsics
from avp_habitat.rewards import RewardConstants, check_reward

ACTION_NAMES = ("move_forward", "turn_left", "turn_right", "look_up", "look_down", "stop")
MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, LOOK_UP, LOOK_DOWN, STOP = range(len(ACTION_NAMES))
COVERAGE_MODES = ("visible", "over")
OBSERVATION_NAMES = ("numbers", "map", "surface_map")


@dataclass(frozen=True)
class TaskSettings:
    """Everything about the task but the scene."""

    reward: str = "proposed"
    """Name of the reward: coverage, coverage_redundancy, proposed or surface."""
    constants: RewardConstants = field(default_factory=RewardConstants)
    """The rewards' constants."""
    budget: int = 80
    """T: steps, which are views, per episode."""
    forward_m: float = 0.25
    """Length of a forward move in metres."""
    turn_deg: float = 10.0
    """Yaw of one turn in degrees."""
    tilt_deg: float = 10.0
    """Pitch of one look up or down in degrees."""
    pitch_limit_deg: float = 60.0
    """Greatest pitch, up and down, in degrees."""
    collision_m: float = 0.05
    """A forward move shorter than this, in metres, is a collision."""
    sensor_height_m: float = 1.5
    """Height of the camera above the floor under the agent, metres."""
    hfov_deg: float = 90.0
    """Horizontal field of view in degrees."""
    width: int = 160
    """Width of the policy's depth image in pixels."""
    height: int = 120
    """Height of the policy's depth image in pixels."""
    max_range_m: float = 10.0
    """Cells farther than this from the camera are not observed; also the unit of the depth observations, metres."""
    tolerance_m: float = 0.1
    """A hit this close before a floor point still observes it, metres along the ray."""
    coverage_mode: Literal["visible", "over"] = "visible"
    """visible: a cell's floor point is seen. over: a camera ray passes over the cell."""
    observation: Literal["numbers", "map", "surface_map"] = "numbers"
    """numbers: the twelve of the design. map: these, whether C ≥ τ, and a map of what was seen of the floor around the
    agent. surface_map: these, and maps of what was seen of walls, furniture and ceiling."""
    lookup: bool = False
    """Whether views are looked up in tables of the scene instead of casting all their rays: faster, for training."""

    def __post_init__(self) -> None:
        """Refuse what cannot work, by the option's name."""
        check_reward(self.reward)
        if self.coverage_mode not in COVERAGE_MODES:
            raise unknown_name("coverage_mode", self.coverage_mode, COVERAGE_MODES)
        if self.observation not in OBSERVATION_NAMES:
            raise unknown_name("observation", self.observation, OBSERVATION_NAMES)
        for name in (
            "budget",
            "width",
            "height",
            "forward_m",
            "turn_deg",
            "tilt_deg",
            "sensor_height_m",
            "max_range_m",
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
                raise UsageError(f"{name}: expected a number above 0, got {value!r}")
        if not 0 < self.hfov_deg < 180:
            raise UsageError(f"hfov_deg: expected degrees within (0, 180), got {self.hfov_deg!r}")
        if not 0 <= self.pitch_limit_deg < 90:
            raise UsageError(f"pitch_limit_deg: expected degrees within [0, 90), got {self.pitch_limit_deg!r}")

    @property
    def with_surface(self) -> bool:
        """Whether what was seen of the scene's surface is computed: the reward or the observation needs it."""
        return self.reward == "surface" or self.observation == "surface_map"

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the policy's depth image."""
        return Intrinsics.from_hfov(self.width, self.height, hfov_deg=self.hfov_deg)
