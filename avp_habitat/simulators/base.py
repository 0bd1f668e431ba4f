"""What the task asks of a simulator, and nothing more; what only some can do has a Protocol of its own."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SimulatorError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.location import Frame
from avp_habitat.scenes.mesh import TexturedMesh


@dataclass(frozen=True)
class Frames:
    """What n cameras see."""

    rgb: NDArray[np.uint8] | None
    """`(n, height, width, 3)`, or None when not asked for."""
    depth: NDArray[np.float32]
    """`(n, height, width)` planar depth in metres, 0.0 where nothing was hit."""


class Simulator(Protocol):
    """A scene in which agents stand, walk and look."""

    name: str
    """As rollouts store it: `"raycast"`, for example."""
    version: str
    """Version of the engine that renders."""
    scene: str
    """What the user called the scene, without folders: a file's name, `builtin:SEED` or `builtin-home:SEED`."""
    scene_digest: str
    """Hexadecimal SHA-256 of the scene's content."""
    scene_frame: Frame
    """How the scene's file lies in the world."""

    @property
    def area(self) -> NavigableArea:
        """Where agents can stand."""
        ...

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """Depth, and colour when asked for (None where a simulator has none), of `(n, 4, 4)` habitat poses."""
        ...

    def visible(
        self,
        camera_to_world: NDArray[np.floating],
        intrinsics: Intrinsics,
        points: NDArray[np.floating],
        pairs: NDArray[np.integer],
        *,
        tolerance_m: float,
    ) -> NDArray[np.bool_]:
        """Whether cameras see points: inside the image (`sight.rules.in_image`), and reached by the ray through it.

        Args:
            camera_to_world: `(n, 4, 4)` habitat poses.
            intrinsics: of all n cameras.
            points: `(m, 3)` metres, world frame.
            pairs: `(k, 2)` rows (camera, point).
            tolerance_m: a hit this close before the point still reaches it, in metres along the ray.

        Returns:
            `(k,)`; False for what lies behind a camera or beside its image.
        """
        ...

    def close(self) -> None:
        """Free what the simulator holds."""
        ...


ASKED = ("name", "version", "scene", "scene_digest", "scene_frame", "area", "render", "visible", "close")
"""The members of `Simulator`."""


def pictures(simulator: Simulator, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics) -> Frames:
    """Colour and depth of `(n, 4, 4)` habitat poses.

    Raises:
        SimulatorError: the simulator shows no colour.
    """
    frames = simulator.render(camera_to_world, intrinsics, rgb=True)
    if frames.rgb is None:
        raise SimulatorError(
            f"{simulator.scene}: expected pictures, but the simulator {simulator.name} shows no colour"
        )
    return frames


@runtime_checkable
class SingleRays(Simulator, Protocol):
    """A simulator that casts rays one by one in any direction, beside whole images; ask for it by `isinstance`."""

    def reached(
        self, eye: NDArray[np.floating], points: NDArray[np.floating], pairs: NDArray[np.integer], *, tolerance_m: float
    ) -> NDArray[np.bool_]:
        """Whether rays reach points, whichever way one would have to look.

        Args:
            eye: `(n, 3)` metres, world frame.
            points: `(m, 3)` metres, world frame.
            pairs: `(k, 2)` rows (eye, point).
            tolerance_m: a hit this close before the point still reaches it, in metres along the ray.

        Returns:
            `(k,)`; a point nearer than the tolerance is always reached.
        """
        ...

    def distance(self, origin: NDArray[np.floating], direction: NDArray[np.floating]) -> NDArray[np.float32]:
        """`(k,)` metres from `(k, 3)` origins along `(k, 3)` unit directions to the first surface, inf for none."""
        ...


@runtime_checkable
class Meshed(Simulator, Protocol):
    """A simulator that can say where all the surface of its scene is; ask for it by `isinstance`."""

    def surface_mesh(self) -> TexturedMesh:
        """The scene's triangles, world frame, metres.

        Raises:
            SceneError: they cannot be read.
        """
        ...
