"""What the materials of a glTF document say about colour and about where there is a surface at all.

Surfaces are shown unlit, as Habitat-Sim shows a stage under flat shading: base colour times vertex colour. Its version
0.3.4 knows neither kind of transparency there (GenericDrawable and buildCustomAttributeFlatMaterial in its sources).
What has alphaMode BLEND it draws opaque, and so does the suite; what MASK cuts out is not there, though it draws that.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

SUPPORTED = {
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    # These change nothing where no light falls.
    "KHR_lights_punctual",
    *(f"KHR_materials_{name}" for name in ("anisotropy", "clearcoat", "dispersion", "ior", "iridescence")),
    *(f"KHR_materials_{name}" for name in ("sheen", "specular", "volume")),
}
"""Extensions that a document may require."""
# A document that does not require these is shown by what it holds for the purpose; else it is refused.
_REPLACED = {"EXT_meshopt_compression", "KHR_draco_mesh_compression", "KHR_texture_basisu", "MSFT_texture_dds"}
_TRANSMISSION = {"KHR_materials_transmission", "KHR_materials_diffuse_transmission"}
_NAMED = 4


@dataclass(frozen=True)
class GltfSurface:
    """What a material says."""

    factor: NDArray[np.float32]
    """`(4,)` colour and alpha that multiply the picture."""
    texture: int | None = None
    coordinates: str = "TEXCOORD_0"
    """The attribute with the texture coordinates."""
    transform: NDArray[np.float32] | None = None
    """`(2, 3)` affine map of the texture coordinates, None to leave them."""
    cutoff: float | None = None
    """Least alpha at which there is a surface (alphaMode MASK); None where alpha does not count."""
    tinted: bool = True
    """Whether vertex colours multiply it; they do not where it is light that shows."""


def surface_of(material: pygltflib.Material | None) -> GltfSurface:
    """The colour that a material shows without any light, and its mask.

    That is the base colour, or the diffuse colour of KHR_materials_pbrSpecularGlossiness. Of a material whose colour is
    all in its light, as in baked rooms, it is the emitted one: of one with a black base colour, or with an emissive
    picture and no other, or with an emissive colour and a white base.
    """
    if material is None:
        return GltfSurface(np.ones(4, np.float32))
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
    clear = [
        material.name or f"material {number}"
        for number, material in enumerate(document.materials or [])
        if material.alphaMode == "BLEND" or not _TRANSMISSION.isdisjoint(material.extensions or {})
    ]
    unknown = sorted(set(document.extensionsUsed or []) - SUPPORTED - _REPLACED - _TRANSMISSION)
    found = {
        "transparent materials are shown opaque": clear[:_NAMED] + ["…"] * (len(clear) > _NAMED),
        "extensions that are not supported are ignored": unknown,
    }
    return [f"{what}: {', '.join(names)}" for what, names in found.items() if names]


def _light(material: pygltflib.Material) -> NDArray[np.float32]:
    """`(3,)` factor of the emitted colour, at most 1."""
    strength = (material.extensions or {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    return np.minimum(np.array(material.emissiveFactor or [0.0] * 3, np.float32) * np.float32(strength), 1)


def _is_light(colour: NDArray, info: Any, light: NDArray, picture: Any) -> bool:
    dark, white = not colour[:3].any(), (colour[:3] == 1).all()
    return bool(light.any()) and bool(dark or (info is None and (picture is not None or white)))


def _textured(factor: NDArray, info: Any, cutoff: float | None, *, tinted: bool = True) -> GltfSurface:
    """A surface with a texture info, which extensions hold as a dictionary."""
    entry = info if isinstance(info, Mapping) else vars(info) if info is not None else {}
    if entry.get("index") is None:
        return GltfSurface(factor, cutoff=cutoff, tinted=tinted)
    moved = (entry.get("extensions") or {}).get("KHR_texture_transform")
    channel = (moved or {}).get("texCoord", entry.get("texCoord") or 0)
    transform = None if moved is None else _uv_transform(moved)
    return GltfSurface(factor, entry["index"], f"TEXCOORD_{channel}", transform, cutoff, tinted)


def _uv_transform(entry: dict[str, Any]) -> NDArray[np.float32]:
    """`(2, 3)` affine map of KHR_texture_transform: scale, then rotate (counter-clockwise as seen), then shift."""
    angle = float(entry.get("rotation", 0.0))
    scale, offset = entry.get("scale", [1.0, 1.0]), entry.get("offset", [0.0, 0.0])
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return np.column_stack([rotation * np.array(scale), offset]).astype(np.float32)
