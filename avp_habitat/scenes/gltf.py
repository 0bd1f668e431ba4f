"""Reads glTF 2.0 (`.glb`, `.gltf`) into one TexturedMesh."""

import struct
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, check_memory, decode_picture
from avp_habitat.scenes.gltf_data import SUPPORTED, Buffers, Surface, fractions, ignored, surface_of
from avp_habitat.scenes.masks import only, with_mask
from avp_habitat.scenes.mesh import TexturedMesh, merge, say_once

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_REPEAT = 10497
_EDGE = 0.01
"""Texture coordinates so little beyond a picture's edge show hardly anything else."""
_VERTEX_BYTES, _CORNER_BYTES = 160, 30
"""What reading takes at most for each vertex and each triangle's corner, copies included."""
# What walking through a document raises where a field is missing, of another type or out of range.
_MALFORMED = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)


def read_gltf(files: SceneFiles) -> TexturedMesh:
    """The triangles of a document's default scene in the world frame; points and lines have no surface.

    Args:
        files: the `.glb` or `.gltf` file and its folder.

    Raises:
        SceneError: the file is damaged, holds no triangle, or requires an extension that is not supported.
    """
    try:
        return _Reader(files).mesh()
    except _MALFORMED as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{files.path}: expected a valid glTF 2.0 file, but it is damaged: {reason}") from error


def shown_as_it_is(files: SceneFiles) -> bool:
    """Whether Habitat-Sim 0.3.4 shows a document's materials, and walks on its floors, as the suite does.

    It draws what is masked, under flat shading leaves out what materials emit, and takes the floors below a mirroring
    node, which it draws rightly, for ceilings (the NavMesh's mesh is joined without turning the winding over). What the
    suite cannot read, as textures of HM3D, is left to it.

    Raises:
        SceneError: the file is damaged.
    """
    try:
        document = _parse(files.main)
        surfaces = [surface_of(material) for material in document.materials or []]
        mirrored = any(np.linalg.det(_local_transform(node)[:3, :3]) < 0 for node in document.nodes)
    except _MALFORMED as error:
        raise SceneError(f"{files.path}: expected a valid glTF 2.0 file, but it is damaged: {error}") from error
    foreign = set(document.extensionsRequired or []) - SUPPORTED
    return bool(foreign) or (not mirrored and all(surface.cutoff is None and surface.tinted for surface in surfaces))


