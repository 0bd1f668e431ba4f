"""Writing a rollout folder so that it exists only when it is whole."""

import csv
import json
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.files import atomic_folder, check_new
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.format import FORMAT, FORMAT_VERSION, HELDOUT, POSE_CONVENTION, View, frame_name, view_of

_FOLDERS = [f"{base}/{kind}".lstrip("/") for base in ("", HELDOUT) for kind in ("images", "depth", "poses")]
_THREADS = 4
_AHEAD = 8
"""At most so many pictures wait to be encoded and written, which bounds the memory."""


class RolloutWriter:
    """A context that fills a folder, which appears when `publish` is called, and only then.

    Views are encoded in threads while the next are rendered: their arrays must not change once they were added, and a
    disk that fails is reported by one of the next calls, by `publish` at the latest.
    """

    def __init__(self, folder: str | Path, intrinsics: Intrinsics) -> None:
        """Name the folder, which must not exist, and the camera of every picture.

        Raises:
            UsageError: the folder exists.
        """
        self.folder = Path(folder)
        self.intrinsics = intrinsics
        check_new(self.folder, option="--out")
        self._context = ExitStack()
        self._partial = self.folder
        self._poses: dict[str, list[NDArray[np.float64]]] = {"": [], HELDOUT: []}
        self._steps: list[dict[str, Any]] = []
        self._threads = ThreadPoolExecutor(_THREADS)
        self._pending: deque[Future[None]] = deque()

    def __enter__(self) -> "RolloutWriter":
        """Make the temporary folder.

        Raises:
            RolloutError: nothing can be written there.
        """
        with ExitStack() as context:
            self._partial = context.enter_context(atomic_folder(self.folder, failure=RolloutError, option="--out"))
            for kind in _FOLDERS:
                self.path(kind).mkdir(parents=True)
            self._context = context.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove what was not published; report a full or failing disk as such."""
        self._threads.shutdown(cancel_futures=True)
        # What ends without an error, but was not published, is abandoned, as a generator is that is closed.
        error = error or GeneratorExit()
        self._context.__exit__(type(error), error, trace)

    def add_frame(self, rgb: NDArray[np.uint8], depth: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        """Write the next captured frame: `(h, w, 3)` uint8, `(h, w)` metres, `(4, 4)` habitat camera_to_world."""
        self._add("", rgb, depth, pose)

    def add_heldout(self, rgb: NDArray[np.uint8], depth: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        """Write the next held-out view, as `add_frame` takes it."""
        self._add(HELDOUT, rgb, depth, pose)

    def add_step(self, row: Mapping[str, Any]) -> None:
        """Remember the next row of `steps.csv`; a key that only some rows have is 0 in the others."""
        self._steps.append(dict(row))

    def views(self, *, heldout: bool) -> list[View]:
        """The captured frames, or the held-out views, so far; all of them are written."""
        self._finish(waiting=0)
        base = HELDOUT if heldout else ""
        return [view_of(self.path(base), index, pose) for index, pose in enumerate(self._poses[base])]

    def path(self, name: str) -> Path:
        """Where to write a further file of the folder."""
        return self._partial / name

    def publish(self, meta: Mapping[str, Any]) -> Path:
        """Write the tables, `rollout.json` with these further keys, then give the folder its final name.

        Raises:
            UsageError: a folder of that name has appeared meanwhile.
        """
        self._finish(waiting=0)
        self._write_steps()
        self._write_json("transforms.json", self._transforms())
        self._write_json("rollout.json", self._rollout(meta))
        self._context.close()
        return self.folder

    def _add(self, base: str, rgb: NDArray[np.uint8], depth: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        folder, stem = self.path(base), frame_name(len(self._poses[base]))
        rows = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in pose)
        (folder / "poses" / f"{stem}.txt").write_text(rows + "\n", encoding="ascii")
        self._poses[base].append(np.asarray(pose, dtype=np.float64))
        self._pending.append(self._threads.submit(images.write_rgb, folder / "images" / f"{stem}.png", rgb))
        self._pending.append(self._threads.submit(images.write_depth, folder / "depth" / f"{stem}.png", depth))
        self._finish(waiting=_AHEAD)

    def _finish(self, *, waiting: int) -> None:
        """Wait until at most so many pictures are still to be written; raises what went wrong with the others."""
        while len(self._pending) > waiting:
            self._pending.popleft().result()

    def _rollout(self, meta: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "pose_convention": POSE_CONVENTION,
            "counts": {"frames": len(self._poses[""]), HELDOUT: len(self._poses[HELDOUT])},
            "depth": {"unit": "millimetre", "kind": "planar z-depth", "none": 0},
            **meta,
            "camera": asdict(self.intrinsics) | dict(meta.get("camera", {})),
        }

    def _transforms(self) -> dict[str, Any]:
        names: dict[str, list[str]] = {}
        frames = []
        for base, poses in self._poses.items():
            views = [view_of(Path(base), index, pose) for index, pose in enumerate(poses)]
            names[base] = [view.image.as_posix() for view in views]
            for view in views:
                files = {"file_path": view.image.as_posix(), "depth_file_path": view.depth.as_posix()}
                frames.append({**files, "transform_matrix": view.camera_to_world.tolist()})
        camera = self.intrinsics
        return {
            "camera_model": "OPENCV",
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "depth_unit_scale_factor": images.DEPTH_UNIT_M,
            "train_filenames": names[""],
            "val_filenames": names[HELDOUT],
            "test_filenames": names[HELDOUT],
            "frames": frames,
        }

    def _write_steps(self) -> None:
        with self.path("steps.csv").open("w", newline="", encoding="utf-8") as file:
            names = dict.fromkeys(name for row in self._steps for name in row)
            writer = csv.DictWriter(file, fieldnames=list(names), restval=0)
            writer.writeheader()
            writer.writerows(self._steps)

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        text = json.dumps(value, indent=2, allow_nan=False)
        self.path(name).write_text(text + "\n", encoding="utf-8")
