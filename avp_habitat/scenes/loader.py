"""From what the user calls a scene to its mesh in the world: read, checked, turned, moved to a local origin."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.poses import axes_to_world
from avp_habitat.scenes.files import SceneFiles
from avp_habitat.scenes.location import HOME, Frame, SceneLocation, locate
from avp_habitat.scenes.mesh import TexturedMesh, warn_once
from avp_habitat.scenes.obj import read_obj
from avp_habitat.scenes.ply import read_ply
from avp_habitat.scenes.stage_config import Y_UP, Axes

_MOST_LOST_MM = 100
_FAR_M = 1000.0
"""From here on, float32 has steps of more than 0.06 mm."""
_LARGEST_M = 1e6
_LARGEST_ROOM_M = 200
_MOST_LOOKED_AT = 200_000


@dataclass(frozen=True)
class Scene:
    """A scene in memory."""

    name: str
    """What the user called it, without folders: a file's name, `builtin:SEED` or `builtin-home:SEED`."""
    digest: str
    """Hexadecimal SHA-256 of the content; see `identify`."""
    mesh: TexturedMesh
    """Its surfaces, world frame, metres."""
    frame: Frame = field(default_factory=Frame)
    """How the file lies in the world."""


def load_scene(spec: str | Path, *, up: str | None = None, origin: Sequence[float] | None = None) -> Scene:
    """Load a scene.

    Args:
        spec: what `avp_habitat.scenes.location.locate` takes; meshes are in metres.
        up: axis of a mesh file that points up, `y` or `z`.
        origin: `(3,)` taken off the file's coordinates, turned to Y up, as a rollout of the scene says it; chosen here
            when omitted.

    Raises:
        UsageError: nothing that a scene could be called.
        SceneError: the scene is missing, damaged, holds no triangle, or has objects, which only Habitat-Sim shows.
    """
    return load_located(locate(spec, up=up), origin=origin)


def load_located(location: SceneLocation, *, origin: Sequence[float] | None = None) -> Scene:
    """Load a scene that was located; arguments and errors as of `load_scene`."""
    if location.asset is None:
        generate, _ = _generator(location.name)
        return Scene(location.name, identify(location)[0], generate(int(location.name.partition(":")[2])))
    if location.objects:
        raise SceneError(
            f"{location.dataset}:{location.scene_id}: has {location.objects} objects besides its stage, which raycast "
            "does not show; use --simulator habitat"
        )
    files = SceneFiles(location.asset)
    mesh, frame = _placed(_read(files), location, origin)
    return Scene(location.name, _digest(location, files), mesh, frame)


def _generator(name: str) -> tuple[Callable[[int], TexturedMesh], int]:
    """What makes a scene of such a name from its seed, and the version of that."""
    if name.startswith(HOME):
        from avp_habitat.scenes.builtin.home.home import HOME_VERSION, generate_home

        return generate_home, HOME_VERSION
    from avp_habitat.scenes.builtin.room import GENERATOR_VERSION, generate_room

    return generate_room, GENERATOR_VERSION


def identify(location: SceneLocation) -> tuple[str, Frame]:
    """Digest and frame of a scene, the same as those of the loaded scene; SceneError where the mesh cannot be read.

    The digest is the hexadecimal SHA-256 of what the scene is made of: of the mesh and the files that it refers to;
    where a scene has configs or axes other than Y up, -Z front, of those too (of objects, the config that names them);
    of a generated room or home of its name and the generator's version.
    """
    if location.asset is None:
        _, version = _generator(location.name)
        return hashlib.sha256(f"{location.name}:v{version}".encode()).hexdigest(), Frame()
    files = SceneFiles(location.asset)
    frame = Frame(up=location.chosen_up)
    try:
        frame = _placed(_read(files), location)[1]
    except SceneError as error:
        # The textures of HM3D, which only Habitat-Sim reads; they are part of the file itself.
        if "KHR_texture_basisu" not in str(error):
            raise
    return _digest(location, files), frame


def _digest(location: SceneLocation, files: SceneFiles) -> str:
    axes = (location.up, location.front)
    if axes == Y_UP and not location.files:
        return files.digest()
    content = hashlib.sha256(f"{files.digest()} {axes} {location.scene_id}".encode())
    for path in location.files:
        content.update(hashlib.sha256(path.read_bytes()).digest())
    return content.hexdigest()


def _read(files: SceneFiles) -> TexturedMesh:
    """The mesh of a file, refused where a renderer could not use it: without triangles, or with NaN or infinities."""
    suffix = files.path.suffix.lower()
    if suffix == ".ply":
        mesh = read_ply(files)
    elif suffix == ".obj":
        mesh = read_obj(files)
    else:
        from avp_habitat.scenes.gltf import read_gltf

        mesh = read_gltf(files)
    if not len(mesh.triangles):
        raise SceneError(f"{files.path}: expected a mesh with triangles, found none")
    for name, values in (("position", mesh.vertices), ("texture coordinate", mesh.uv), ("colour", mesh.colours)):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise SceneError(
                f"{files.path}: expected finite numbers, but {len(wrong)} of {len(values)} vertices have a {name} that "
                f"is NaN or infinite (the first is vertex {wrong[0]})"
            )
    return mesh


