"""Solids and sheets with texture coordinates in metres, normals outwards, counter-clockwise triangles."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.noise import Picture

Float = NDArray[np.floating]
Vector = tuple[float, float, float]
Rectangle = tuple[float, float, float, float]
HALF_TURN = 3.14159265
"""Radians, with as many digits as the first rooms were made with."""


@dataclass(frozen=True, eq=False)
class Material:
    """A picture, the metres that it spans along u and v, and whether it glows, so that baked light leaves it alone."""

    paint: Callable[[], Picture]
    """Makes the picture; called once, when it is first needed."""
    width_m: float
    height_m: float
    glows: bool = False

    @cached_property
    def picture(self) -> Picture:
        """`(height, width, 3)` sRGB."""
        return self.paint()


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Triangles of one material, counter-clockwise as seen from outside."""

    vertices: Float
    """`(v, 3)` metres."""
    normals: Float
    """`(v, 3)` unit length, outwards."""
    uv: Float
    """`(v, 2)` texture coordinates, v down."""
    triangles: NDArray[np.int32]
    """`(t, 3)`."""
    material: Material


def _grid_triangles(rows: int, columns: int) -> NDArray[np.int32]:
    """Triangles of a grid of vertices whose rows run down and whose columns run right, seen from the front."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)


def _unit(vectors: Float) -> Float:
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return vectors / np.where(length < 1e-12, 1.0, length)


def sheet(points: Float, uv: Float, material: Material, *, both_sides: bool = False) -> list[MeshSurface]:
    """A curved sheet through `(rows, columns, 3)` points in metres; `both_sides` adds a back, 3 mm behind the front.

    Rows run down and columns right, seen from the front; texture coordinates are `(rows, columns, 2)`.
    """
    rows, columns = points.shape[:2]
    vertices, triangles = points.reshape(-1, 3), _grid_triangles(rows, columns)
    corners = vertices[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], face)
    normals = _unit(normals)
    front = MeshSurface(vertices, normals, uv.reshape(-1, 2), triangles, material)
    if not both_sides:
        return [front]
    back = replace(front, vertices=vertices - 0.003 * normals, normals=-normals, triangles=triangles[:, ::-1].copy())
    return [front, back]


def breaks(length: float, pitch: float, extra: tuple[float, ...] = ()) -> Float:
    """Ascending positions from 0 to length no farther apart than pitch, with the extra ones among them."""
    edges = sorted({0.0, length, *(place for place in extra if 0 < place < length)})
    parts = [
        np.linspace(start, end, max(1, int(np.ceil((end - start) / pitch - 1e-9))) + 1)[:-1]
        for start, end in pairwise(edges)
    ]
    return np.concatenate([*parts, [length]])


def panel(
    corner: Vector | Float,
    right: Vector | Float,
    down: Vector | Float,
    material: Material,
    *,
    pitch: float = 0.3,
    fit: Rectangle | None = None,
    turned: bool = False,
    origin: tuple[float, float] = (0.0, 0.0),
    holes: tuple[Rectangle, ...] = (),
) -> MeshSurface:
    """A flat rectangle, subdivided so that light can vary over it; all lengths are in metres.

    `corner` is the upper left one as seen from the front, from where the edges `right` and `down` lead. The picture
    measures metres along those, from `origin` on (u runs downwards where it is `turned`), or its part `fit` (u0, v0,
    u1, v1) is stretched over the rectangle. Vertices are at most `pitch` apart; `holes` (right0, down0, right1, down1)
    are left out.
    """
    start, across, fall = (np.asarray(part, dtype=np.float64) for part in (corner, right, down))
    width, height = float(np.sqrt((across**2).sum())), float(np.sqrt((fall**2).sum()))
    s = breaks(width, pitch, tuple(x for hole in holes for x in (hole[0], hole[2])))
    t = breaks(height, pitch, tuple(y for hole in holes for y in (hole[1], hole[3])))
    points = start + (s / width)[None, :, None] * across + (t / height)[:, None, None] * fall
    if fit is not None:
        u, v = fit[0] + (fit[2] - fit[0]) * s / width, fit[1] + (fit[3] - fit[1]) * t / height
        grid_u, grid_v = np.meshgrid(u, v)
    else:
        grid_u, grid_v = np.meshgrid(s + origin[0], t + origin[1])
        if turned:
            grid_u, grid_v = grid_v, grid_u
        grid_u, grid_v = grid_u / material.width_m, grid_v / material.height_m
    uv = np.stack([grid_u, grid_v], axis=-1).reshape(-1, 2)
    triangles = _grid_triangles(len(t), len(s))
    if holes:
        mid_s, mid_t = (s[:-1] + s[1:]) / 2, (t[:-1] + t[1:]) / 2
        open_ = np.zeros((len(mid_t), len(mid_s)), dtype=bool)
        for left, top, end, bottom in holes:
            open_ |= ((mid_t > top) & (mid_t < bottom))[:, None] & ((mid_s > left) & (mid_s < end))[None]
        triangles = triangles[np.repeat(~open_.ravel(), 2)]
    normal = _unit(np.cross(fall, across))
    used, triangles = np.unique(triangles, return_inverse=True)
    vertices, uv, triangles = points.reshape(-1, 3)[used], uv[used], triangles.reshape(-1, 3).astype(np.int32)
    return MeshSurface(vertices, np.broadcast_to(normal, vertices.shape).copy(), uv, triangles, material)


_FACES = {
    "front": ((-1, 1, 1), 0, 1, 1, -1),
    "back": ((1, 1, -1), 0, 1, -1, -1),
    "right": ((1, 1, 1), 2, 1, -1, -1),
    "left": ((-1, 1, -1), 2, 1, 1, -1),
    "top": ((-1, 1, -1), 0, 2, 1, 1),
    "bottom": ((-1, -1, 1), 0, 2, 1, -1),
}
"""Of each face: its upper left corner, the axes of right and down, and their signs."""


def _face_corners(face: str) -> NDArray[np.int64]:
    """`(4, 3)` signs of a face's upper left, lower left, lower right and upper right corner."""
    corner, right, down, _, _ = _FACES[face]
    signs = np.tile(np.array(corner), (4, 1))
    signs[1:3, down] *= -1
    signs[2:4, right] *= -1
    return signs


