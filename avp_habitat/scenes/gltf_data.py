"""What the materials of a glTF document say about colour and about where there is a surface at all.

Surfaces are shown unlit, as Habitat-Sim shows a stage under flat shading: base colour times vertex colour. Its version
0.3.4 knows neither kind of transparency there (GenericDrawable and buildCustomAttributeFlatMaterial in its sources).
What has alphaMode BLEND it draws opaque, and so does the suite; what MASK cuts out is not there, though it draws that.
"""

import base64
import binascii
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SceneFiles

_COMPONENT = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Buffers:
    """Reads accessors and buffer views of one document, each buffer once."""

    def __init__(self, document: pygltflib.GLTF2, files: SceneFiles) -> None:
        """Take the document, and the files that its buffers may refer to."""
        self._document = document
        self._files = files
        self._content: dict[int, bytes] = {}

    def resolve(self, uri: str) -> bytes:
        """Bytes of a data URI or of a file in the scene's folder.

        Raises:
            SceneError: the data URI is damaged, or the file is missing or outside the folder.
        """
        if not uri.startswith("data:"):
            return self._files.read(uri)
        header, _, payload = uri.partition(",")
        if not header.endswith(";base64"):
            raise SceneError(f"{self._files.path}: expected a base64 data URI, got {header[:40]!r}")
        try:
            return base64.b64decode(payload, validate=True)
        except binascii.Error as error:
            raise SceneError(f"{self._files.path}: a data URI is damaged: {error}") from error

    def view(self, index: int) -> memoryview:
        """Bytes of buffer view `index`.

        Raises:
            SceneError: the view reaches past the end of its buffer, as in a truncated file.
        """
        view = self._document.bufferViews[index]
        content = self._buffer(view.buffer)
        start = view.byteOffset or 0
        if start < 0 or view.byteLength < 0 or start + view.byteLength > len(content):
            raise SceneError(
                f"{self._files.path}: truncated: buffer view {index} ends at byte {start + view.byteLength} "
                f"of a buffer with {len(content)} bytes"
            )
        return memoryview(content)[start : start + view.byteLength]

    def array(self, index: int) -> NDArray:
        """Accessor `index` as `(count, width)`; normalised integers become float32 in [0, 1] or [-1, 1].

        Raises:
            SceneError: the accessor's type is not one that meshes use, or its data are incomplete.
        """
        accessor = self._document.accessors[index]
        if accessor.componentType not in _COMPONENT or accessor.type not in _WIDTH:
            raise SceneError(
                f"{self._files.path}: accessor {index} has component type {accessor.componentType} and type "
                f"{accessor.type}; expected one of {sorted(_COMPONENT)} and one of {', '.join(_WIDTH)}"
            )
        dtype = np.dtype(_COMPONENT[accessor.componentType])
        shape = (accessor.count, _WIDTH[accessor.type])
        values = self._dense(index, dtype, shape)
        if accessor.sparse is not None:
            values = self._with_sparse(accessor.sparse, values, dtype)
        return fractions(values) if accessor.normalized else values

    def _buffer(self, index: int) -> bytes:
        if index not in self._content:
            uri = self._document.buffers[index].uri
            content = self.resolve(uri) if uri else self._document.binary_blob()
            if content is None:
                raise SceneError(f"{self._files.path}: truncated: buffer {index} has neither a uri nor a binary chunk")
            self._content[index] = content
        return self._content[index]

    def _dense(self, index: int, dtype: np.dtype, shape: tuple[int, int]) -> NDArray:
        accessor = self._document.accessors[index]
        if accessor.bufferView is None:
            return self._zeros(index, dtype, shape)
        stride = self._document.bufferViews[accessor.bufferView].byteStride or dtype.itemsize * shape[1]
        data, offset = self.view(accessor.bufferView), accessor.byteOffset or 0
        end = offset + (shape[0] - 1) * stride + dtype.itemsize * shape[1]
        if shape[0] < 1 or offset < 0 or end > len(data):
            raise SceneError(
                f"{self._files.path}: truncated: accessor {index} needs {shape[0]} elements up to byte {end} "
                f"of a buffer view with {len(data)} bytes"
            )
        return np.ndarray(shape, dtype, data, offset, (stride, dtype.itemsize))

    def _zeros(self, index: int, dtype: np.dtype, shape: tuple[int, int]) -> NDArray:
        """What an accessor without data holds; it costs no byte of the file, so that its count may be anything."""
        most = sum(len(self._buffer(buffer)) for buffer in range(len(self._document.buffers)))
        if shape[0] > most:
            raise SceneError(
                f"{self._files.path}: accessor {index} claims {shape[0]} elements without any data for them, in a file "
                f"whose buffers hold {most} bytes"
            )
        return np.zeros(shape, dtype)

    def _with_sparse(self, sparse: pygltflib.Sparse, values: NDArray, dtype: np.dtype) -> NDArray:
        where = np.dtype(_COMPONENT[sparse.indices.componentType])
        rows = np.frombuffer(self.view(sparse.indices.bufferView), where, sparse.count, sparse.indices.byteOffset or 0)
        count = sparse.count * values.shape[1]
        new = np.frombuffer(self.view(sparse.values.bufferView), dtype, count, sparse.values.byteOffset or 0)
        values = values.copy()
        values[rows] = new.reshape(sparse.count, -1)
        return values


