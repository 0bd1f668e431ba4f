"""The recording that rollouts become part of, as a viewer or another application asks for it."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.poses import Intrinsics
from avp_sb3.rerun.episode import EncodedView, encode_view, spread_indices
from avp_sb3.rerun.room import room_points, room_poses

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.simulators.base import Frames
    from avp_habitat.task.trajectory import Trajectory
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import rerun as rr

from avp_sb3.rerun.layout import APPLICATION

_META = "rollout.json"
_MARK = b"avp-rollout"
"""The value of `format`, one of the first lines of our `rollout.json`."""
_HEAD_BYTES = 65_536
_PARTS = ("images", "depth", "poses", "steps.csv", "transforms.json")
_MOST_ENTRIES = 4096
"""Of a folder that is searched for rollouts; whoever keeps more in one folder does not want all of them in one view."""


def rollouts_at(path: str) -> list[str]:
    """The rollouts that a path stands for, damaged ones included.

    Args:
        path: any path, also of something that does not exist.

    Returns:
        The folder of the rollout (given itself, or by its `rollout.json`); or the rollouts directly in the folder, by
        name; none for everything else.
    """
    if os.path.isdir(path):
        return [path] if is_rollout(path) else sorted(folder for folder in _folders_in(path) if is_rollout(folder))
    if os.path.basename(path) == _META and os.path.isfile(path):
        folder = os.path.dirname(path) or "."
        return [folder] if is_rollout(folder) else []
    return []


def is_rollout(folder: str) -> bool:
    """Whether a folder is a rollout: by the mark in its `rollout.json`, or (damaged) by all the other parts of one."""
    return _MARK in _head(os.path.join(folder, _META)) or all(
        os.path.lexists(os.path.join(folder, part)) for part in _PARTS
    )


def is_shown_with_its_folder(path: str, application_id: str | None) -> bool:
    """Whether a file of a rollout is asked about only because its folder is being opened.

    A viewer that opens a folder asks about the folder, then about each file in it. The folder's own answer shows the
    rollout already. Such questions carry the folder's name as application id (none for the folder `.`); a file opened
    by itself carries its own name.

    Args:
        path: as asked about.
        application_id: as sent along.
    """
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isfile(path) or not is_rollout(folder):
        return False
    opened = (folder, os.path.dirname(folder))
    if application_id is None:
        return path.startswith((os.curdir + os.sep, os.pardir + os.sep)) and _caller_opened(opened)
    if application_id not in map(_application_id, opened):
        return False
    # A folder named like the file tells nothing; neither answer loses anything, one would show the rollout twice.
    return application_id != _application_id(path) or _caller_opened(opened)


def _head(path: str) -> bytes:
    try:
        if not os.path.isfile(path):
            return b""
        with open(path, "rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""


def _folders_in(path: str) -> Iterator[str]:
    """Those that are not hidden (a rollout being written is)."""
    try:
        with os.scandir(path) as entries:
            for _, entry in zip(range(_MOST_ENTRIES), entries, strict=False):
                if entry.is_dir() and not entry.name.startswith("."):
                    yield entry.path
    except OSError:
        return


def _application_id(path: str) -> str:
    """The name that a viewer makes of a path."""
    return Path(path).stem.replace(".", "_")


def _caller_opened(folders: tuple[str, ...]) -> bool:
    """Whether the calling program's command line names one of the folders; False where that cannot be known."""
    try:
        words = Path(f"/proc/{os.getppid()}/cmdline").read_bytes().split(b"\0")[1:]
    except OSError:
        return False
    wanted = {os.path.realpath(folder) for folder in folders}
    return any(os.path.isdir(word) and os.path.realpath(word) in wanted for word in map(os.fsdecode, words))


_HFOV_DEG, _SENSOR_HEIGHT_M = 90.0, 1.5
_ROOM_WIDTH, _ROOM_HEIGHT = 72, 54
_UNNAMED = ""