_CORNERS = {face: _face_corners(face) for face in _FACES}
_QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_UNIT_QUAD = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])


def _small_box(
    size: Float, middle: Float, material: Material, faces: tuple[str, ...], fit: Rectangle | None
) -> MeshSurface:
    """A cuboid of one quad per face."""
    vertices = middle + size / 2 * np.concatenate([_CORNERS[face] for face in faces])
    normals, uv = np.zeros_like(vertices), np.empty((len(vertices), 2))
    longest, origin = int(np.argmax(np.round(size, 4))), _picture_origin(middle)
    for index, face in enumerate(faces):
        corner, right, down, _, _ = _FACES[face]
        rows = slice(4 * index, 4 * index + 4)
        normals[rows, 3 - right - down] = corner[3 - right - down]
        if fit is not None:
            uv[rows] = _UNIT_QUAD * [fit[2] - fit[0], fit[3] - fit[1]] + fit[:2]
            continue
        metres = _UNIT_QUAD * [size[right], size[down]] + origin
        uv[rows] = (metres[:, ::-1] if down == longest else metres) / [material.width_m, material.height_m]
    triangles = (_QUAD[None] + 4 * np.arange(len(faces), dtype=np.int32)[:, None, None]).reshape(-1, 3)
    return MeshSurface(vertices, normals, uv, triangles, material)


def _picture_origin(middle: Float) -> tuple[float, float]:
    """Where on its picture a box starts, so that neighbouring boards differ."""
    x, y, z = (float(part) for part in middle)
    return x * 1.7 + y * 2.9 + z * 1.3, x * 0.9 + y * 1.1 + z * 2.3


def box(
    size: Vector,
    centre: Vector,
    material: Material,
    *,
    faces: tuple[str, ...] = tuple(_FACES),
    fit: Rectangle | None = None,
    pitch: float = 0.35,
) -> list[MeshSurface]:
    """A cuboid of extents and middle in metres; the picture's u runs along its longest edge, as wood is cut.

    Faces are front (+z), back, right (+x), left, top, bottom; `fit` and `pitch` as of `panel`.
    """
    extent, middle = np.asarray(size, dtype=np.float64), np.asarray(centre, dtype=np.float64)
    if max(size) <= pitch:
        return [_small_box(extent, middle, material, faces, fit)]
    longest = int(np.argmax(np.round(extent, 4)))
    made = []
    for face in faces:
        corner, right, down, right_sign, down_sign = _FACES[face]
        across, fall = np.zeros(3), np.zeros(3)
        across[right], fall[down] = right_sign * extent[right], down_sign * extent[down]
        start, origin = middle + extent / 2 * corner, _picture_origin(middle)
        turned = down == longest
        made.append(panel(start, across, fall, material, pitch=pitch, fit=fit, turned=turned, origin=origin))
    return made


