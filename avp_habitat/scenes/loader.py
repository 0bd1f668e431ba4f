"""From what the user calls a scene to its mesh in the world."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.poses import axes_to_world
from avp_habitat.scenes.files import SceneFiles
from avp_habitat.scenes.location import BUILTIN, SceneLocation, locate
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.scenes.stage_config import Y_UP

_GLTF = (".glb", ".gltf")


@dataclass(frozen=True)
class Scene:
    """A scene in memory."""

    name: str
    """What the user called it, without folders: a file's name or `builtin:SEED`."""
    digest: str
    """Hexadecimal SHA-256 of the content; see `scene_digest`."""
    mesh: TexturedMesh
    """Its surfaces, world frame, metres."""


def load_scene(spec: str) -> Scene:
    """Load a scene.

    Args:
        spec: a mesh (metres), a scene of Replica or of a scene dataset config, or `builtin:SEED` for a generated room;
            `avp_habitat.scenes.location.locate` says what can be written.

    Raises:
        UsageError: nothing that a scene could be called.
        SceneError: the scene is missing, damaged, holds no triangle, or has objects, which only Habitat-Sim shows.
    """
    location = locate(spec)
    if location.asset is None:
        from avp_habitat.scenes.builtin import generate_room

        return Scene(location.name, scene_digest(location), generate_room(_seed(location)))
    if location.objects:
        raise SceneError(
            f"{location.dataset}:{location.scene_id}: has {location.objects} objects besides its stage, which raycast "
            "does not show; use --simulator habitat"
        )
    files = SceneFiles(location.asset)
    mesh = _to_world(_read(files), location)
    return Scene(location.name, _digest(location, files), mesh)


def scene_digest(location: SceneLocation) -> str:
    """Hexadecimal SHA-256 of what a scene is made of, the same as that of the loaded scene.

    It covers the mesh and the files that it refers to; where a scene has configs or axes other than Y up, -Z front,
    those too (of objects, the config that names them); of a generated room the seed and the generator's version.

    Raises:
        SceneError: the mesh is damaged, or holds no triangle.
    """
    if location.asset is None:
        from avp_habitat.scenes.builtin import GENERATOR_VERSION

        return hashlib.sha256(f"{BUILTIN}{_seed(location)}:v{GENERATOR_VERSION}".encode()).hexdigest()
    files = SceneFiles(location.asset)
    try:
        _read(files)
    except SceneError as error:
        # The textures of HM3D, which only Habitat-Sim reads; they are part of the file itself.
        if "KHR_texture_basisu" not in str(error):
            raise
    return _digest(location, files)


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
    _check(mesh, files.path)
    return mesh


def _to_world(mesh: TexturedMesh, location: SceneLocation) -> TexturedMesh:
    """The mesh turned from its file's axes; written out, because BLAS may add in another order on other machines."""
    if (location.up, location.front) == Y_UP:
        return mesh
    x, y, z = mesh.vertices.astype(np.float64).T
    rows = axes_to_world(location.up, location.front)
    turned = np.stack([row[0] * x + row[1] * y + row[2] * z for row in rows], axis=1)
    return replace(mesh, vertices=turned.astype(np.float32))


def _check(mesh: TexturedMesh, path: Path) -> None:
    """Refuse what a renderer could not use."""
    if not len(mesh.triangles):
        raise SceneError(f"{path}: expected a mesh with triangles, found none")
    for name, values in (("position", mesh.vertices), ("texture coordinate", mesh.uv), ("colour", mesh.colours)):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise SceneError(
                f"{path}: expected finite numbers, but {len(wrong)} of {len(values)} vertices have a {name} that "
                f"is NaN or infinite (the first is vertex {wrong[0]})"
            )