class _Reader:
    """One document on its way to a mesh."""

    def __init__(self, files: SceneFiles) -> None:
        self._path = files.path
        self._document = _parse(files.main)
        self._buffers = Buffers(self._document, files)
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._masks: dict[tuple[int, float], NDArray[np.bool_]] = {}
        version = str(self._document.asset.version)
        if not version.startswith("2."):
            raise SceneError(f"{files.path}: expected glTF 2.0, got version {version}")
        unsupported = sorted(set(self._document.extensionsRequired or []) - SUPPORTED)
        if unsupported:
            raise SceneError(
                f"{files.path}: requires the glTF extension {', '.join(unsupported)}, which is not supported; "
                "export the scene without it (uncompressed geometry, PNG or JPEG textures)"
            )

    def mesh(self) -> TexturedMesh:
        """All triangles of the default scene, placed in the world."""
        if phrases := ignored(self._document):
            say_once(str(self._path), "; ".join(phrases))
        placed = [
            (primitive, to_world)
            for mesh, to_world in self._placed_meshes()
            for primitive in self._document.meshes[mesh].primitives
        ]
        # A small file can name the same vertices again and again.
        check_memory(f"{self._path}: its mesh", sum(self._bytes_of(primitive) for primitive, _ in placed))
        parts = [part for each in placed if (part := self._primitive(*each)) is not None]
        if not parts:
            raise SceneError(f"{self._path}: expected a mesh with triangles, found none in the default scene")
        return merge(parts)

    def _roots(self) -> list[int]:
        document = self._document
        if document.scenes:
            return document.scenes[document.scene or 0].nodes or []
        children = {child for node in document.nodes for child in node.children or []}
        return [index for index in range(len(document.nodes)) if index not in children]

    def _placed_meshes(self) -> Iterator[tuple[int, NDArray]]:
        """Mesh indices with their `(4, 4)` transforms to the world, in document order."""
        waiting = [(root, np.eye(4)) for root in reversed(self._roots())]
        seen: set[int] = set()
        while waiting:
            index, parent = waiting.pop()
            if index in seen:
                raise SceneError(f"{self._path}: node {index} has two parents; expected a tree of nodes")
            seen.add(index)
            node = self._document.nodes[index]
            to_world = parent @ _local_transform(node)
            if node.mesh is not None:
                yield node.mesh, to_world
            waiting += [(child, to_world) for child in reversed(node.children or [])]

    def _bytes_of(self, primitive: pygltflib.Primitive) -> int:
        position = primitive.attributes.POSITION
        vertices = 0 if position is None else self._document.accessors[position].count
        corners = vertices if primitive.indices is None else self._document.accessors[primitive.indices].count
        return _VERTEX_BYTES * vertices + _CORNER_BYTES * corners

    def _primitive(self, primitive: pygltflib.Primitive, to_world: NDArray) -> TexturedMesh | None:
        mode = _TRIANGLES if primitive.mode is None else primitive.mode
        attributes = primitive.attributes
        if mode not in (_TRIANGLES, _STRIP, _FAN) or attributes.POSITION is None:
            return None
        if "KHR_draco_mesh_compression" in (primitive.extensions or {}) and not self._has_data(attributes.POSITION):
            raise SceneError(f"{self._path}: uses KHR_draco_mesh_compression, which is not supported")
        local = self._buffers.array(attributes.POSITION).astype(np.float64)
        vertices = local @ to_world[:3, :3].T + to_world[:3, 3]
        triangles = self._triangles(primitive.indices, mode, len(vertices))
        if np.linalg.det(to_world[:3, :3]) < 0:
            # A mirroring node turns the winding over (glTF 2.0, section 3.7.4).
            triangles = triangles[:, ::-1]
        surface = surface_of(None if primitive.material is None else self._document.materials[primitive.material])
        uv = self._coordinates(attributes, surface, len(vertices))
        textures = [] if uv is None or surface.texture is None else [self._picture(surface.texture)]
        colours = self._colours(attributes, surface, len(vertices))
        mesh = TexturedMesh(
            vertices,
            triangles,
            np.zeros((len(vertices), 2), np.float32) if uv is None else uv,
            np.ascontiguousarray(colours[:, :3]),
            np.full(len(triangles), len(textures) - 1, np.int32),
            textures,
        )
        return mesh if surface.cutoff is None else self._masked(mesh, colours[:, 3], surface)

    def _masked(self, mesh: TexturedMesh, alpha: NDArray[np.float32], surface: Surface) -> TexturedMesh:
        """What alphaMode MASK leaves: factor and vertex alpha decide for triangles, the picture within them."""
        assert surface.cutoff is not None
        share = alpha[mesh.triangles].mean(axis=1)
        kept = share >= surface.cutoff
        mesh = only(mesh, kept)
        if surface.texture is None or not mesh.textures or not kept.any():
            return mesh
        return with_mask(mesh, self._mask(surface.texture, surface.cutoff / float(share[kept].mean())))

    def _has_data(self, accessor: int) -> bool:
        return self._document.accessors[accessor].bufferView is not None

    def _triangles(self, accessor: int | None, mode: int, vertices: int) -> NDArray[np.int32]:
        if accessor is None:
            corners = np.arange(vertices, dtype=np.int64)
        else:
            corners = self._buffers.array(accessor).reshape(-1).astype(np.int64)
        if len(corners) and corners.max() >= vertices:
            raise SceneError(f"{self._path}: a triangle names vertex {corners.max()} of {vertices}")
        return _corners_to_triangles(corners, mode).astype(np.int32)

    def _coordinates(self, attributes: Any, surface: Surface, vertices: int) -> NDArray[np.float32] | None:
        accessor = None if surface.texture is None else getattr(attributes, surface.coordinates, None)
        if accessor is None or surface.texture is None:
            return None
        uv = self._matching(accessor, surface.coordinates, vertices)[:, :2].astype(np.float32)
        if surface.transform is not None:
            uv = uv @ surface.transform[:, :2].T + surface.transform[:, 2]
        if self._is_wrapped_otherwise(surface.texture, uv):
            say_once(str(self._path), "textures that are clamped or mirrored beyond their edges are repeated there")
        return uv

    def _is_wrapped_otherwise(self, texture: int, uv: NDArray[np.float32]) -> bool:
        """Whether coordinates leave a picture that its sampler does not repeat there."""
        sampler = self._document.textures[texture].sampler
        if sampler is None:
            return False
        found: Any = self._document.samplers[sampler]
        repeated = np.isin([found.wrapS or _REPEAT, found.wrapT or _REPEAT], _REPEAT)
        return bool((((uv < -_EDGE) | (uv > 1 + _EDGE)) & ~repeated).any())

    def _colours(self, attributes: Any, surface: Surface, vertices: int) -> NDArray[np.float32]:
        """`(v, 4)` colours and alpha; integers count as fractions even where a file forgets to say so."""
        colours = np.broadcast_to(surface.factor, (vertices, 4)).copy()
        if attributes.COLOR_0 is not None:
            stored = fractions(self._matching(attributes.COLOR_0, "COLOR_0", vertices))
            first, last = (0 if surface.tinted else 3), stored.shape[1]
            colours[:, first:last] *= stored[:, first:]
        return np.clip(colours, 0, 1).astype(np.float32)

    def _matching(self, accessor: int, name: str, vertices: int) -> NDArray:
        values = self._buffers.array(accessor)
        if len(values) != vertices:
            raise SceneError(
                f"{self._path}: expected {vertices} values of {name}, one for each vertex; got {len(values)}"
            )
        return values

    def _picture(self, texture: int) -> NDArray[np.uint8]:
        """`(height, width, 3)`; the same object for the same image."""
        index = self._image(texture)
        if index not in self._pictures:
            self._pictures[index] = decode_picture(*self._encoded(index))
        return self._pictures[index]

    def _mask(self, texture: int, least: float) -> NDArray[np.bool_]:
        """`(height, width)` where a picture's alpha is at least so much; the same object for the same question."""
        key = (self._image(texture), least)
        if key not in self._masks:
            alpha = decode_picture(*self._encoded(key[0]), "RGBA")[..., 3:]
            self._masks[key] = (alpha >= 255 * least)[..., 0] if alpha.size else np.ones(alpha.shape[:2], bool)
        return self._masks[key]

    def _image(self, texture: int) -> int:
        entry = self._document.textures[texture]
        index = (entry.extensions or {}).get("EXT_texture_webp", {}).get("source", entry.source)
        if index is None:
            names = ", ".join(entry.extensions or {}) or "no picture"
            raise SceneError(f"{self._path}: texture {texture} has {names}; expected a PNG, JPEG or WebP picture")
        return index

    def _encoded(self, index: int) -> tuple[bytes, str]:
        """An image's bytes, and its name for errors."""
        image = self._document.images[index]
        content = self._buffers.resolve(image.uri) if image.uri else bytes(self._buffers.view(image.bufferView))
        return content, f"{self._path}: image {index}"


