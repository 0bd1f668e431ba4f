"""Reads `.ply` and `.obj` through trimesh into one TexturedMesh."""

import io
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, decode_picture
from avp_habitat.scenes.mesh import TexturedMesh, merge


def read_polygons(files: SceneFiles) -> TexturedMesh:
    """The triangles of a `.ply` or `.obj` file; its axes are taken as they are (metres, Y up).

    Args:
        files: the file and its folder.

    Raises:
        SceneError: the file is damaged, holds no face, or refers to a file that is missing or outside its folder.
    """
    import trimesh

    kind = files.path.suffix.lower().removeprefix(".")
    if kind == "ply" and b"end_header" not in files.main:
        raise SceneError(f"{files.path}: truncated: expected a PLY header that ends with end_header")
    references = _References(files, library_first=kind == "obj")
    try:
        with _silenced("trimesh"):
            scene = trimesh.load_scene(io.BytesIO(files.main), file_type=kind, resolver=references, process=False)
    except Exception as error:
        # trimesh raises whatever its parsers stumble over; all of it means that this file is damaged.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{files.path}: expected a valid .{kind} file, but it is damaged: {reason}") from error
    references.raise_failure()
    surfaces = [geometry for geometry in scene.geometry.values() if len(getattr(geometry, "faces", ()))]
    parts = [_part(surface, files, references) for surface in surfaces]
    if not parts:
        raise SceneError(f"{files.path}: expected a mesh with triangles, found none")
    return merge(parts)


@contextmanager
def _silenced(name: str) -> Iterator[None]:
    """Keep a logger quiet about failures that are raised here as errors."""
    logger = logging.getLogger(name)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


class _References(Mapping[str, bytes]):
    """Hands referenced files to trimesh, and keeps what went wrong, which trimesh only writes to its log."""

    def __init__(self, files: SceneFiles, *, library_first: bool) -> None:
        self._files = files
        self._library_next = library_first
        self._failure: SceneError | None = None
        self._pictures: list[NDArray[np.uint8]] = []

    def __getitem__(self, name: str) -> bytes:
        """Content of the referenced file; every one but an OBJ's material library must be a picture."""
        try:
            content = self._files.read(name)
            if not self._library_next:
                self._pictures.append(decode_picture(content, f"{self._files.path}: {name}"))
            self._library_next = False
            return content
        except SceneError as failure:
            self._failure = self._failure or failure
            raise

    def __iter__(self) -> Iterator[str]:
        """No names: files are only read when asked for."""
        return iter(())

    def __len__(self) -> int:
        """No names: files are only read when asked for."""
        return 0

    def raise_failure(self) -> None:
        """Raise the first error that trimesh swallowed."""
        if self._failure is not None:
            raise self._failure

    def pixels(self, image: Any) -> NDArray[np.uint8]:
        """The decoded `(height, width, 3)` picture of a Pillow image, always the same object for equal pictures."""
        pixels = np.asarray(image.convert("RGB"))
        return next((known for known in self._pictures if np.array_equal(known, pixels)), pixels)


def _part(geometry: Any, files: SceneFiles, references: _References) -> TexturedMesh:
    vertices = np.asarray(geometry.vertices, np.float32)
    triangles = np.asarray(geometry.faces, np.int32)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise SceneError(f"{files.path}: expected three coordinates for every vertex, got shape {vertices.shape}")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise SceneError(
            f"{files.path}: a face names vertices {triangles.min()} to {triangles.max()} of {len(vertices)}"
        )
    if geometry.visual.kind == "texture":
        light = geometry.vertex_attributes.get("color")
        return _textured(vertices, triangles, geometry.visual, _fractions(light, len(vertices)), references)
    return _coloured(vertices, triangles, geometry.visual)


def _textured(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    visual: Any,
    light: NDArray[np.float32],
    references: _References,
) -> TexturedMesh:
    """Texture times diffuse colour times vertex colour, as the MTL format defines it; v points upwards here."""
    image = getattr(visual.material, "image", None)
    uv = np.zeros((len(vertices), 2), np.float32)
    stored = np.zeros((0, 2)) if visual.uv is None else np.asarray(visual.uv)
    textured = image is not None and len(stored) == len(vertices) and stored.shape[1] >= 2
    if textured:
        uv = np.stack([stored[:, 0], 1.0 - stored[:, 1]], axis=1).astype(np.float32)
    diffuse = getattr(visual.material, "kwargs", {}).get("kd", [1.0, 1.0, 1.0])
    colours = np.clip(light * np.array(diffuse, np.float32), 0, 1)
    index = np.full(len(triangles), 0 if textured else -1, np.int32)
    return TexturedMesh(vertices, triangles, uv, colours, index, [references.pixels(image)] if textured else [])


def _coloured(vertices: NDArray[np.float32], triangles: NDArray[np.int32], visual: Any) -> TexturedMesh:
    """Vertex colours; a mesh with face colours gets three vertices of its own for every face."""
    stored = visual.vertex_colors if visual.kind == "vertex" else None
    if visual.kind == "face":
        stored = np.repeat(np.asarray(visual.face_colors), 3, axis=0)
        vertices = vertices[triangles].reshape(-1, 3)
        triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    uv = np.zeros((len(vertices), 2), np.float32)
    untextured = np.full(len(triangles), -1, np.int32)
    return TexturedMesh(vertices, triangles, uv, _fractions(stored, len(vertices)), untextured)


def _fractions(stored: Any, count: int) -> NDArray[np.float32]:
    """`(count, 3)` colours in [0, 1] of bytes or floats with or without alpha; white where there are none."""
    if stored is None or len(stored) != count:
        return np.ones((count, 3), np.float32)
    colours = np.asarray(stored)[:, :3]
    return colours.astype(np.float32) / np.float32(255 if colours.dtype.kind in "iu" else 1)
