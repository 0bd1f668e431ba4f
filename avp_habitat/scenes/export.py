"""`python -m avp_habitat.scenes.export`: write a scene as one self-contained `.glb` file."""

import io
import json
import struct
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.files import atomic_file
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP, UP_HELP
from avp_habitat.scenes.mesh import TexturedMesh

_UNLIT = "KHR_materials_unlit"
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _MIPMAPS = 9729, 9987


def export_glb(mesh: TexturedMesh, path: Path) -> None:
    """Write a mesh as binary glTF 2.0 with unlit materials, embedded PNG textures, `COLOR_0`, and masks as alpha.

    Raises:
        UsageError: the name does not end in `.glb`, or the file exists.
        SceneError: the file cannot be written.
    """
    if path.suffix.lower() != ".glb":
        raise UsageError(f"{path}: expected a name that ends in .glb")
    if not path.parent.is_dir():
        raise SceneError(f"{path}: cannot be written: there is no folder {path.parent}")
    with atomic_file(path, replace=False, failure=SceneError) as made:
        made.write_bytes(_Glb(mesh).encoded())


class _Glb:
    """A glTF document and its binary chunk."""

    def __init__(self, mesh: TexturedMesh) -> None:
        self._content = bytearray()
        self._document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "avp_habitat"},
            "extensionsUsed": [_UNLIT],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
        }
        masks = np.full_like(mesh.texture_index, -1) if mesh.mask_index is None else mesh.mask_index
        kinds = sorted(set(zip(mesh.texture_index.tolist(), masks.tolist(), strict=True)))
        self._add("meshes", primitives=[
            self._primitive(mesh, (mesh.texture_index == texture) & (masks == mask), texture, mask)
            for texture, mask in kinds
        ])  # fmt: skip
        self._document["buffers"] = [{"byteLength": len(self._content)}]

    def encoded(self) -> bytes:
        """The file: a header, then the chunks of JSON and of data, each with its length and padded to four bytes."""
        text = json.dumps(self._document).encode()
        chunks = ((text + b" " * (-len(text) % 4), b"JSON"), (bytes(self._content), b"BIN\0"))
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for chunk, kind in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def _primitive(self, mesh: TexturedMesh, own: NDArray[np.bool_], texture: int, mask: int) -> dict[str, Any]:
        """The triangles that share a texture and a mask (-1 for none), with a material of their own."""
        used, corners = np.unique(mesh.triangles[own], return_inverse=True)
        positions = mesh.vertices[used]
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        attributes = {"POSITION": self._array(positions, **bounds), "COLOR_0": self._array(mesh.colours[used])}
        shading: dict[str, Any] = {"metallicFactor": 0.0}
        if texture >= 0:
            attributes["TEXCOORD_0"] = self._array(mesh.uv[used])
            pixels = mesh.textures[texture]
            if mask >= 0:
                pixels = np.dstack([pixels, np.where(mesh.masks[mask], np.uint8(255), np.uint8(0))])
            shading["baseColorTexture"] = {"index": self._texture(pixels)}
        material = {"pbrMetallicRoughness": shading, "doubleSided": True, "extensions": {_UNLIT: {}}}
        masked = {"alphaMode": "MASK", "alphaCutoff": 0.5} if mask >= 0 else {}
        indices = self._array(corners.reshape(-1).astype(np.uint32))
        return {"attributes": attributes, "indices": indices, "material": self._add("materials", **material, **masked)}

    def _array(self, values: NDArray, **bounds: list[float]) -> int:
        """Accessor of `(n, 2)` or `(n, 3)` floats, or of `(n,)` vertex indices."""
        if values.ndim == 1:
            target, component, stored, kind = _ELEMENT_BUFFER, _UINT32, "<u4", "SCALAR"
        else:
            target, component, stored, kind = _ARRAY_BUFFER, _FLOAT, "<f4", f"VEC{values.shape[1]}"
        view = self._view(np.ascontiguousarray(values, stored).tobytes(), target=target)
        return self._add("accessors", bufferView=view, componentType=component, count=len(values), type=kind, **bounds)

    def _texture(self, pixels: NDArray[np.uint8]) -> int:
        """Of `(height, width, 3 or 4)` pixels, repeating, stored as PNG."""
        from PIL import Image

        encoded = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(encoded, format="PNG")
        image = self._add("images", bufferView=self._view(encoded.getvalue()), mimeType="image/png")
        self._document["samplers"] = [{"magFilter": _LINEAR, "minFilter": _MIPMAPS}]
        return self._add("textures", source=image, sampler=0)

    def _view(self, content: bytes, **target: int) -> int:
        start = len(self._content)
        self._content += content + b"\0" * (-len(content) % 4)
        return self._add("bufferViews", buffer=0, byteOffset=start, byteLength=len(content), **target)

    def _add(self, kind: str, **entry: Any) -> int:
        """Append to one of the document's lists; the index there."""
        entries = self._document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1


@dataclass(frozen=True)
class Export:
    """Export a scene, most usefully a generated room, for other programs."""

    scene: Positional[Annotated[str, arg(help=HELP, metavar="SCENE")]]
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """The .glb file to write; must not exist."""
    up: Annotated[Literal["y", "z"] | None, arg(help=UP_HELP)] = None


def main(options: Export) -> None:
    """Write the file."""
    export_glb(load_scene(options.scene, up=options.up).mesh, options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    sys.exit(command.run(main))
