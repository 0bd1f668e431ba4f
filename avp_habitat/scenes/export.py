"""`python -m avp_habitat.scenes.export`: write a scene as one self-contained `.glb` file."""

import io
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP, UP_HELP
from avp_habitat.scenes.mesh import TexturedMesh

_UNLIT = "KHR_materials_unlit"
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _MIPMAPS = 9729, 9987


def export_glb(mesh: TexturedMesh, path: Path) -> None:
    """Write a mesh as binary glTF 2.0 with unlit materials, embedded PNG textures, `COLOR_0`, and masks as alpha.

    Args:
        mesh: world frame, metres, Y up (glTF's own axes).
        path: where to; the file appears there only when it is complete.

    Raises:
        UsageError: the name does not end in `.glb`, or the file exists.
        SceneError: the file cannot be written.
    """
    if path.suffix.lower() != ".glb":
        raise UsageError(f"{path}: expected a name that ends in .glb")
    if path.exists() or path.is_symlink():
        raise UsageError(f"{path}: exists already; remove it or choose another name")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            made = Path(folder) / path.name
            made.write_bytes(_Document().encoded(mesh))
            os.replace(made, path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error


class _Document:
    """A glTF document and its binary chunk."""

    def __init__(self) -> None:
        import pygltflib

        self._gltf = pygltflib
        self._content = bytearray()
        self._document = pygltflib.GLTF2(
            scene=0,
            scenes=[pygltflib.Scene(nodes=[0])],
            nodes=[pygltflib.Node(mesh=0)],
            meshes=[pygltflib.Mesh(primitives=[])],
            extensionsUsed=[_UNLIT],
            asset=pygltflib.Asset(version="2.0", generator="avp_habitat"),
        )

    def encoded(self, mesh: TexturedMesh) -> bytes:
        """The file of a mesh."""
        masks = np.full_like(mesh.texture_index, -1) if mesh.mask_index is None else mesh.mask_index
        for texture, mask in sorted(set(zip(mesh.texture_index.tolist(), masks.tolist(), strict=True))):
            self._add_primitive(mesh, (mesh.texture_index == texture) & (masks == mask), texture, mask)
        self._document.buffers = [self._gltf.Buffer(byteLength=len(self._content))]
        self._document.set_binary_blob(bytes(self._content))
        return b"".join(self._document.save_to_bytes())

    def _add_primitive(self, mesh: TexturedMesh, own: NDArray[np.bool_], texture: int, mask: int) -> None:
        """Append the triangles that share a texture and a mask (-1 for none), with a material of their own."""
        gltf, document = self._gltf, self._document
        used, corners = np.unique(mesh.triangles[own], return_inverse=True)
        position, colour = self._add_array(mesh.vertices[used]), self._add_array(mesh.colours[used])
        bounds = document.accessors[position]
        bounds.min, bounds.max = (getattr(mesh.vertices[used], name)(axis=0).tolist() for name in ("min", "max"))
        attributes = gltf.Attributes(POSITION=position, COLOR_0=colour)
        shading = gltf.PbrMetallicRoughness(metallicFactor=0.0)
        if texture >= 0:
            attributes.TEXCOORD_0 = self._add_array(mesh.uv[used])
            pixels = mesh.textures[texture]
            if mask >= 0:
                pixels = np.dstack([pixels, np.where(mesh.masks[mask], np.uint8(255), np.uint8(0))])
            shading.baseColorTexture = gltf.TextureInfo(index=self._add_picture(pixels))
        mode, cutoff = ("MASK", 0.5) if mask >= 0 else ("OPAQUE", None)
        document.materials.append(
            gltf.Material(
                pbrMetallicRoughness=shading,
                doubleSided=True,
                alphaMode=mode,
                alphaCutoff=cutoff,
                extensions={_UNLIT: {}},
            )
        )
        indices = self._add_array(corners.reshape(-1).astype(np.uint32))
        material = len(document.materials) - 1
        document.meshes[0].primitives.append(gltf.Primitive(attributes=attributes, indices=indices, material=material))

    def _add_array(self, values: NDArray) -> int:
        """Accessor of `(n, 2)` or `(n, 3)` floats, or of `(n,)` vertex indices."""
        scalar = values.ndim == 1
        target, component, stored = (_ELEMENT_BUFFER, _UINT32, "<u4") if scalar else (_ARRAY_BUFFER, _FLOAT, "<f4")
        view = self._add_view(np.ascontiguousarray(values, stored).tobytes(), target)
        kind = "SCALAR" if scalar else f"VEC{values.shape[1]}"
        self._document.accessors.append(
            self._gltf.Accessor(bufferView=view, componentType=component, count=len(values), type=kind)
        )
        return len(self._document.accessors) - 1

    def _add_picture(self, pixels: NDArray[np.uint8]) -> int:
        """Texture of `(height, width, 3 or 4)` pixels, repeating, stored as PNG."""
        from PIL import Image

        encoded = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(encoded, format="PNG")
        gltf, document = self._gltf, self._document
        document.images.append(gltf.Image(bufferView=self._add_view(encoded.getvalue()), mimeType="image/png"))
        document.samplers = [gltf.Sampler(magFilter=_LINEAR, minFilter=_MIPMAPS)]
        document.textures.append(gltf.Texture(source=len(document.images) - 1, sampler=0))
        return len(document.textures) - 1

    def _add_view(self, content: bytes, target: int | None = None) -> int:
        start = len(self._content)
        self._document.bufferViews.append(
            self._gltf.BufferView(buffer=0, byteOffset=start, byteLength=len(content), target=target)
        )
        self._content += content + b"\0" * (-len(content) % 4)
        return len(self._document.bufferViews) - 1


@dataclass(frozen=True)
class Export:
    """Export a scene, most usefully a generated room, for other programs."""

    scene: Positional[Annotated[str, arg(help=HELP)]]
    out: Positional[Path]
    """The .glb file to write; must not exist."""
    up: Annotated[Literal["y", "z"] | None, arg(help=UP_HELP)] = None


def main(options: Export) -> None:
    """Write the file."""
    export_glb(load_scene(options.scene, up=options.up).mesh, options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    sys.exit(command.run(main))
