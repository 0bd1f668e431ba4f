"""Typed arrays out of the buffers of a glTF document."""

import base64
import binascii

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