def fractions(values: NDArray) -> NDArray:
    """Integers as fractions of their type's greatest value (glTF 2.0, section 3.11: -128 and -127 are both -1)."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max), np.float32(-1.0))


SUPPORTED = {
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    # These change nothing where no light falls.
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_volume",
}
"""Extensions that a document may require."""
# Without these, a document that does not require them is shown by what it holds for the purpose; else it is refused.
_REPLACED = {"EXT_meshopt_compression", "KHR_draco_mesh_compression", "KHR_texture_basisu", "MSFT_texture_dds"}
_TRANSMISSION = ("KHR_materials_transmission", "KHR_materials_diffuse_transmission")
_NAMED = 4


@dataclass(frozen=True)
class Surface:
    """What a material says."""

    factor: NDArray[np.float32]
    """`(4,)` colour and alpha that multiply the picture."""
    texture: int | None = None
    """Index of the texture."""
    coordinates: str = "TEXCOORD_0"
    """Name of the attribute that holds the texture coordinates."""
    transform: NDArray[np.float32] | None = None
    """`(2, 3)` affine map of the texture coordinates, None to leave them."""
    cutoff: float | None = None
    """Least alpha at which there is a surface (alphaMode MASK); None where alpha does not count."""
    tinted: bool = True
    """Whether vertex colours multiply it; they do not where it is light that shows."""


def surface_of(material: pygltflib.Material | None) -> Surface:
    """The colour that a material shows without any light, and its mask.

    That is the base colour, or the diffuse colour of KHR_materials_pbrSpecularGlossiness. Of a material whose colour is
    all in its light, as in baked rooms, it is the emitted one: of one with a black base colour, or with an emissive
    picture and no other, or with an emissive colour and a white base.
    """
    if material is None:
        return Surface(np.ones(4, np.float32))
    extensions = material.extensions or {}
    base = material.pbrMetallicRoughness
    factor, info = (base.baseColorFactor, base.baseColorTexture) if base else (None, None)
    gloss = extensions.get("KHR_materials_pbrSpecularGlossiness")
    if gloss is not None:
        factor, info = gloss.get("diffuseFactor"), gloss.get("diffuseTexture")
    colour = np.array(factor or [1.0] * 4, np.float32)
    cutoff = None
    if material.alphaMode == "MASK":
        cutoff = 0.5 if material.alphaCutoff is None else float(material.alphaCutoff)
    light = _light(material)
    if "KHR_materials_unlit" in extensions or not _is_light(colour, info, light, material.emissiveTexture):
        return _textured(colour, info, cutoff)
    return _textured(np.append(light, colour[3]), material.emissiveTexture, cutoff, tinted=False)


def ignored(document: pygltflib.GLTF2) -> list[str]:
    """What of a document is not shown as it is meant, a phrase each."""
    materials = document.materials or []
    clear = _names(materials, _is_clear)
    glowing = _names(materials, _adds_light)
    unknown = sorted(set(document.extensionsUsed or []) - SUPPORTED - _REPLACED - set(_TRANSMISSION))
    phrases = []
    if clear:
        phrases.append(f"transparent materials are shown opaque: {clear}")
    if glowing:
        phrases.append(f"the light that materials emit is not added to their colours: {glowing}")
    if unknown:
        phrases.append(f"extensions that are not supported are ignored: {', '.join(unknown)}")
    return phrases


def _is_clear(material: pygltflib.Material) -> bool:
    return material.alphaMode == "BLEND" or any(name in (material.extensions or {}) for name in _TRANSMISSION)


def _adds_light(material: pygltflib.Material) -> bool:
    """Whether a material has an emissive picture besides the one that is shown."""
    unlit = "KHR_materials_unlit" in (material.extensions or {})
    lit = material.emissiveTexture is not None and bool(_light(material).any())
    return lit and not unlit and surface_of(material).tinted


def _names(materials: list[pygltflib.Material], test: Callable[[pygltflib.Material], bool]) -> str:
    """The first of the materials that pass, by name or number; empty where none does."""
    names = [each.name or f"material {number}" for number, each in enumerate(materials) if test(each)]
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _light(material: pygltflib.Material) -> NDArray[np.float32]:
    """`(3,)` factor of the emitted colour, at most 1."""
    strength = (material.extensions or {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    return np.minimum(np.array(material.emissiveFactor or [0.0] * 3, np.float32) * np.float32(strength), 1)


def _is_light(colour: NDArray, info: Any, light: NDArray, picture: Any) -> bool:
    dark, white = not colour[:3].any(), (colour[:3] == 1).all()
    return bool(light.any()) and bool(dark or (info is None and (picture is not None or white)))


def _textured(factor: NDArray, info: Any, cutoff: float | None, *, tinted: bool = True) -> Surface:
    """A surface with a texture info, which extensions hold as a dictionary."""
    entry = info if isinstance(info, Mapping) else vars(info) if info is not None else {}
    if entry.get("index") is None:
        return Surface(factor, cutoff=cutoff, tinted=tinted)
    moved = (entry.get("extensions") or {}).get("KHR_texture_transform")
    channel = (moved or {}).get("texCoord", entry.get("texCoord") or 0)
    transform = None if moved is None else _uv_transform(moved)
    return Surface(factor, entry["index"], f"TEXCOORD_{channel}", transform, cutoff, tinted)


def _uv_transform(entry: dict[str, Any]) -> NDArray[np.float32]:
    """`(2, 3)` affine map of KHR_texture_transform: scale, then rotate (counter-clockwise as seen), then shift."""
    angle = float(entry.get("rotation", 0.0))
    scale, offset = entry.get("scale", [1.0, 1.0]), entry.get("offset", [0.0, 0.0])
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return np.column_stack([rotation * np.array(scale), offset]).astype(np.float32)
