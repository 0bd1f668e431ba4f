"""Finished episodes of a training as a Rerun recording, in a file and live."""

import atexit
import shlex
import sys
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import rerun as rr
from stable_baselines3.common.callbacks import BaseCallback

from avp_habitat.errors import UsageError
from avp_sb3.callbacks.base import finished_episodes, required
from avp_sb3.rerun.destination import RecordedEnvironments
from avp_sb3.rerun.episode import episode_of, log_episode
from avp_sb3.rerun.figures import EpisodeFigures
from avp_sb3.rerun.file import RecordingFile, new_recording_file
from avp_sb3.rerun.layout import blueprint, eye_above
from avp_sb3.rerun.live import LiveViewer
from avp_sb3.rerun.room import log_room

DEFAULT_FOLDER = Path("runs")


class RerunCallback(BaseCallback):
    """Writes finished episodes to one `.rrd` file per training (open it with `rerun FILE`), and shows them live.

    Every k-th episode is there with its scene, floor, path, views, pictures and rewards, and the figures of all
    finished episodes (`info["avp_episode"]`) as curves. The pictures are rendered after the episode has ended, so steps
    in between cost nothing. Any environment that reports `info["avp_trajectory"]` will do; without an `area` it has no
    floor, without `capture` no pictures, without both no room, without `info["avp_episode"]` no curves.

    An episode of 80 steps with 6 pictures of 240x180 takes about 0.2 MB, a scene 0.5 to 1 MB once, 1,000 episodes'
    figures 0.4 MB (1 MB at five episodes a second: every 10 s some are sent). `max_bytes` bounds the whole file,
    `max_share` the time. When the disk is full or a viewer goes away, it says so once and the training goes on.
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
            live: also show it while it grows: `viewer` opens a window, `web` serves a page to this machine's browsers
                (its address is printed), both until `close()` or the end of the program; `rerun+http://HOST:PORT/proxy`
                sends to a viewer that is open (`rerun`), which stays open.
            every: record the first finished episode, and the next one when k more have ended (counted over all
                environments) and `max_share` allows it.
            pictures: RGB and depth pictures per episode at most, spread over its steps; 0 for none.
            width: of the pictures, pixels.
            height: of the pictures, pixels.
            max_bytes: nothing is added that would make the file larger than about this.
            max_share: recording may take this share of the training's time; 1 records every k-th episode.
            verbose: 1 prints at the end where the recording is, 2 also at the start; 0 prints nothing.

        Raises:
            UsageError: an option that cannot be right.
        """
        super().__init__(verbose)
        for name, value, least in (
            ("every", every, 1),
            ("pictures", pictures, 0),
            ("width", width, 1),
            ("height", height, 1),
            ("max_bytes", max_bytes, 1),
        ):
            if value < least:
                raise UsageError(f"RerunCallback {name}: expected at least {least}, got {value}")
        if not 0 < max_share <= 1:
            raise UsageError(f"RerunCallback max_share: expected a number within (0, 1], got {max_share}")
        self.path: Path | None = None
        self._wanted_path = None if path is None else Path(path)
        self._every, self._pictures, self._max_bytes, self._max_share = every, pictures, max_bytes, max_share
        self._size = (width, height)
        self._live = None if live is None else LiveViewer(live)
        self._file: RecordingFile | None = None
        self._trainings = 0

    def close(self) -> None:
        """Finish the file, as the end of `learn()` does, and stop a viewer or server that `live` has started."""
        self._finish()
        if self._live is not None:
            self._live.close()

    def _on_training_start(self) -> None:
        self._finish()
        self._trainings += 1
        self._episodes = self._steps = self._largest = 0
        self._due, self._started, self._spent = 1, time.monotonic(), 0.0
        self._environments = RecordedEnvironments(self.training_env)
        self._figures = EpisodeFigures()
        self._said: set[str] = set()
        self._shown: set[str] = set()
        names = self._environments.scenes
        self._roots = {name: _root(name) if len(names) > 1 else "" for name in names}
        areas = self._environments.areas
        self._eyes = {self._roots[name]: eye_above(area.centres) for name, area in areas.items()}
        self._file = new_recording_file(self._next_path(), self._blueprint())
        self.path = self._file.path
        # An interrupted training has no end that would finish the file.
        atexit.register(self._finish)
        if self.verbose > 1:
            print(f"Rerun:    {self.path}", flush=True)
        if self._live is not None:
            self._live.open(self._file.recording_id, self._blueprint())
        if missing := self._environments.missing:
            lost = {"area": "floor and room", "capture": "pictures and room"}
            for name in missing:
                self._say(f"the environment has no {name!r}: recording without {lost[name]}")

    def _on_step(self) -> bool:
        for index, info in finished_episodes(self.locals):
            self._episodes += 1
            if "avp_episode" not in info:
                self._say("no 'avp_episode' in info at the end of an episode: recording without figures")
            trajectory = required(info, "avp_trajectory", reader="RerunCallback")
            last_step = None
            if self._is_due():
                last_step = self._timed_record(index, trajectory)
            self._figures.add(
                info.get("avp_episode", {}), episode=self._episodes, env_step=self.num_timesteps, step=last_step
            )
            if self._figures.due:
                self._send_figures()
        return True

    def _on_training_end(self) -> None:
        self._finish()

    def _finish(self) -> None:
        """Send what is kept, and end the recording; a viewer stays."""
        if self._file is None:
            return
        atexit.unregister(self._finish)
        self._send_figures()
        self._file.close()
        self._check_file()
        if self._live is not None:
            self._live.finish()
        self._file = None
        if self.verbose:
            print(f"Rerun:    rerun {shlex.quote(str(self.path))}", flush=True)

    def _is_due(self) -> bool:
        if self._episodes < self._due:
            return False
        in_time = self._spent <= self._max_share * (time.monotonic() - self._started)
        return in_time and self._has_room(self._largest)

    def _timed_record(self, index: int, trajectory: Any) -> int:
        """Record an episode; the step of its last view."""
        assert self._file is not None
        began, size = time.monotonic(), self._file.size
        self._record(index, trajectory)
        self._largest = max(self._largest, self._file.size - size)
        self._spent += time.monotonic() - began
        self._due = self._episodes + self._every
        return self._steps - 1

    def _record(self, index: int, trajectory: Any) -> None:
        assert self._file is not None
        width, height = self._size
        camera = self._environments.camera(index, width=width, height=height)
        views = self._environments.pictures(index, trajectory, camera, at_most=self._pictures)
        episode = episode_of(trajectory, self._environments.area(index), camera, views)
        root = self._root(self._environments.scene(index))
        is_new = root not in self._shown
        room = self._environments.room(index) if is_new else None
        if room is not None and not self._has_room(room[0].nbytes + room[1].nbytes):
            room = None
        self._shown.add(root)
        for recording in self._recordings():
            if room is not None:
                log_room(recording, f"{root}/world/room", *room)
            log_episode(
                recording,
                root,
                episode,
                number=self._episodes,
                first_step=self._steps,
                env_step=self.num_timesteps,
                with_scene=is_new,
            )
        self._steps += len(trajectory.action)
        self._file.flush()
        self._check_file()

    def _send_figures(self) -> None:
        assert self._file is not None
        if self._has_room(self._figures.size):
            self._figures.send(self._recordings())
        self._file.flush()
        self._check_file()

    def _recordings(self) -> list[rr.RecordingStream]:
        """Those that still take something."""
        assert self._file is not None
        streams = [self._file.recording] if self._file.fault is None else []
        if self._live is not None and (stream := self._live.recording) is not None:
            streams.append(stream)
        return streams

    def _root(self, scene: str) -> str:
        """The entity path of a scene; a scene that was not there at the start gets a place in the layout."""
        if scene not in self._roots:
            self._roots[scene] = _root(scene)
            for recording in self._recordings():
                recording.send_blueprint(self._blueprint())
        return self._roots[scene]

    def _blueprint(self) -> rr.blueprint.Blueprint:
        return blueprint(list(self._roots.values()), with_metrics=True, eyes=self._eyes)

    def _check_file(self) -> None:
        if self._file is not None and (fault := self._file.fault) is not None:
            self._say(f"{self._file.path}: {fault.strerror or fault}; what came before is kept, the training goes on")

    def _has_room(self, size: int) -> bool:
        assert self._file is not None
        if self._file.size + size < self._max_bytes:
            return True
        self._say(f"{self._file.path}: has reached max_bytes ({self._max_bytes}); nothing further is recorded")
        return False

    def _say(self, text: str) -> None:
        """A line on the error stream, once per training."""
        if text not in self._said:
            self._said.add(text)
            print(f"RerunCallback: {text}", file=sys.stderr)

    def _next_path(self) -> Path:
        path = self._wanted_path or DEFAULT_FOLDER / f"avp-{datetime.now():%Y%m%d-%H%M%S}.rrd"
        if self._trainings > 1 and self._wanted_path is not None:
            path = path.with_stem(f"{path.stem}-{self._trainings}")
        return path


def _root(scene: str) -> str:
    return f"/{rr.escape_entity_path_part(scene)}"
