"""Finished episodes of a training as a Rerun recording."""

import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from stable_baselines3.common.callbacks import BaseCallback

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.poses import Intrinsics
from avp_sb3.finished_episodes import MissingInfoError, finished_episodes, required
from avp_sb3.rerun_episode import EncodedView, encode_view, episode_of, log_episode, spread_indices
from avp_sb3.rerun_layout import open_recording

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.trajectory import Trajectory

DEFAULT_FOLDER = Path("runs")
_HFOV_DEG = 90.0


class RecordingError(AVPError):
    """A recording that cannot be written."""


class RerunCallback(BaseCallback):
    """Writes finished episodes to one `.rrd` file per training; open it with `rerun FILE`.

    The pictures are rendered after the episode has ended, so steps in between cost nothing. An episode of 80 steps with
    8 pictures of 320x240 takes about 0.3 MB and about half a second; `max_bytes` bounds the whole file, `max_share`
    the time, whatever the speed of the training.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        every: int = 50,
        pictures: int = 8,
        width: int = 320,
        height: int = 240,
        max_bytes: int = 500_000_000,
        max_share: float = 0.01,
        verbose: int = 0,
    ) -> None:
        """Describe the recording; nothing is written before the training starts.

        Args:
            path: the file to make; `runs/avp-DATE-TIME.rrd` when omitted. A second `learn()` adds `-2` to the name.
            every: record the first finished episode, and the next one when k more have ended (counted over all
                environments) and `max_share` allows it.
            pictures: RGB and depth pictures per episode at most, spread over its steps; 0 for none.
            width: of the pictures, pixels.
            height: of the pictures, pixels.
            max_bytes: no further episode is recorded once the file has this size.
            max_share: recording may take this share of the training's time; 1 records every k-th episode.
            verbose: 1 prints where the recording is.

        Raises:
            UsageError: a number that cannot be right.
        """
        super().__init__(verbose)
        for name, value, least in (
            ("every", every, 1),
            ("pictures", pictures, 0),
            ("width", width, 1),
            ("height", height, 1),
        ):
            if value < least:
                raise UsageError(f"RerunCallback {name}: expected at least {least}, got {value}")
        self.path: Path | None = None
        self._wanted_path = None if path is None else Path(path)
        if not 0 < max_share <= 1:
            raise UsageError(f"RerunCallback max_share: expected a number within (0, 1], got {max_share}")
        self._every, self._pictures, self._max_bytes, self._max_share = every, pictures, max_bytes, max_share
        self._started = self._spent = 0.0
        self._due = 1
        self._size = (width, height)
        self._recording: rr.RecordingStream | None = None
        self._trainings = self._episodes = self._steps = 0

    def close(self) -> None:
        """Finish the file; also done at the end of `learn()` and when Python exits."""
        if self._recording is not None:
            self._recording.disconnect()
            self._recording = None

    def _on_training_start(self) -> None:
        self.close()
        self._trainings += 1
        self._episodes = self._steps = 0
        self._started, self._spent, self._due = time.monotonic(), 0.0, 1
        path = self._next_path()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._recording = open_recording(path, [""])
        except OSError as error:
            raise RecordingError(f"{path}: cannot write the recording there: {error.strerror or error}") from None
        self.path = path
        if self.verbose:
            print(f"Rerun recording: {path}")

    def _on_step(self) -> bool:
        for index, info in finished_episodes(self.locals):
            self._episodes += 1
            if self._episodes >= self._due and self._has_time() and self._has_room():
                began = time.monotonic()
                self._record(index, required(info, "avp_trajectory", reader="RerunCallback"))
                self._spent += time.monotonic() - began
                self._due = self._episodes + self._every
        return True

    def _has_time(self) -> bool:
        return self._spent <= self._max_share * (time.monotonic() - self._started)

    def _on_training_end(self) -> None:
        self.close()

    def _record(self, index: int, trajectory: "Trajectory") -> None:
        assert self._recording is not None
        area: NavigableArea = self._attribute("area", index)
        camera = Intrinsics.from_hfov(*self._size, hfov_deg=self._hfov_deg(index))
        views = self._capture(index, trajectory, camera)
        log_episode(
            self._recording,
            "",
            episode_of(trajectory, area, camera, views),
            number=self._episodes,
            first_step=self._steps,
            env_step=self.num_timesteps,
        )
        self._steps += len(trajectory.action)

    def _capture(self, index: int, trajectory: "Trajectory", camera: Intrinsics) -> dict[int, EncodedView]:
        """The pictures of the environment, rendered now."""
        steps = spread_indices(len(trajectory.action), self._pictures)
        if not steps:
            return {}
        self._require("capture")
        poses = np.ascontiguousarray(trajectory.camera_to_world[steps])
        frames = self.training_env.env_method("capture", poses, camera, indices=index)[0]
        return {step: encode_view(rgb, depth) for step, rgb, depth in zip(steps, frames.rgb, frames.depth, strict=True)}

    def _hfov_deg(self, index: int) -> float:
        """That of the environment's settings."""
        if not self.training_env.has_attr("settings"):
            return _HFOV_DEG
        return getattr(self.training_env.get_attr("settings", index)[0], "hfov_deg", _HFOV_DEG)

    def _attribute(self, name: str, index: int) -> Any:
        self._require(name)
        return self.training_env.get_attr(name, index)[0]

    def _require(self, name: str) -> None:
        if not self.training_env.has_attr(name):
            raise MissingInfoError(f"RerunCallback: expected the environment to have {name!r}; train on AVP-v0")

    def _has_room(self) -> bool:
        return self.path is not None and self.path.stat().st_size < self._max_bytes

    def _next_path(self) -> Path:
        path = self._wanted_path or DEFAULT_FOLDER / f"avp-{datetime.now():%Y%m%d-%H%M%S}.rrd"
        if self._trainings > 1 and self._wanted_path is not None:
            path = path.with_stem(f"{path.stem}-{self._trainings}")
        if path.exists() or path.is_symlink():
            raise UsageError(f"{path}: exists already; choose another name or remove it")
        return path
