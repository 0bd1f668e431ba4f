"""What a policy observes: the kinds that are built in, and what every kind is computed from."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from avp_habitat import plugins
from avp_habitat.errors import UsageError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.simulators.base import Frames, Simulator
from avp_habitat.surface import map as surface_map
from avp_habitat.surface.memory import RoomSurface
from avp_habitat.task import floor_map
from avp_habitat.task.settings import ACTION_NAMES, OBSERVATIONS, TaskSettings
from avp_habitat.task.views import Views

Float = NDArray[np.floating]
Observed = Any
"""Arrays whose first axis is the agents: one, or a `dict` of them as the space is a `Dict`."""


@dataclass(frozen=True)
class SceneAgents:
    """Those k of the agents that are in one scene; every array's first axis is k."""

    simulator: Simulator
    """Of the scene."""
    chosen: NDArray[np.integer]
    """`(k,)` their numbers among all n agents."""
    views: Views
    """Where they stand and look."""
    _rows: NDArray[np.integer]
    _first_seen: NDArray[np.int16]
    _floor: floor_map.MapObserver
    _surface: RoomSurface | None

    @property
    def area(self) -> NavigableArea:
        """The scene's floor; which cells of it an agent knows is `first_seen`."""
        return self.simulator.area

    @property
    def first_seen(self) -> NDArray[np.int16]:
        """`(k, m)` for each of `area.centres` the step (from 1) whose view first observed it; 0 for never."""
        return self._first_seen[self._rows, : len(self.area.centres)]

    def floor_maps(self) -> NDArray[np.float32]:
        """As `Agents.floor_maps`."""
        maps = self._floor.observe(self._first_seen, self._rows, self.views.position, self.views.yaw)
        return maps.reshape(-1, len(floor_map.CHANNELS), floor_map.SIDE, floor_map.SIDE)

    def surface_maps(self) -> NDArray[np.float32]:
        """As `Agents.surface_maps`."""
        maps = self._known().observe(self._rows, self.views.position, self.views.yaw)
        return maps.reshape(-1, len(surface_map.CHANNELS), surface_map.SIDE, surface_map.SIDE)

    def surface_around(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """As `surface.around.look_around`."""
        return self._known().around(self.views, self._rows)

    def surface_shares(self) -> NDArray[np.float64]:
        """As `RoomSurface.shares`: what no robot knows."""
        return self._known().shares(self._rows)

    def free_floor(self, rays: int, most_m: float) -> NDArray[np.float32]:
        """As `floor_map.MapObserver.free`."""
        return self._floor.free(self._first_seen, self._rows, self.views.position, self.views.yaw, rays, most_m)

    def _known(self) -> RoomSurface:
        if self._surface is None:
            raise UsageError("surface_maps: the observation has to declare that by needs_surface = True")
        return self._surface


@dataclass(frozen=True)
class Trail:
    """What n agents did so far in their episodes; entries after an agent's step t are not of this episode."""

    path: Float
    """`(n, T + 1, 3)` the start and the feet after each step, metres."""
    angles: Float
    """`(n, T + 1, 2)` yaw and pitch, radians."""
    gain: Float
    """`(n, T + 1, 2)` ΣΔQ and ΣΔS of each view, zeros where they are not computed."""
    action: Float
    """`(n, T)` the action of each step."""


@dataclass(frozen=True)
class Agents:
    """n agents at this moment, from which observations are computed; every array's first axis is n."""

    settings: TaskSettings
    """Of the task."""
    steps: NDArray[np.int64]
    """`(n,)` t: views taken so far in the episode."""
    start: Float
    """`(n, 3)` where the episode began, metres."""
    position: Float
    """`(n, 3)` the feet, metres."""
    yaw: Float
    """`(n,)` radians, left positive."""
    pitch: Float
    """`(n,)` radians, up positive."""
    min_depth: Float
    """`(n,)` least depth of the newest view, a share of the range."""
    mean_depth: Float
    """`(n,)` mean depth of the newest view, a share of the range."""
    coverage: Float
    """`(n,)` C, within [0, 1]."""
    collided: NDArray[np.bool_]
    """`(n,)` whether the newest step was a blocked forward move."""
    spread_m: Float
    """`(n,)` ‖p − p̄‖ in metres."""
    diameter_m: Float
    """`(n,)` r: diameter of the scene's navigable area, metres."""
    trail: Callable[[], Trail]
    """Gives what they did so far."""
    _by_scene: Callable[[], list[SceneAgents]]

    @cached_property
    def scenes(self) -> list[SceneAgents]:
        """The same agents scene by scene, with what was seen there."""
        return self._by_scene()

    def floor_maps(self) -> NDArray[np.float32]:
        """`(n, 3, 20, 20)` within [0, 1], `floor_map.CHANNELS`: the observed floor around each agent, ahead is up."""
        return self.joined([scene.floor_maps() for scene in self.scenes])

    def surface_maps(self) -> NDArray[np.float32]:
        """`(n, 8, 10, 10)` within [0, 1], `surface.map.CHANNELS`: walls, furniture and ceiling that were seen.

        Raises:
            UsageError: the observation does not declare `needs_surface = True`.
        """
        return self.joined([scene.surface_maps() for scene in self.scenes])

    def images(self, *, rgb: bool = False) -> Frames:
        """The newest views again: `(n, h, w)` depth of the size in `settings`, and colour when asked for; slow."""
        seen = [
            scene.simulator.render(scene.views.camera_to_world, self.settings.intrinsics, rgb=rgb)
            for scene in self.scenes
        ]
        colour = self.joined([each.rgb for each in seen]) if all(each.rgb is not None for each in seen) else None
        return Frames(colour, self.joined([each.depth for each in seen]))

    def joined(self, parts: list[Any]) -> NDArray[Any]:
        """`(n, …)` from the `(k, …)` arrays of each of `scenes`."""
        if len(parts) == 1:
            return parts[0]
        whole = np.empty((len(self.steps), *parts[0].shape[1:]), parts[0].dtype)
        for scene, part in zip(self.scenes, parts, strict=True):
            whole[scene.chosen] = part
        return whole


class Observation(Protocol):
    """A kind of observation; a class is made for each task by `Kind(settings)`.

    An attribute `needs_surface = True` declares that what was seen of the surface is used, `needs_parallax = True` that
    how well along two rays is too.
    """

    space: gymnasium.Space[Any]
    """Of one agent's observation; a `Dict` is for `MultiInputPolicy`."""

    def __call__(self, agents: Agents) -> Observed:
        """Observations of n agents as the space says, with a first axis of n."""
        ...


NAMES = (
    "t / T",
    "dx / r",
    "dz / r",
    "sin yaw",
    "cos yaw",
    "sin pitch",
    "cos pitch",
    "min depth",
    "mean depth",
    "coverage",
    "collided",
    "distance to mean / r",
)
"""What each number is; r is the diameter of the navigable area."""
LOW = np.array([0, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0], dtype=np.float32)
HIGH = np.ones(12, dtype=np.float32)


def numbers(agents: Agents) -> NDArray[np.float32]:
    """`(n, 12)` the numbers `NAMES` within [`LOW`, `HIGH`]."""
    offset = (agents.position - agents.start)[:, [0, 2]] / agents.diameter_m[:, None]
    columns = [
        agents.steps / agents.settings.budget,
        offset[:, 0],
        offset[:, 1],
        np.sin(agents.yaw),
        np.cos(agents.yaw),
        np.sin(agents.pitch),
        np.cos(agents.pitch),
        agents.min_depth,
        agents.mean_depth,
        agents.coverage,
        agents.collided,
        agents.spread_m / agents.diameter_m,
    ]
    return np.clip(np.stack(columns, axis=1).astype(np.float32), LOW, HIGH)


class Numbers:
    """The twelve numbers of the design."""

    further = 0

    def __init__(self, settings: TaskSettings) -> None:
        """Say the space."""
        low, high = np.pad(LOW, (0, self.further)), np.ones(len(HIGH) + self.further, np.float32)
        self.space = Box(low, high, dtype=np.float32)

    def __call__(self, agents: Agents) -> NDArray[np.float32]:
        """`(n, 12 + further)` float32."""
        return np.concatenate([numbers(agents), *self._further(agents)], axis=1)

    def _further(self, agents: Agents) -> list[NDArray[np.float32]]:
        return []


class Map(Numbers):
    """The numbers, whether C ≥ τ, and the map of the floor."""

    further = 1 + floor_map.SIZE

    def _further(self, agents: Agents) -> list[NDArray[np.float32]]:
        enough = agents.coverage >= agents.settings.constants.stop_coverage
        return [enough[:, None].astype(np.float32), agents.floor_maps().reshape(-1, floor_map.SIZE)]


class SurfaceMap(Map):
    """`Map`, and the maps of the surface."""

    needs_surface = True
    further = Map.further + surface_map.SIZE

    def _further(self, agents: Agents) -> list[NDArray[np.float32]]:
        return [*super()._further(agents), agents.surface_maps().reshape(-1, surface_map.SIZE)]


def make_observation(settings: TaskSettings) -> Observation:
    """The kind of observation that the settings name; those of users are held to their spaces.

    Raises:
        UsageError: no such kind, or it has no space or cannot be called with the agents.
    """
    name = plugins.name_of(settings.observation)
    kind = plugins.find("avp.observations", settings.observation, OBSERVATIONS)
    try:
        if isinstance(kind, type):
            inspect.signature(kind).bind(settings)
            kind = kind(settings)
        inspect.signature(kind).bind("agents")
    except (TypeError, ValueError) as error:
        raise UsageError(f"observation {name!r}: expected Kind(settings), called with the agents: {error}") from None
    if not isinstance(space := getattr(kind, "space", None), gymnasium.Space):
        raise UsageError(f"observation {name!r}: expected a gymnasium space as its `space`, got {space!r}")
    return kind if name in OBSERVATIONS else _Held(kind, name)


class _Held:
    """A kind of observation whose arrays are held to its space."""

    def __init__(self, kind: Observation, name: str) -> None:
        self.space, self._kind, self._name = kind.space, kind, name

    def __call__(self, agents: Agents) -> Observed:
        return _fitted(self.space, self._kind(agents), len(agents.steps), f"observation {self._name!r}")


def _fitted(space: gymnasium.Space[Any], value: Any, agents: int, where: str) -> Observed:
    """The value with the space's type of number; floats of 64 bits may become such of 32, but no whole numbers."""
    if isinstance(space, gymnasium.spaces.Dict):
        if not isinstance(value, Mapping) or set(value) != set(space.spaces):
            got = sorted(value) if isinstance(value, Mapping) else type(value).__name__
            raise UsageError(f"{where}: expected arrays by the names {sorted(space.spaces)}, got {got}")
        return {part: _fitted(each, value[part], agents, f"{where}: {part}") for part, each in space.spaces.items()}
    array, shape = np.asarray(value), (agents, *(space.shape or ()))
    if array.shape != shape or not np.can_cast(array.dtype, space.dtype or array.dtype, "same_kind"):
        raise UsageError(f"{where}: expected {space.dtype} of shape {shape}, got {array.dtype} of shape {array.shape}")
    array = array.astype(space.dtype, copy=False)
    bounds = isinstance(space, Box)
    inside = (array >= space.low) & (array <= space.high) if bounds else np.array([*map(space.contains, array)])
    if not inside.all():
        raise UsageError(f"{where}: expected values within {space}, got {array[~inside].flat[0]}")
    return array


def each(function: Callable[..., Any], *observed: Observed) -> Observed:
    """A function of arrays applied to observations, part by part where they are dicts."""
    if isinstance(observed[0], dict):
        return {part: each(function, *(value[part] for value in observed)) for part in observed[0]}
    return function(*observed)


def action_space() -> gymnasium.spaces.Discrete:
    """The six actions, numbered as in `settings.ACTION_NAMES`."""
    return gymnasium.spaces.Discrete(len(ACTION_NAMES))