def _placed(
    mesh: TexturedMesh, location: SceneLocation, origin: Sequence[float] | None = None
) -> tuple[TexturedMesh, Frame]:
    """The mesh in the world, after what has to be said of how it lies there."""
    asset, axes = str(location.asset), (location.up, location.front)
    lost_mm = 0.0 if asset.lower().endswith(".obj") else _float32_step_mm(mesh)
    mesh, moved = _moved(mesh, axes, origin, asset)
    if any(moved):
        far = f"{max(map(abs, moved)):.0f} m"
        if lost_mm >= _MOST_LOST_MM:
            raise SceneError(
                f"{asset}: has coordinates of {far} in float32, which has steps of {lost_mm:.0f} mm there: "
                "expected a mesh that was exported near its origin"
            )
        text = f"lies {far} from its origin: ({', '.join(f'{each:.0f}' for each in moved)}) m are taken off"
        rounded = f"; as float32, its coordinates are rounded to {lost_mm:.0f} mm" if lost_mm >= 1 else ""
        warn_once(asset, text + rounded)
    if axes == Y_UP and location.chosen_up is None and looks_z_up(mesh):
        own = f'"up": [0, 0, 1], "front": [0, 1, 0] in {location.files[-1].name}' if location.files else "--up z"
        warn_once(asset, f"is taken as Y-up, but looks like a Z-up room on its side; if it is one, say {own}")
    return mesh, Frame(moved, location.chosen_up)


def _float32_step_mm(mesh: TexturedMesh) -> float:
    """Step in millimetres of the greatest coordinate, when the file's numbers are no finer than float32; else 0."""
    largest = np.abs(mesh.vertices).max()
    if not largest < np.finfo(np.float32).max or (mesh.vertices.astype(np.float32) != mesh.vertices).any():
        return 0.0
    return 1000 * float(np.spacing(np.float32(largest)))


def _moved(
    mesh: TexturedMesh, axes: Axes, origin: Sequence[float] | None, name: str
) -> tuple[TexturedMesh, tuple[float, float, float]]:
    """Turn a mesh to the world's axes and take a local origin off, in float64, before it is cut to float32.

    Without an origin, whole metres are taken off along each axis on which all triangles are farther than a kilometre
    from zero (georeferenced scenes: UTM, ECEF), so that the middle comes to zero.
    """
    vertices = mesh.vertices.astype(np.float64)
    if axes != Y_UP:
        # Written out, because BLAS may add in another order on other machines.
        x, y, z = vertices.T
        vertices = np.stack([row[0] * x + row[1] * y + row[2] * z for row in axes_to_world(*axes)], axis=1)
    # What no triangle uses may lie anywhere.
    used = np.zeros(len(vertices), bool)
    used[mesh.triangles] = True
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    if origin is None:
        far = (low > _FAR_M) | (high < -_FAR_M)
        origin = np.where(far, np.round(low / 2 + high / 2), 0.0).tolist()
    shift = np.asarray(origin, np.float64)
    largest = np.abs([low - shift, high - shift]).max()
    if largest > _LARGEST_M:
        raise SceneError(
            f"{name}: has coordinates of {largest:.3g} m, where float32 cannot hold millimetres: expected a room in "
            "metres, at most 1000 km wide"
        )
    moved = np.clip(vertices - shift, -_LARGEST_M, _LARGEST_M).astype(np.float32)
    return replace(mesh, vertices=moved), (float(shift[0]), float(shift[1]), float(shift[2]))


def looks_z_up(mesh: TexturedMesh) -> bool:
    """Whether a mesh that is taken as Y-up looks like a room with Z up that lies on its side.

    All of these hold: along Z it is as high as a storey, and along Y clearly larger; the two largest level planes
    (floor and ceiling) are those across Z; the furniture, which is no large plane, keeps to the lower end of Z, and
    more so than to that of Y; and what is level across Y is not spread evenly, as steps are. The shares part 31
    generated, two scanned and a box room, laid on their sides, from 500 corridors, stairwells, attics and lofts.
    """
    triangles = mesh.triangles[:: max(1, len(mesh.triangles) // _MOST_LOOKED_AT)]
    corners = mesh.vertices[triangles].astype(np.float64)
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt((crossed * crossed).sum(axis=1)) / 2
    level = np.abs(crossed) > 0.98 * 2 * area[:, None]
    middle = corners.mean(axis=1)
    middle -= middle.min(axis=0)
    extent = middle.max(axis=0)
    if not (1.9 <= extent[2] <= 5.0 and max(3.3, 1.15 * extent[2]) < extent[1] < _LARGEST_ROOM_M):
        return False
    planes, small = np.zeros(3), np.ones(len(area), bool)
    for axis in range(3):
        bins = np.minimum(middle[:, axis] / 0.1, 10 * _LARGEST_ROOM_M).astype(np.int64)
        in_bin = np.bincount(bins, weights=area * level[:, axis])
        planes[axis] = np.sort(in_bin)[-2:].sum()
        small &= ~(level[:, axis] & (in_bin[bins] > 0.02 * area.sum()))
    lower = [(area * (small & (middle[:, k] < 0.4 * extent[k]))).sum() / max(area[small].sum(), 1e-9) for k in (1, 2)]
    share = np.bincount((16 * middle[:, 1] / extent[1]).astype(np.int64), weights=area * level[:, 1])[1:15]
    return bool(
        planes[2] > 1.2 * max(planes[0], planes[1])
        and lower[1] > max(0.55, lower[0])
        and lower[0] < 0.75
        and share.std() > 0.4 * share.mean()
    )