def _parse(content: bytes) -> pygltflib.GLTF2:
    """The document, without its binary chunk being copied into objects."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if content[:4] == b"glTF":
            declared = struct.unpack_from("<I", content, 8)[0]
            if declared > len(content):
                raise ValueError(f"truncated: the header announces {declared} bytes, found {len(content)}")
            document = pygltflib.GLTF2.load_from_bytes(content)
        else:
            document = pygltflib.GLTF2.gltf_from_json(content.decode("utf-8-sig"))
    if document is None:
        raise ValueError("no JSON chunk")
    return document


def _local_transform(node: pygltflib.Node) -> NDArray:
    """`(4, 4)` node to parent: the node's matrix (stored by columns), or translation x rotation x scale."""
    if node.matrix:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    transform = np.eye(4)
    if node.rotation:
        transform[:3, :3] = _rotation(np.array(node.rotation, np.float64))
    if node.scale:
        transform[:3, :3] *= np.array(node.scale, np.float64)
    if node.translation:
        transform[:3, 3] = node.translation
    return transform


def _rotation(quaternion: NDArray) -> NDArray:
    """`(3, 3)` rotation of a quaternion (x, y, z, w), which need not have unit length."""
    length = np.linalg.norm(quaternion)
    if not length > 0:
        raise ValueError("a node's rotation is the zero quaternion")
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _corners_to_triangles(corners: NDArray, mode: int) -> NDArray:
    """`(t, 3)` of `(n,)` vertex indices in a list, strip or fan."""
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    first = corners[:-2] if mode == _STRIP else np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
    triangles = np.stack([first, corners[1:-1], corners[2:]], axis=1)
    if mode == _STRIP:
        triangles[1::2] = triangles[1::2][:, [1, 0, 2]]
    return triangles
