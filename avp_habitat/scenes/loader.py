"""From what the user calls a scene to its mesh in the world."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles
from avp_habitat.scenes.location import BUILTIN, Frame, SceneLocation, locate
from avp_habitat.scenes.mesh import TexturedMesh, say_once
from avp_habitat.scenes.placing import check_numbers, looks_z_up, lost_mm, place
from avp_habitat.scenes.stage_config import Y_UP

_GLTF = (".glb", ".gltf")
_MOST_LOST_MM = 100


@dataclass(frozen=True)
class Scene:
    """A scene in memory."""

    name: str
    """What the user called it, without folders: a file's name or `builtin:SEED`."""
    digest: str
    """Hexadecimal SHA-256 of the content; see `scene_digest`."""
    mesh: TexturedMesh
    """Its surfaces, world frame, metres."""
    frame: Frame = field(default_factory=Frame)
    """How the file lies in the world."""


def load_scene(spec: str | Path, *, up: str | None = None, origin: Sequence[float] | None = None) -> Scene:
    """Load a scene.

    Args:
        spec: a mesh (metres), a scene of Replica or of a scene dataset config, or `builtin:SEED` for a generated room;
            `avp_habitat.scenes.location.locate` says what can be written.
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
        from avp_habitat.scenes.builtin.room import generate_room

        return Scene(location.name, scene_digest(location), generate_room(_seed(location)))
    if location.objects:
        raise SceneError(
            f"{location.dataset}:{location.scene_id}: has {location.objects} objects besides its stage, which raycast "
            "does not show; use --simulator habitat"
        )
    files = SceneFiles(location.asset)
    mesh, frame = _placed(_read(files), location, origin)
    return Scene(location.name, _digest(location, files), mesh, frame)


def identify(location: SceneLocation) -> tuple[str, Frame]:
    """Digest and frame of a scene, the same as those of the loaded scene.

    The digest is the hexadecimal SHA-256 of what the scene is made of: of the mesh and the files that it refers to;
    where a scene has configs or axes other than Y up, -Z front, of those too (of objects, the config that names them);
    of a generated room of the seed and the generator's version.

    Raises:
        SceneError: the mesh is damaged, or holds no triangle.
    """
    if location.asset is None:
        from avp_habitat.scenes.builtin.room import GENERATOR_VERSION

        text = f"{BUILTIN}{_seed(location)}:v{GENERATOR_VERSION}"
        return hashlib.sha256(text.encode()).hexdigest(), Frame()
    files = SceneFiles(location.asset)
    frame = Frame(up=location.told_up)
    try:
        frame = _placed(_read(files), location)[1]
    except SceneError as error:
        # The textures of HM3D, which only Habitat-Sim reads; they are part of the file itself.
        if "KHR_texture_basisu" not in str(error):
            raise
    return _digest(location, files), frame


def scene_digest(location: SceneLocation) -> str:
    """The digest alone of `identify`."""
    return identify(location)[0]


def _seed(location: SceneLocation) -> int:
    return int(location.name.removeprefix(BUILTIN))


def _digest(location: SceneLocation, files: SceneFiles) -> str:
    axes = (location.up, location.front)
    if axes == Y_UP and not location.files:
        return files.digest()
    content = hashlib.sha256(f"{files.digest()} {axes} {location.scene_id}".encode())
    for path in location.files:
        content.update(hashlib.sha256(path.read_bytes()).digest())
    return content.hexdigest()


def _read(files: SceneFiles) -> TexturedMesh:
    suffix = files.path.suffix.lower()
    if suffix in _GLTF:
        from avp_habitat.scenes.gltf import read_gltf as read
    elif suffix == ".ply":
        from avp_habitat.scenes.ply import read_ply as read
    else:
        from avp_habitat.scenes.obj import read_obj as read
    mesh = read(files)
    check_numbers(mesh, files.path)
    return mesh


def _placed(
    mesh: TexturedMesh, location: SceneLocation, origin: Sequence[float] | None = None
) -> tuple[TexturedMesh, Frame]:
    """The mesh in the world, and what has to be said of how it lies there."""
    asset = str(location.asset)
    lost = 0.0 if asset.lower().endswith(".obj") else lost_mm(mesh)
    mesh, moved = place(mesh, (location.up, location.front), origin, asset)
    if any(moved):
        far = f"{max(map(abs, moved)):.0f} m"
        if lost >= _MOST_LOST_MM:
            raise SceneError(
                f"{asset}: has coordinates of {far} in float32, which has steps of {lost:.0f} mm there: "
                "expected a mesh that was exported near its origin"
            )
        text = f"lies {far} from its origin: ({', '.join(f'{each:.0f}' for each in moved)}) m are taken off"
        say_once(asset, text + (f"; as float32, its coordinates are rounded to {lost:.0f} mm" if lost >= 1 else ""))
    if (location.up, location.front) == Y_UP and location.told_up is None and looks_z_up(mesh):
        own = f'"up": [0, 0, 1], "front": [0, 1, 0] in {location.files[-1].name}' if location.files else "--up z"
        say_once(asset, f"is taken as Y-up, but looks like a Z-up room on its side; if it is one, say {own}")
    return mesh, Frame(moved, location.told_up)
