"""The settings of the task, with the design's defaults."""

from dataclasses import asdict, dataclass, field, fields
from typing import Annotated, Any, Literal

from avp_habitat import plugins
from avp_habitat.errors import UsageError
from avp_habitat.metrics import find_metrics
from avp_habitat.poses import Intrinsics
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.task.rewards import RewardConstants, RewardFunction, find_reward, needs_parallax, needs_surface

ACTION_NAMES = ("move_forward", "turn_left", "turn_right", "look_up", "look_down", "stop")
MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, LOOK_UP, LOOK_DOWN, STOP = range(len(ACTION_NAMES))
OBSERVATIONS = {
    "numbers": "avp_habitat.task.observations:Numbers",
    "map": "avp_habitat.task.observations:Map",
    "surface_map": "avp_habitat.task.observations:SurfaceMap",
    "onboard": "avp_habitat.task.onboard:Onboard",
    "privileged": "avp_habitat.task.onboard:Privileged",
}
"""The kinds that are built in, by name."""
OBSERVATIONS_HELP = f"{', '.join(OBSERVATIONS)} or MODULE:OBJECT"
"""Help of the option `--observation`."""


@dataclass(frozen=True)
class TaskSettings:
    """Everything about the task but the scene."""

    reward: str | RewardFunction = "proposed"
    """The reward: coverage, coverage_redundancy, proposed, surface, multiview, `module:function`, another
    distribution's, or the function itself (`rewards.RewardFunction`)."""
    constants: RewardConstants = field(default_factory=RewardConstants)
    """The rewards' constants."""
    budget: Annotated[int, Range(1, 32767)] = 80
    """T: steps, which are views, per episode."""
    forward_m: Annotated[float, Range(0.01, 10)] = 0.25
    """Length of a forward move in metres."""
    turn_deg: Annotated[float, Range(0.1, 180)] = 10.0
    """Yaw of one turn in degrees."""
    tilt_deg: Annotated[float, Range(0.1, 90)] = 10.0
    """Pitch of one look up or down in degrees."""
    pitch_limit_deg: Annotated[float, Range(0, 89)] = 60.0
    """Greatest pitch, up and down, in degrees."""
    collision_m: Annotated[float, Range(0, 10)] = 0.05
    """A forward move shorter than this, in metres, is a collision."""
    sensor_height_m: Annotated[float, Range(0.01, 10)] = 1.5
    """Height of the camera above the floor under the agent, metres."""
    hfov_deg: Annotated[float, Range(1, 175)] = 90.0
    """Horizontal field of view in degrees."""
    width: Annotated[int, Range(1, 4096)] = 160
    """Width of the policy's depth image in pixels."""
    height: Annotated[int, Range(1, 4096)] = 120
    """Height of the policy's depth image in pixels."""
    max_range_m: Annotated[float, Range(0.1, 1000)] = 10.0
    """Cells farther than this from the camera are not observed; also the unit of the depth observations, metres."""
    tolerance_m: Annotated[float, Range(0, 1)] = 0.1
    """A hit this close before a floor point still observes it, metres along the ray."""
    coverage_mode: Literal["visible", "over"] = "visible"
    """visible: a cell's floor point is seen. over: a camera ray passes over the cell."""
    observation: Any = "numbers"
    """numbers: the twelve of the design. map: these, whether C ≥ τ, and a map of what was seen of the floor around the
    agent. surface_map: these, and maps of what was seen of walls, furniture and ceiling. onboard: what was seen of
    floor and surface, from where, and nothing that a robot does not know. privileged: that, coverage and the shares of
    the surface seen. Or `module:object`, another distribution's, or the object itself (`observations.Observation`)."""
    metrics: tuple[Any, ...] = ()
    """Further metrics, of episodes and of rollouts: `module:function`, another distribution's, or the functions
    themselves (`metrics.metric`). Their values stand beside the suite's own wherever these are logged."""
    lookup: bool = False
    """Whether views are looked up in tables of the scene instead of casting all their rays: faster, for training."""

    def __post_init__(self) -> None:
        """Refuse what cannot work, by the option's name."""
        find_reward(self.reward)
        if self.observation not in OBSERVATIONS:  # Those are imported by who makes one.
            plugins.find("avp.observations", self.observation, OBSERVATIONS)
        hold_ranges(self)
        metrics = (self.metrics,) if isinstance(self.metrics, str) else tuple(self.metrics)
        object.__setattr__(self, "metrics", metrics)
        find_metrics(metrics)
        if self.collision_m >= self.forward_m:
            raise UsageError(
                f"collision_m: expected less than forward_m ({self.forward_m:g}), or every move is a collision, got "
                f"{self.collision_m:g}"
            )

    @property
    def with_surface(self) -> bool:
        """Whether what was seen of the scene's surface is computed: the reward or the observation needs it."""
        return any(map(needs_surface, self._kinds))

    @property
    def with_parallax(self) -> bool:
        """Whether how well it was seen along two rays is computed too."""
        return any(map(needs_parallax, self._kinds))

    @property
    def _kinds(self) -> tuple[Any, Any]:
        return find_reward(self.reward), plugins.find("avp.observations", self.observation, OBSERVATIONS)

    def facts(self) -> dict[str, Any]:
        """All fields as they are stored as text: objects by their names."""
        named = {"reward": plugins.name_of(self.reward), "observation": plugins.name_of(self.observation)}
        plain = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "metrics"}
        if self.metrics:
            named["metrics"] = ", ".join(map(plugins.name_of, self.metrics))
        return plain | {"constants": asdict(self.constants)} | named

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the policy's depth image."""
        return Intrinsics.from_hfov(self.width, self.height, hfov_deg=self.hfov_deg)
