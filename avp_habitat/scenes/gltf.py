"""Reads glTF 2.0 (`.glb`, `.gltf`) into one TexturedMesh."""

import base64
import struct
import warnings
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles, decode_picture
from avp_habitat.scenes.gltf_materials import SUPPORTED, GltfSurface, ignored, surface_of
from avp_habitat.scenes.mesh import TexturedMesh, merge, only, warn_once, with_mask

_COMPONENT = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_REPEAT = 10497
_EDGE = 0.01
"""Texture coordinates so little beyond a picture's edge show hardly anything else."""
_EXPECTED = "a valid glTF 2.0 file"


def read_gltf(files: SceneFiles) -> TexturedMesh:
    """The triangles of a document's default scene in the world frame; points and lines have no surface.

    Raises:
        SceneError: the file is damaged, holds no triangle, or requires an extension that is not supported.
    """
    with files.expected(_EXPECTED):
        return _Reader(files).mesh()


def shown_as_it_is(files: SceneFiles) -> bool:
    """Whether Habitat-Sim 0.3.4 shows a document's materials, and walks on its floors, as the suite does.

    It draws what is masked, under flat shading leaves out what materials emit, and takes the floors below a mirroring
    node, which it draws rightly, for ceilings (the NavMesh's mesh is joined without turning the winding over). What the
    suite cannot read, as textures of HM3D, is left to it.

    Raises:
        SceneError: the file is damaged.
    """
    with files.expected(_EXPECTED):
        document = _parse(files.main)
        surfaces = [surface_of(material) for material in document.materials or []]
        mirrored = any(np.linalg.det(_local_transform(node)[:3, :3]) < 0 for node in document.nodes)
        foreign = set(document.extensionsRequired or []) - SUPPORTED
    return bool(foreign) or (not mirrored and all(surface.cutoff is None and surface.tinted for surface in surfaces))


