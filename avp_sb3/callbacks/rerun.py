"""Finished episodes of a training as a Rerun recording, in a file and live."""

import atexit
import functools
import os
import shlex
import shutil
import socket
import sys
import sysconfig
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from datetime import datetime
from numbers import Real
from pathlib import Path
from typing import Any
from urllib.parse import quote
from uuid import uuid4

import rerun as rr
from stable_baselines3.common.callbacks import BaseCallback

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.files import check_new, check_writable
from avp_sb3.callbacks.base import finished_episodes, pool_of, required
from avp_sb3.rerun import APPLICATION
from avp_sb3.rerun.episode import episode_of, log_episode, metric_path
from avp_sb3.rerun.layout import eye_above, training_blueprint
from avp_sb3.rerun.room import RecordedEnvironments, log_room

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_FLUSH_S = 5.0
_LEAST_FREE = 100_000_000
_LOOPBACK = "127.0.0.1"
_FIGURE_ROWS, _FIGURE_SECONDS = 512, 10.0
_Figures = tuple[dict[str, int], Mapping[str, Any]]
"""An episode's values of the time lines `episode`, `env_step` and, if it was recorded, `step`; its figures."""


class RecordingError(AVPError):
    """A recording that cannot be written, or a viewer that cannot be started or reached."""


