"""Writes a scene as one self-contained `.glb` file."""

import argparse
import io
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.command import run
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.simulators.registry import add_up_option

_UNLIT = "KHR_materials_unlit"
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963


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
        _write_atomically(path, _encode(mesh))
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error


def _write_atomically(path: Path, content: bytes) -> None:
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def _encode(mesh: TexturedMesh) -> bytes:
    import pygltflib

    document = pygltflib.GLTF2(
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[pygltflib.Node(mesh=0)],
        meshes=[pygltflib.Mesh(primitives=[])],
        extensionsUsed=[_UNLIT],
        asset=pygltflib.Asset(version="2.0", generator="avp_habitat"),
    )
    blob = _Blob(document)
    mask_index = np.full_like(mesh.texture_index, -1) if mesh.mask_index is None else mesh.mask_index
    for texture, mask in sorted(set(zip(mesh.texture_index.tolist(), mask_index.tolist(), strict=True))):
        _add_primitive(document, blob, mesh, (mesh.texture_index == texture) & (mask_index == mask), texture, mask)
    content = blob.content()
    document.buffers = [pygltflib.Buffer(byteLength=len(content))]
    document.set_binary_blob(content)
    return b"".join(document.save_to_bytes())


def _add_primitive(
    document, blob: "_Blob", mesh: TexturedMesh, own: NDArray[np.bool_], texture: int, mask: int
) -> None:
    """Append the triangles that share a texture and a mask (-1 for none) as one primitive with its own material."""
    import pygltflib

    used, corners = np.unique(mesh.triangles[own], return_inverse=True)
    attributes = pygltflib.Attributes(
        POSITION=blob.add_vectors(mesh.vertices[used], bounds=True), COLOR_0=blob.add_vectors(mesh.colours[used])
    )
    shading = pygltflib.PbrMetallicRoughness(metallicFactor=0.0)
    if texture >= 0:
        attributes.TEXCOORD_0 = blob.add_vectors(mesh.uv[used])
        pixels = mesh.textures[texture]
        if mask >= 0:
            pixels = np.dstack([pixels, np.where(mesh.masks[mask], np.uint8(255), np.uint8(0))])
        shading.baseColorTexture = pygltflib.TextureInfo(index=blob.add_picture(pixels))
    mode, cutoff = ("MASK", 0.5) if mask >= 0 else ("OPAQUE", None)
    document.materials.append(
        pygltflib.Material(
            pbrMetallicRoughness=shading,
            doubleSided=True,
            alphaMode=mode,
            alphaCutoff=cutoff,
            extensions={_UNLIT: {}},
        )
    )
    indices = blob.add_indices(corners.reshape(-1))
    document.meshes[0].primitives.append(
        pygltflib.Primitive(attributes=attributes, indices=indices, material=len(document.materials) - 1)
    )


class _Blob:
    """The binary chunk of a document, with the accessors, views and pictures that point into it."""

    def __init__(self, document) -> None:
        self._document = document
        self._content = bytearray()

    def add_vectors(self, values: NDArray[np.float32], *, bounds: bool = False) -> int:
        """Accessor of `(n, 2)` or `(n, 3)` floats; glTF asks for the bounds of positions."""
        import pygltflib

        view = self._add_view(np.ascontiguousarray(values, "<f4").tobytes(), _ARRAY_BUFFER)
        accessor = pygltflib.Accessor(
            bufferView=view, componentType=_FLOAT, count=len(values), type=f"VEC{values.shape[1]}"
        )
        if bounds:
            accessor.min, accessor.max = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        self._document.accessors.append(accessor)
        return len(self._document.accessors) - 1

    def add_indices(self, values: NDArray[np.integer]) -> int:
        """Accessor of `(n,)` vertex indices."""
        import pygltflib

        view = self._add_view(values.astype("<u4").tobytes(), _ELEMENT_BUFFER)
        self._document.accessors.append(
            pygltflib.Accessor(bufferView=view, componentType=_UINT32, count=len(values), type="SCALAR")
        )
        return len(self._document.accessors) - 1

    def add_picture(self, pixels: NDArray[np.uint8]) -> int:
        """Texture of `(height, width, 3 or 4)` pixels, repeating, stored as PNG."""
        import pygltflib
        from PIL import Image

        encoded = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(encoded, format="PNG")
        document = self._document
        document.images.append(pygltflib.Image(bufferView=self._add_view(encoded.getvalue()), mimeType="image/png"))
        if not document.samplers:
            document.samplers = [pygltflib.Sampler(magFilter=9729, minFilter=9987)]
        document.textures.append(pygltflib.Texture(source=len(document.images) - 1, sampler=0))
        return len(document.textures) - 1

    def content(self) -> bytes:
        """Everything added so far."""
        return bytes(self._content)

    def _add_view(self, content: bytes, target: int | None = None) -> int:
        import pygltflib

        view = pygltflib.BufferView(buffer=0, byteOffset=len(self._content), byteLength=len(content), target=target)
        self._document.bufferViews.append(view)
        self._content += content + b"\0" * (-len(content) % 4)
        return len(self._document.bufferViews) - 1


def main(argv: Sequence[str]) -> None:
    """Export a scene, most usefully a generated room, for other programs."""
    parser = argparse.ArgumentParser(prog="python -m avp_habitat.scenes.export", description=main.__doc__)
    parser.add_argument("scene", help=SCENES)
    parser.add_argument("out", type=Path, help="the .glb file to write; must not exist")
    add_up_option(parser)
    arguments = parser.parse_args(argv)
    export_glb(load_scene(arguments.scene, up=arguments.up).mesh, arguments.out)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    raise SystemExit(run(main))
