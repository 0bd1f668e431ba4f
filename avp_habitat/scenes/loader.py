"""From what the user calls a scene, a path or `builtin:SEED`, to its mesh."""

import difflib
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.files import SceneFiles
from avp_habitat.scenes.mesh import TexturedMesh

BUILTIN = "builtin:"
_GLTF = (".glb", ".gltf")
SUFFIXES = (*_GLTF, ".ply", ".obj")


@dataclass(frozen=True)
class Scene:
    """A scene in memory."""

    name: str
    """What the user called it, without folders: a file's name or `builtin:SEED`."""
    digest: str
    """Hexadecimal SHA-256 of the content: of the file and those it refers to, or of seed and generator version."""
    mesh: TexturedMesh
    """Its surfaces, world frame, metres."""


def load_scene(spec: str) -> Scene:
    """Load a scene.

    Args:
        spec: path of a `.glb`, `.gltf`, `.ply` or `.obj` file (metres, Y up), or `builtin:SEED` for a generated room.

    Raises:
        UsageError: the suffix is not supported, or SEED is not an integer >= 0.
        SceneError: the file is missing, damaged, or holds no triangle.
    """
    return _generated(spec) if spec.startswith(BUILTIN) else _read(Path(spec))


def _generated(spec: str) -> Scene:
    text = spec.removeprefix(BUILTIN)
    if not (text.isascii() and text.isdigit()):
        raise UsageError(f"{spec}: expected {BUILTIN}SEED with an integer SEED >= 0, got {text!r}")
    from avp_habitat.scenes.builtin import GENERATOR_VERSION, generate_room

    seed = int(text)
    content = f"{BUILTIN}{seed}:v{GENERATOR_VERSION}"
    return Scene(f"{BUILTIN}{seed}", hashlib.sha256(content.encode()).hexdigest(), generate_room(seed))


def _read(path: Path) -> Scene:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        found = f"the suffix {path.suffix!r}" if suffix else "no suffix"
        raise UsageError(
            f"{path}: expected a scene file ({', '.join(SUFFIXES)}) or {BUILTIN}SEED, got a name with {found}"
        )
    if not path.is_file():
        raise _missing(path)
    files = SceneFiles(path)
    if suffix in _GLTF:
        from avp_habitat.scenes.gltf import read_gltf

        mesh = read_gltf(files)
    else:
        from avp_habitat.scenes.polygon_files import read_polygons

        mesh = read_polygons(files)
    _check(mesh, path)
    return Scene(path.name, files.digest(), mesh)


def _missing(path: Path) -> SceneError:
    if path.exists():
        return SceneError(f"{path}: expected a scene file, found a folder")
    if not path.parent.is_dir():
        return SceneError(f"{path}: there is no folder {path.parent}")
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.suffix.lower() in SUFFIXES)
    near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    return SceneError(f"{path}: no such scene file{hint}")


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
