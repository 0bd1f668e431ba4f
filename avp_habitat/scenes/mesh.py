"""The triangle mesh that every scene becomes: positions, texture coordinates, colours and textures as arrays."""

import logging
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

_log = logging.getLogger(__name__)


@cache
def say_once(scene: str, text: str) -> None:
    """Log a warning about a scene, one line that Python shows on stderr, once in a process.

    Args:
        scene: the path as the user wrote it.
        text: what was found, and what is done with it.
    """
    _log.warning("%s: %s", scene, text)


@dataclass(frozen=True)
class TexturedMesh:
    """An unlit, textured triangle mesh in the world frame (metres, Y up).

    The colour of a surface point is texture x vertex colour, multiplied as they are stored (sRGB-encoded values, no
    conversion): scanned scenes carry baked light that is meant to be shown so.
    """

    vertices: NDArray[np.floating]
    """`(v, 3)` positions in metres, float32; float64 while a file is read, whose coordinates may be large."""
    triangles: NDArray[np.int32]
    """`(t, 3)` vertex indices."""
    uv: NDArray[np.float32]
    """`(v, 2)` texture coordinates; u right, v **down** (glTF's convention), repeating outside [0, 1]."""
    colours: NDArray[np.float32]
    """`(v, 3)` vertex colours times the material's base-colour factor, in [0, 1]; 1 where a mesh has none."""
    texture_index: NDArray[np.int32]
    """`(t,)` index into `textures`, -1 for none."""
    textures: list[NDArray[np.uint8]] = field(default_factory=list)
    """`(height, width, 3)` sRGB pictures."""
    mask_index: NDArray[np.int32] | None = None
    """`(t,)` index into `masks`, -1 for none; None where no triangle has a mask."""
    masks: list[NDArray[np.bool_]] = field(default_factory=list)
    """`(height, width)` where, in texture coordinates, there is a surface; elsewhere is a hole."""

    def __post_init__(self) -> None:
        """Check the shapes, which are the contract between loaders and renderers."""
        vertices, triangles = len(self.vertices), len(self.triangles)
        assert self.vertices.shape == (vertices, 3), self.vertices.shape
        assert self.triangles.shape == (triangles, 3), self.triangles.shape
        assert self.uv.shape == (vertices, 2), self.uv.shape
        assert self.colours.shape == (vertices, 3), self.colours.shape
        assert self.texture_index.shape == (triangles,), self.texture_index.shape

    @property
    def bounds(self) -> NDArray[np.floating]:
        """`(2, 3)` least and greatest corner in metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def merge(parts: list[TexturedMesh]) -> TexturedMesh:
    """One mesh of several; textures and masks that are the same object are kept once."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    textures, lookups = _kept_once([part.textures for part in parts])
    masks, mask_lookups = _kept_once([part.masks for part in parts])
    without = [np.full(len(part.triangles), -1) if part.mask_index is None else part.mask_index for part in parts]
    return TexturedMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + np.int32(at) for part, at in zip(parts, offsets[:-1], strict=True)]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate([lookup[part.texture_index] for part, lookup in zip(parts, lookups, strict=True)]),
        textures,
        np.concatenate([lookup[index] for index, lookup in zip(without, mask_lookups, strict=True)]) if masks else None,
        masks,
    )


def _kept_once(pictures: list[list[NDArray]]) -> tuple[list[NDArray], list[NDArray[np.int32]]]:
    """All different pictures, and for each list the new indices of its own, -1 staying -1."""
    every = {id(picture): picture for own in pictures for picture in own}
    slot = {key: number for number, key in enumerate(every)}
    return list(every.values()), [
        np.array([slot[id(picture)] for picture in own] + [-1], dtype=np.int32) for own in pictures
    ]
