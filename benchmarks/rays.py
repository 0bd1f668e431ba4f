"""Remembers the rays that a simulator casts, so that the same rays can be cast again by themselves."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.loader import Scene
from avp_habitat.simulators.base import Frames
from avp_habitat.simulators.raycast import RaycastSimulator


class RecordingSimulator(RaycastSimulator):
    """Casts rays as ever; between `start` and `stop` it remembers those of depth images and of cells.

    A remembered call costs a copy of its poses and pairs, far less than its rays.
    """

    def __init__(self, scene: Scene) -> None:
        """Build the ray-tracing structure of `scene`; nothing is remembered yet."""
        super().__init__(scene)
        self._calls: list[tuple[int, Callable[[], object]]] = []
        self._recording = False

    def start(self) -> None:
        """Forget the rays so far and remember those to come."""
        self._calls, self._recording = [], True

    def stop(self) -> None:
        """Remember no further rays."""
        self._recording = False

    @property
    def count(self) -> int:
        """How many rays are remembered."""
        return sum(rays for rays, _ in self._calls)

    def replay(self, seconds: float = float("inf")) -> tuple[int, float]:
        """Cast the remembered rays again, call by call as before.

        Args:
            seconds: stop after the call that passes this time.

        Returns:
            How many rays were cast, and in how many seconds.
        """
        rays, start = 0, time.perf_counter()
        for count, cast in self._calls:
            cast()
            rays += count
            if time.perf_counter() - start > seconds:
                break
        return rays, time.perf_counter() - start

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """See `Simulator`."""
        if self._recording:
            poses, again = np.array(camera_to_world), super().render
            rays = len(poses) * intrinsics.width * intrinsics.height
            self._calls.append((rays, lambda: again(poses, intrinsics, rgb=rgb)))
        return super().render(camera_to_world, intrinsics, rgb=rgb)

    def reached(
        self, eye: NDArray[np.floating], points: NDArray[np.floating], pairs: NDArray[np.integer], *, tolerance_m: float
    ) -> NDArray[np.bool_]:
        """See `SingleRays`."""
        if self._recording:
            eyes, rows, again = np.array(eye), np.array(pairs), super().reached
            self._calls.append((len(rows), lambda: again(eyes, points, rows, tolerance_m=tolerance_m)))
        return super().reached(eye, points, pairs, tolerance_m=tolerance_m)