class _Reader:
    """One document on its way to a mesh."""

    def __init__(self, files: SceneFiles) -> None:
        self._files, self._path = files, files.path
        self._document = _parse(files.main)
        self._buffer = cache(self._read_buffer)
        # The same object for the same picture, which is kept once then.
        self._picture, self._mask = cache(self._decode), cache(self._read_mask)
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
            warn_once(str(self._path), "; ".join(phrases))
        nodes, scenes = self._document.nodes, self._document.scenes
        if scenes:
            roots = scenes[self._document.scene or 0].nodes or []
        else:
            children = {child for node in nodes for child in node.children or []}
            roots = [index for index in range(len(nodes)) if index not in children]
        placed = [each for root in roots for each in self._placed(root, np.eye(4))]
        parts = [part for each in placed if (part := self._primitive(*each)) is not None]
        if parts:
            return merge(parts)
        raise SceneError(f"{self._path}: expected a mesh with triangles, found none in the default scene")

    def _placed(self, index: int, parent: NDArray) -> Iterator[tuple[pygltflib.Primitive, NDArray]]:
        """Primitives of a node and those below it with their `(4, 4)` transforms to the world, in document order."""
        node = self._document.nodes[index]
        to_world = parent @ _local_transform(node)
        if node.mesh is not None:
            yield from ((primitive, to_world) for primitive in self._document.meshes[node.mesh].primitives)
        for child in node.children or []:
            yield from self._placed(child, to_world)

    def _resolve(self, uri: str) -> bytes:
        """Bytes of a data URI or of a file in the scene's folder."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2], validate=True)
        return self._files.read(uri)

    def _read_buffer(self, index: int) -> bytes:
        uri = self._document.buffers[index].uri
        content = self._resolve(uri) if uri else self._document.binary_blob()
        if content is None:
            raise ValueError(f"truncated: buffer {index} has neither a uri nor a binary chunk")
        return content

    def _view(self, index: int) -> memoryview:
        """Bytes of a buffer view."""
        view = self._document.bufferViews[index]
        content, start = self._buffer(view.buffer), view.byteOffset or 0
        end = start + view.byteLength
        if end > len(content):
            raise ValueError(f"truncated: buffer view {index} ends at byte {end} of a buffer with {len(content)} bytes")
        return memoryview(content)[start:end]

    def _array(self, index: int) -> NDArray:
        """An accessor as `(count, width)`; normalised integers become float32 in [0, 1] or [-1, 1]."""
        accessor: Any = self._document.accessors[index]
        dtype, shape = np.dtype(_COMPONENT[accessor.componentType]), (accessor.count, _WIDTH[accessor.type])
        if accessor.bufferView is None:
            values = np.zeros(shape, dtype)
        else:
            stride = self._document.bufferViews[accessor.bufferView].byteStride or dtype.itemsize * shape[1]
            data, start = self._view(accessor.bufferView), accessor.byteOffset or 0
            values = np.ndarray(shape, dtype, data, start, (stride, dtype.itemsize))
        if accessor.sparse is not None:
            (where, what), count = (accessor.sparse.indices, accessor.sparse.values), accessor.sparse.count
            codes, places = _COMPONENT[where.componentType], self._view(where.bufferView)
            rows = np.frombuffer(places, codes, count, where.byteOffset or 0)
            new = np.frombuffer(self._view(what.bufferView), dtype, count * shape[1], what.byteOffset or 0)
            values = values.copy()
            values[rows] = new.reshape(count, -1)
        return _fractions(values) if accessor.normalized else values

    def _primitive(self, primitive: pygltflib.Primitive, to_world: NDArray) -> TexturedMesh | None:
        mode = _TRIANGLES if primitive.mode is None else primitive.mode
        attributes = primitive.attributes
        if mode not in (_TRIANGLES, _STRIP, _FAN) or attributes.POSITION is None:
            return None
        has_data = self._document.accessors[attributes.POSITION].bufferView is not None
        if "KHR_draco_mesh_compression" in (primitive.extensions or {}) and not has_data:
            raise SceneError(f"{self._path}: uses KHR_draco_mesh_compression, which is not supported")
        local = self._array(attributes.POSITION).astype(np.float64)
        vertices = local @ to_world[:3, :3].T + to_world[:3, 3]
        triangles = self._triangles(primitive.indices, mode, len(vertices))
        if np.linalg.det(to_world[:3, :3]) < 0:
            # A mirroring node turns the winding over (glTF 2.0, section 3.7.4).
            triangles = triangles[:, ::-1]
        surface = surface_of(None if primitive.material is None else self._document.materials[primitive.material])
        uv = self._coordinates(attributes, surface, len(vertices))
        textures = [] if uv is None or surface.texture is None else [self._picture(self._image(surface.texture))]
        colours = self._colours(attributes, surface, len(vertices))
        mesh = TexturedMesh(
            vertices,
            triangles,
            np.zeros((len(vertices), 2), np.float32) if uv is None else uv,
            np.ascontiguousarray(colours[:, :3]),
            np.full(len(triangles), len(textures) - 1, np.int32),
            textures,
        )
        return mesh if surface.cutoff is None else self._masked(mesh, colours[:, 3], surface.texture, surface.cutoff)

    def _masked(self, mesh: TexturedMesh, alpha: NDArray, texture: int | None, cutoff: float) -> TexturedMesh:
        """What alphaMode MASK leaves: factor and vertex alpha decide for triangles, the picture within them."""
        share = alpha[mesh.triangles].mean(axis=1)
        kept = share >= cutoff
        mesh = only(mesh, kept)
        if texture is None or not mesh.textures or not kept.any():
            return mesh
        return with_mask(mesh, self._mask(self._image(texture), cutoff / float(share[kept].mean())))

    def _triangles(self, accessor: int | None, mode: int, vertices: int) -> NDArray[np.int32]:
        """`(t, 3)` vertex indices of a list, strip or fan."""
        corners = np.arange(vertices) if accessor is None else self._array(accessor).reshape(-1)
        corners = corners.astype(np.int64)
        if len(corners) and corners.max() >= vertices:
            raise ValueError(f"a triangle names vertex {corners.max()} of {vertices}")
        if mode == _TRIANGLES:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3).astype(np.int32)
        first = corners[:-2] if mode == _STRIP else np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
        triangles = np.stack([first, corners[1:-1], corners[2:]], axis=1).astype(np.int32)
        if mode == _STRIP:
            triangles[1::2] = triangles[1::2][:, [1, 0, 2]]
        return triangles

    def _coordinates(self, attributes: Any, surface: GltfSurface, vertices: int) -> NDArray[np.float32] | None:
        accessor = None if surface.texture is None else getattr(attributes, surface.coordinates, None)
        if accessor is None or surface.texture is None:
            return None
        uv = self._matching(accessor, surface.coordinates, vertices)[:, :2].astype(np.float32)
        if surface.transform is not None:
            uv = uv @ surface.transform[:, :2].T + surface.transform[:, 2]
        sampler = self._document.textures[surface.texture].sampler
        found: Any = pygltflib.Sampler() if sampler is None else self._document.samplers[sampler]
        repeated = np.isin([found.wrapS or _REPEAT, found.wrapT or _REPEAT], _REPEAT)
        if (((uv < -_EDGE) | (uv > 1 + _EDGE)) & ~repeated).any():
            warn_once(str(self._path), "textures that are clamped or mirrored beyond their edges are repeated there")
        return uv

    def _colours(self, attributes: Any, surface: GltfSurface, vertices: int) -> NDArray[np.float32]:
        """`(v, 4)` colours and alpha; integers count as fractions even where a file forgets to say so."""
        colours = np.broadcast_to(surface.factor, (vertices, 4)).copy()
        if attributes.COLOR_0 is not None:
            stored = _fractions(self._matching(attributes.COLOR_0, "COLOR_0", vertices))
            first, last = (0 if surface.tinted else 3), stored.shape[1]
            colours[:, first:last] *= stored[:, first:]
        return np.clip(colours, 0, 1).astype(np.float32)

    def _matching(self, accessor: int, name: str, vertices: int) -> NDArray:
        values = self._array(accessor)
        if len(values) != vertices:
            raise ValueError(f"expected {vertices} values of {name}, one for each vertex; got {len(values)}")
        return values

    def _image(self, texture: int) -> int:
        entry = self._document.textures[texture]
        index = (entry.extensions or {}).get("EXT_texture_webp", {}).get("source", entry.source)
        if index is None:
            names = ", ".join(entry.extensions or {}) or "no picture"
            raise SceneError(f"{self._path}: texture {texture} has {names}; expected a PNG, JPEG or WebP picture")
        return index

    def _decode(self, index: int, mode: str = "RGB") -> NDArray[np.uint8]:
        image = self._document.images[index]
        content = self._resolve(image.uri) if image.uri else bytes(self._view(image.bufferView))
        return decode_picture(content, f"{self._path}: image {index}", mode)

    def _read_mask(self, index: int, least: float) -> NDArray[np.bool_]:
        """`(height, width)` where a picture's alpha is at least so much."""
        alpha = self._decode(index, "RGBA")[..., 3:]
        return (alpha >= 255 * least)[..., 0] if alpha.size else np.ones(alpha.shape[:2], bool)


def _fractions(values: NDArray) -> NDArray:
    """Integers as fractions of their type's greatest value (glTF 2.0, section 3.11: -128 and -127 are both -1)."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max), np.float32(-1.0))


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
        from scipy.spatial.transform import Rotation

        transform[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    if node.scale:
        transform[:3, :3] *= np.array(node.scale, np.float64)
    if node.translation:
        transform[:3, 3] = node.translation
    return transform