class RecordedEnvironments:
    """The environments of a training; each of them may lack what a recording would show."""

    def __init__(self, env: VecEnv) -> None:
        """Ask which attributes they have.

        Args:
            env: the training's.
        """
        self._env = env
        self.missing = [name for name in ("area", "capture") if not env.has_attr(name)]
        """Those of `area` and `capture` that the environments lack."""
        self._has_names, self._has_settings = env.has_attr("scene_name"), env.has_attr("settings")

    @property
    def scenes(self) -> list[str]:
        """Names of all scenes, each once; one empty name where environments do not tell."""
        return list(dict.fromkeys(self._names()))

    @property
    def areas(self) -> "dict[str, NavigableArea]":
        """Where agents can stand, by the scene's name; none where environments do not tell."""
        if "area" in self.missing:
            return {}
        names = self._names()
        return {name: self._env.get_attr("area", names.index(name))[0] for name in dict.fromkeys(names)}

    def scene(self, index: int) -> str:
        """Name of an environment's scene."""
        return self._env.get_attr("scene_name", index)[0] if self._has_names else _UNNAMED

    def area(self, index: int) -> "NavigableArea | None":
        """Where an environment's agent can stand."""
        return None if "area" in self.missing else self._env.get_attr("area", index)[0]

    def camera(self, index: int, *, width: int, height: int) -> Intrinsics:
        """A camera of the given size in pixels, with the field of view of the environment's own."""
        return Intrinsics.from_hfov(width, height, hfov_deg=self._setting(index, "hfov_deg", _HFOV_DEG))

    def pictures(
        self, index: int, trajectory: "Trajectory", camera: Intrinsics, *, at_most: int
    ) -> dict[int, EncodedView]:
        """Pictures of an episode by step, spread over it; rendered now, none where the environment cannot."""
        steps = spread_indices(len(trajectory.action), at_most)
        if "capture" in self.missing or not steps:
            return {}
        frames = self._capture(index, trajectory.camera_to_world[steps], camera)
        pairs = zip(steps, _colours(frames), frames.depth, strict=True)
        return {step: encode_view(rgb, depth) for step, rgb, depth in pairs}

    def room(self, index: int) -> "tuple[NDArray[np.float32], NDArray[np.uint8]] | None":
        """Points and colours of an environment's scene, rendered now; None where it cannot be."""
        area = self.area(index)
        if area is None or "capture" in self.missing:
            return None
        poses = room_poses(area, sensor_height_m=self._setting(index, "sensor_height_m", _SENSOR_HEIGHT_M))
        camera = self.camera(index, width=_ROOM_WIDTH, height=_ROOM_HEIGHT)
        frames = self._capture(index, poses, camera)
        return room_points(zip(_colours(frames), frames.depth, strict=True), camera, poses)

    def _capture(self, index: int, poses: NDArray[np.floating], camera: Intrinsics) -> "Frames":
        return self._env.env_method("capture", np.ascontiguousarray(poses), camera, indices=index)[0]

    def _names(self) -> list[str]:
        return self._env.get_attr("scene_name") if self._has_names else [_UNNAMED]

    def _setting(self, index: int, name: str, default: float) -> float:
        if not self._has_settings:
            return default
        settings: Any = self._env.get_attr("settings", index)[0]
        return getattr(settings, name, default)


def _colours(frames: "Frames") -> Sequence[NDArray[np.uint8]]:
    assert frames.rgb is not None
    return list(frames.rgb)


Time = int | np.timedelta64 | np.datetime64
"""A number in a sequence, a duration, or a moment."""


@dataclass(frozen=True)
class Destination:
    """Where rollouts are recorded."""

    application_id: str = APPLICATION
    """Of the recording."""
    recording_id: str | None = None
    """Of the recording; a new one when None."""
    prefix: str = ""
    """Entity path above the rollouts."""
    times: Mapping[str, Time] = field(default_factory=dict)
    """Further time lines, each with the one value that it has for all of the rollouts."""
    own: bool = True
    """The recording is for the rollouts alone, which give it its name and layout."""


class DestinationRecording(rr.RecordingStream):
    """A recording in which all that has a time has the destination's times too."""

    def __init__(self, destination: Destination) -> None:
        """Make a recording that goes nowhere yet.

        Args:
            destination: what it is part of.
        """
        super().__init__(
            destination.application_id, recording_id=destination.recording_id, send_properties=destination.own
        )
        self._times = destination.times
        self._set_times()

    def __del__(self) -> None:
        """As `rerun.RecordingStream.__del__`, which asks for `inner` also where making the recording failed."""
        if hasattr(self, "inner"):
            super().__del__()

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any], *, strict: bool | None = None
    ) -> None:
        """As `rerun.RecordingStream.send_columns`, with the further times in every row."""
        indexes = list(indexes)
        rows = len(indexes[0].as_arrow_array()) if indexes else 0
        indexes += [_column(name, value, rows) for name, value in self._times.items() if rows]
        super().send_columns(entity_path, indexes, columns, strict=strict)

    def reset_time(self) -> None:
        """As `rerun.RecordingStream.reset_time`, but for the further times, which stay."""
        super().reset_time()
        self._set_times()

    def _set_times(self) -> None:
        for name, value in self._times.items():
            if isinstance(value, np.timedelta64):
                self.set_time(name, duration=value)
            elif isinstance(value, np.datetime64):
                self.set_time(name, timestamp=value)
            else:
                self.set_time(name, sequence=value)


def _column(name: str, value: Time, rows: int) -> rr.TimeColumn:
    if isinstance(value, np.timedelta64):
        return rr.TimeColumn(name, duration=np.full(rows, value))
    if isinstance(value, np.datetime64):
        return rr.TimeColumn(name, timestamp=np.full(rows, value))
    return rr.TimeColumn(name, sequence=[value] * rows)