def cushion(size: Vector, centre: Vector, radius: float, material: Material, *, puff: float = 0.0) -> list[MeshSurface]:
    """A cuboid with rounded edges; `puff` metres of bulge along its thinnest extent make a pillow."""
    half, middle = np.asarray(size) / 2, np.asarray(centre, dtype=np.float64)
    radius = min(radius, float(half.min()) * 0.98)
    thin = int(np.argmin(np.round(size, 4)))
    made = []
    for corner, right, down, right_sign, down_sign in _FACES.values():
        s, t = (
            np.array([-half[a], -half[a] + radius, 0.0, half[a] - radius, half[a]]) * sign
            for a, sign in ((right, right_sign), (down, down_sign))
        )
        points = np.zeros((5, 5, 3))
        points[..., right], points[..., down] = s[None, :], t[:, None]
        normal_axis = 3 - right - down
        points[..., normal_axis] = half[normal_axis] * corner[normal_axis]
        inner = np.clip(points, -(half - radius), half - radius)
        points = inner + radius * _unit(points - inner)
        if puff:
            flat = np.delete(np.arange(3), thin)
            share = 1 - np.clip(np.abs(points[..., flat] / half[flat]), 0, 1) ** 2
            points[..., thin] += np.sign(points[..., thin]) * puff * share[..., 0] * share[..., 1]
        uv = np.stack(np.broadcast_arrays(s[None, :] / material.width_m, t[:, None] / material.height_m), axis=-1)
        uv = uv * [right_sign, down_sign] + [middle[0] * 1.3 + middle[2], middle[1] + middle[2] * 0.7]
        made += sheet(points + middle, uv, material)
    return made


def lathe(
    profile: list[tuple[float, float]],
    centre: Vector,
    material: Material,
    *,
    segments: int = 12,
    open_ended: bool = False,
) -> list[MeshSurface]:
    """A surface of revolution about the vertical axis whose foot is `centre`.

    The profile is (radius, height) in metres from the top of the outside downwards, `segments` the number of faces
    around; where the inside can be seen, it is `open_ended` and has a surface there, too.
    """
    outline = np.asarray(profile, dtype=np.float64)
    angle = np.arange(segments + 1) * (2 * np.pi / segments)
    points = np.empty((len(outline), segments + 1, 3))
    points[..., 0] = outline[:, :1] * np.sin(angle) + centre[0]
    points[..., 1] = outline[:, 1:] + centre[1]
    points[..., 2] = outline[:, :1] * np.cos(angle) + centre[2]
    path = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(outline, axis=0) ** 2).sum(axis=1)))])
    turns = max(1, round(2 * np.pi * float(outline[:, 0].max()) / material.width_m))
    u, v = np.meshgrid(angle / (2 * np.pi) * turns, path / material.height_m)
    return sheet(points, np.stack([u, v], axis=-1), material, both_sides=open_ended)


def cylinder(
    radius: float, bottom: float, top: float, centre: Vector, material: Material, segments: int = 12
) -> list[MeshSurface]:
    """An upright cylinder with sharp rims between two heights above its foot, metres."""
    rims = [(0.0005, top), (radius, top), (radius, bottom), (0.0005, bottom)]
    return [part for ends in pairwise(rims) for part in lathe([*ends], centre, material, segments=segments)]


def moved(surfaces: list[MeshSurface], axes: Float, offset: Float) -> list[MeshSurface]:
    """The same surfaces turned by `axes` (3, 3), whose columns are the new x, y and z, then shifted by `offset`."""
    return [replace(s, vertices=s.vertices @ axes.T + offset, normals=s.normals @ axes.T) for s in surfaces]


def yawed(surfaces: list[MeshSurface], yaw: float, offset: Vector = (0.0, 0.0, 0.0)) -> list[MeshSurface]:
    """The same surfaces turned about +Y by `yaw` radians, then shifted."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return moved(surfaces, np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]), np.asarray(offset))


def leaned(surfaces: list[MeshSurface], angle: float) -> list[MeshSurface]:
    """The same surfaces turned about +X by `angle` radians; negative angles lean them back."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return moved(surfaces, np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]), np.zeros(3))


def by_material(surfaces: list[MeshSurface]) -> list[MeshSurface]:
    """The same surfaces with those of one material together, in order of first appearance."""
    groups: dict[int, list[MeshSurface]] = {}
    for surface in surfaces:
        groups.setdefault(id(surface.material), []).append(surface)
    return [surface for group in groups.values() for surface in group]