class RerunCallback(BaseCallback):
    """Writes finished episodes to one `.rrd` file per training (open it with `rerun FILE`), and shows them live.

    Every k-th episode is there with its scene, floor, path, views, pictures and rewards, and the figures of all
    finished episodes (`info["avp_episode"]`) as curves. The pictures are rendered after the episode has ended, so steps
    in between cost nothing. Any environment that reports `info["avp_trajectory"]` will do; without an `area` it has no
    floor, without `capture` no pictures, without both no room, without `info["avp_episode"]` no curves.

    An episode of 80 steps with 6 pictures of 240x180 takes about 0.2 MB, a scene 0.5 to 1 MB once, 1,000 episodes'
    figures 0.4 MB. When the disk is nearly full or a viewer goes away, it says so once and the training goes on.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        live: str | None = None,
        every: int = 50,
        pictures: int = 6,
        width: int = 240,
        height: int = 180,
        max_bytes: int = 500_000_000,
        max_share: float = 0.01,
        verbose: int = 1,
    ) -> None:
        """Describe the recording; nothing is written before the training starts.

        Args:
            path: the file to make; `runs/avp-DATE-TIME.rrd` when omitted. A second `learn()` adds `-2` to the name.
            live: also show it while it grows: `web` serves a page to this machine's browsers until `close()` or the end
                of the program (its address is printed); `viewer` opens a window, or uses the one that is open; so does
                `rerun+http://HOST:PORT/proxy`, of any machine.
            every: record the first finished episode, and the next one when k more have ended (counted over all
                environments) and `max_share` allows it.
            pictures: RGB and depth pictures per episode at most, spread over its steps; 0 for none.
            width: of the pictures, pixels.
            height: of the pictures, pixels.
            max_bytes: of the whole file, about.
            max_share: recording may take this share of the training's time; 1 records every k-th episode.
            verbose: 1 prints at the end where the recording is, 2 also at the start; 0 prints nothing.

        Raises:
            UsageError: an option that cannot be right.
        """
        super().__init__(verbose)
        given = {"every": every, "pictures": pictures, "width": width, "height": height, "max_bytes": max_bytes}
        for name, value in given.items():
            if value < (least := 0 if name == "pictures" else 1):
                raise UsageError(f"RerunCallback {name}: expected at least {least}, got {value}")
        if not 0 < max_share <= 1:
            raise UsageError(f"RerunCallback max_share: expected a number within (0, 1], got {max_share}")
        if not (live in (None, "viewer", "web") or (live.startswith("rerun+http://") and live.endswith("/proxy"))):
            raise UsageError(f"live: expected 'viewer', 'web' or 'rerun+http://HOST:PORT/proxy', got {live!r}")
        self.path: Path | None = None
        self._wanted_path = None if path is None else Path(path)
        self._every, self._pictures, self._max_bytes, self._max_share = every, pictures, max_bytes, max_share
        self._size, self._live = (width, height), live
        self._trainings = 0
        self._recordings: dict[str, rr.RecordingStream] = {}
        self._failed: list[rr.RecordingStream] = []

    def close(self) -> None:
        """Finish the file, as the end of `learn()` does, and stop the server of `live="web"`."""
        atexit.unregister(self.close)
        self._on_training_end()
        while self._recordings:
            self._recordings.popitem()[1].disconnect()

    def _on_training_start(self) -> None:
        self.close()
        self._trainings += 1
        self._episodes = self._steps = self._largest = 0
        self._due, self._started, self._spent = 1, time.monotonic(), 0.0
        self._environments = RecordedEnvironments(self.training_env)
        self._kept, self._sent_at = list[_Figures](), time.monotonic()
        self._said: set[str] = set()
        self._shown: set[str] = set()
        areas = self._environments.areas
        self._has_one_scene = len(areas) == 1 and pool_of(self.training_env) is None
        self._eyes = {
            self._root(name): None if area is None else eye_above(area.centres) for name, area in areas.items()
        }
        self.path = self._next_path()
        # By default a process has one id, under which a viewer would merge the recordings of two trainings.
        identity, layout = str(uuid4()), training_blueprint(self._eyes)
        self._recordings[str(self.path)] = _recording_in(self.path, identity, layout)
        # An interrupted training has no end that would finish the file.
        atexit.register(self.close)
        if self.verbose > 1:
            print(f"Rerun:    {self.path}", flush=True)
        if self._live is not None:
            self._recordings[self._live] = _live_recording(self._live, identity, layout)
        for name in self._environments.missing:
            self._say(f"the environment has no {name!r}: recording without what that shows, and without the room")

    def _on_step(self) -> bool:
        for index, info in finished_episodes(self.locals):
            self._episodes += 1
            if "avp_episode" not in info:
                self._say("no 'avp_episode' in info at the end of an episode: recording without figures")
            trajectory = required(info, "avp_trajectory", reader="RerunCallback")
            times = {"episode": self._episodes, "env_step": self.num_timesteps}
            if self._is_due():
                self._record(index, trajectory, times)
                times["step"] = self._steps - 1
            self._kept.append((times, info.get("avp_episode", {})))
            if len(self._kept) >= _FIGURE_ROWS or time.monotonic() - self._sent_at > _FIGURE_SECONDS:
                self._send_figures()
        return True

    def _on_training_end(self) -> None:
        """Send what is kept and end the file; a viewer stays."""
        if not self._recordings:
            return
        self._send_figures()
        if recording := self._recordings.pop(str(self.path), None):
            recording.disconnect()
            if self.verbose:
                print(f"Rerun:    rerun {shlex.quote(str(self.path))}", flush=True)

    def _is_due(self) -> bool:
        in_time = self._spent <= self._max_share * (time.monotonic() - self._started)
        return self._episodes >= self._due and in_time and self._has_room(self._largest)

    def _record(self, index: int, trajectory: Any, times: Mapping[str, int]) -> None:
        began, size = time.monotonic(), self._file_size
        width, height = self._size
        camera = self._environments.camera(index, width=width, height=height)
        views = self._environments.pictures(index, trajectory, camera, at_most=self._pictures)
        episode = episode_of(trajectory, self._environments.get("area", index), camera, views)
        root = self._root(self._environments.get("scene_name", index, ""))
        is_new = root not in self._shown
        if root not in self._eyes:
            self._lay_out(root, index)
        room = self._environments.room(index) if is_new else None
        if room is not None and not self._has_room(sum(array.nbytes for array in room)):
            room = None
        self._shown.add(root)
        for recording in self._recordings.values():
            if room is not None:
                log_room(recording, f"{root}/world/room", room)
            log_episode(recording, root, episode, times=times, first_step=self._steps, with_scene=is_new)
        self._flush()
        self._steps += len(trajectory.action)
        self._largest = max(self._largest, self._file_size - size)
        self._spent += time.monotonic() - began
        self._due = self._episodes + self._every

    def _root(self, scene: str) -> str:
        """The entity path of a scene: the only one of a training has none of its own."""
        return "" if self._has_one_scene else f"/{rr.escape_entity_path_part(scene)}"

    def _lay_out(self, root: str, index: int) -> None:
        """Give a scene of a pool, which an environment has entered, a tab instead of the one that came first."""
        area = self._environments.get("area", index)
        del self._eyes[next(iter(self._eyes))]
        self._eyes[root] = None if area is None else eye_above(area.centres)
        for recording in self._recordings.values():
            recording.send_blueprint(training_blueprint(self._eyes))

    def _send_figures(self) -> None:
        curves = list(_curves(self._kept)) if self._has_room() else []
        for recording in self._recordings.values():
            for path, times, values in curves:
                recording.send_columns(path, times, rr.Scalars.columns(scalars=values))
        self._kept, self._sent_at = [], time.monotonic()
        self._flush()

    def _flush(self) -> None:
        """Let what was logged reach the file and the viewer; nothing further goes where it cannot."""
        for name, recording in list(self._recordings.items()):
            try:
                recording.flush(timeout_sec=_FLUSH_S)
            except RuntimeError as error:
                # Kept, because Rerun waits without end when it lets go of a file that could not be written.
                self._failed.append(self._recordings.pop(name))
                self._say(f"{name}: {error}; what came before is kept, the training goes on")

    def _has_room(self, size: int = 0) -> bool:
        assert self.path is not None
        if self._file_size + size >= self._max_bytes:
            self._say(f"{self.path}: has reached max_bytes ({self._max_bytes}); nothing further is recorded")
        elif shutil.disk_usage(self.path.parent).free < size + _LEAST_FREE:
            self._say(f"{self.path}: the disk has less than {_LEAST_FREE / 1e6:.0f} MB left; nothing is recorded")
        else:
            return True
        return False

    @property
    def _file_size(self) -> int:
        return self.path.stat().st_size if self.path is not None and self.path.exists() else 0

    def _say(self, text: str) -> None:
        """A line on the error stream, once per training."""
        if text not in self._said:
            self._said.add(text)
            print(f"RerunCallback: {text}", file=sys.stderr)

    def _next_path(self) -> Path:
        path = self._wanted_path or Path("runs") / f"avp-{datetime.now():%Y%m%d-%H%M%S}.rrd"
        if self._trainings > 1 and self._wanted_path is not None:
            path = path.with_stem(f"{path.stem}-{self._trainings}")
        return path


def _curves(kept: list[_Figures]) -> Iterator[tuple[str, list[rr.TimeColumn], list[float]]]:
    """Entity, times and values of each figure, apart for the episodes that have a `step` and those that have none."""
    curves = defaultdict(list)
    for times, figures in kept:
        for name, value in figures.items():
            if isinstance(value, Real):
                curves[name, tuple(times)].append((times, value))
    for (name, lines), points in curves.items():
        columns = [rr.TimeColumn(line, sequence=[times[line] for times, _ in points]) for line in lines]
        yield metric_path("", name), columns, [value for _, value in points]


def _recording_in(path: Path, identity: str, layout: rr.blueprint.Blueprint) -> rr.RecordingStream:
    """A recording in a file that did not exist, in a folder that is made if need be."""
    check_new(path)
    # Rerun's own error for an unwritable path does not say why.
    check_writable(path, failure=RecordingError, option="")
    path.parent.mkdir(parents=True, exist_ok=True)
    recording = rr.RecordingStream(APPLICATION, recording_id=identity)
    recording.save(path, default_blueprint=layout)
    return recording


def _live_recording(target: str, identity: str, layout: rr.blueprint.Blueprint) -> rr.RecordingStream:
    """A recording in a viewer, which is started if need be."""
    recording = rr.RecordingStream(APPLICATION, recording_id=identity)
    try:
        if target == "web":
            data = rr.GrpcServerSink(_LOOPBACK, _free_port())
            recording.set_sinks(data, default_blueprint=layout)
            print(f"Rerun web viewer: {_web_page()}/?url={quote(data.uri, safe='')}", flush=True)
        elif target == "viewer":
            # It ends only after it has taken the first data, on a busy machine also after they are flushed.
            if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
                raise RuntimeError(f"none of {', '.join(_DISPLAYS)} is set")
            program = Path(sysconfig.get_path("scripts")) / "rerun"
            rr.spawn(recording=recording, default_blueprint=layout, executable_path=str(program))
        else:
            recording.connect_grpc(target, default_blueprint=layout)
        recording.flush(timeout_sec=_FLUSH_S)
    except (RuntimeError, ValueError) as error:
        hint = "; live='web' needs no display" if target == "viewer" else "; is a viewer open there (`rerun`)?"
        raise RecordingError(f"live={target!r}: no Rerun viewer there ({error}){hint}") from None
    return recording


@functools.cache
def _web_page() -> str:
    """The address of the viewer's page, which is served until the end of the program."""
    port = _free_port()
    rr.serve_web_viewer(web_port=port, open_browser=False)
    return f"http://{_LOOPBACK}:{port}"


def _free_port() -> int:
    with socket.socket() as candidate:
        candidate.bind((_LOOPBACK, 0))
        return candidate.getsockname()[1]
