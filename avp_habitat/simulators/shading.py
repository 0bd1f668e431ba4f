"""Colours of ray hits on a textured mesh, filtered over each pixel's footprint."""

import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.scenes.mesh import TexturedMesh

_MAX_PROBES = 8
_PIXELS_PER_TASK = 1 << 15


class Surface(NamedTuple):
    """A textured mesh as flat arrays for the compiled kernel; all textures' pyramids lie one after the other."""

    vertices: NDArray[np.float32]
    """`(v, 3)` metres."""
    triangles: NDArray[np.uint32]
    """`(t, 3)`; unsigned, because compiled code looks whether signed indices count from the end."""
    uv: NDArray[np.float32]
    """`(v, 2)`, v down."""
    colours: NDArray[np.float32]
    """`(v, 3)` in [0, 1]."""
    texture_index: NDArray[np.int32]
    """`(t,)`, -1 for none."""
    texels: NDArray[np.uint32]
    """`(n,)` all levels of all textures; red in the lowest byte, then green and blue."""
    levels: NDArray[np.int64]
    """`(l, 3)` offset in `texels`, width and height of each level."""
    first_level: NDArray[np.int64]
    """`(k + 1,)` row of `levels` where a texture's pyramid starts; the last entry ends the last one."""


class Hits(NamedTuple):
    """Where the rays of n cameras met the mesh."""

    directions: NDArray[np.float32]
    """`(n, pixels, 3)` ray directions, world frame, scaled so that `distance` is planar depth."""
    distance: NDArray[np.float32]
    """`(n, pixels)` metres, infinite where nothing was hit."""
    triangle: NDArray[np.uint32]
    """`(n, pixels)` index of the triangle hit."""
    barycentric: NDArray[np.float32]
    """`(n, pixels, 2)` weights of the triangle's second and third corner."""
    step_right: NDArray[np.float64]
    """`(n, 3)` change of the direction from one pixel to the next on its right."""
    step_down: NDArray[np.float64]
    """`(n, 3)` change of the direction from one pixel to the next below."""


def pack_surface(mesh: TexturedMesh) -> Surface:
    """The arrays that `shade` reads, with a pyramid of halved pictures for every texture."""
    pyramids = [_pyramid(texture) for texture in mesh.textures]
    levels, offset = [], 0
    for level in (level for pyramid in pyramids for level in pyramid):
        levels.append((offset, level.shape[1], level.shape[0]))
        offset += level.shape[0] * level.shape[1]
    flat = [_packed(level) for pyramid in pyramids for level in pyramid]
    return Surface(
        np.ascontiguousarray(mesh.vertices, np.float32),
        np.ascontiguousarray(mesh.triangles, np.int32).view(np.uint32),
        np.ascontiguousarray(mesh.uv, np.float32),
        np.ascontiguousarray(mesh.colours, np.float32),
        np.ascontiguousarray(mesh.texture_index, np.int32),
        np.concatenate(flat) if flat else np.zeros(0, np.uint32),
        np.array(levels, np.int64).reshape(-1, 3),
        np.cumsum([0] + [len(pyramid) for pyramid in pyramids], dtype=np.int64),
    )


def _packed(picture: NDArray[np.uint8]) -> NDArray[np.uint32]:
    packed = np.zeros((picture.shape[0] * picture.shape[1], 4), np.uint8)
    packed[:, :3] = picture.reshape(-1, 3)
    return packed.view("<u4")[:, 0]


def _pyramid(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """The picture and its halvings down to one texel, each level the area average of the level before."""
    from PIL import Image

    levels = [np.ascontiguousarray(texture)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = Image.fromarray(levels[-1]).resize((max(1, width // 2), max(1, height // 2)), Image.Resampling.BOX)
        levels.append(np.asarray(half))
    return levels


def shade(surface: Surface, hits: Hits) -> NDArray[np.uint8]:
    """Texture times vertex colour at every hit, multiplied as stored; black where nothing was hit.

    A pixel's footprint on the surface comes from ray differentials; it is averaged by up to eight trilinear probes
    along its long side (anisotropic filtering as in OpenGL's EXT_texture_filter_anisotropic), so that floors seen at
    a grazing angle neither shimmer nor blur.

    Args:
        surface: the mesh, packed.
        hits: of n cameras.

    Returns:
        `(n, pixels, 3)` uint8.
    """
    cameras, pixels = hits.distance.shape
    out = np.zeros((cameras, pixels, 3), np.uint8)

    def shade_part(task: tuple[int, int]) -> None:
        camera, start = task
        _shade(surface, hits, camera, start, min(start + _PIXELS_PER_TASK, pixels), out)

    # Plain threads: numba's own would bring OpenMP or TBB along, which do not survive a fork of the process.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(shade_part, itertools.product(range(cameras), range(0, pixels, _PIXELS_PER_TASK))))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(surface, hits, camera, start, stop, out):  # pragma: no cover - compiled
    # Helpers get single arrays: handing the tuples on would copy and count references for every pixel.
    vertices, triangles, uv, colours = surface.vertices, surface.triangles, surface.uv, surface.colours
    texture_index, texels = surface.texture_index, surface.texels
    levels, first_level = surface.levels, surface.first_level
    directions, barycentric = hits.directions, hits.barycentric
    right = hits.step_right[camera, 0], hits.step_right[camera, 1], hits.step_right[camera, 2]
    down = hits.step_down[camera, 0], hits.step_down[camera, 1], hits.step_down[camera, 2]
    for pixel in range(start, stop):
        distance = hits.distance[camera, pixel]
        if not distance < np.inf:
            continue
        triangle = hits.triangle[camera, pixel]
        a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        wb, wc = barycentric[camera, pixel, 0], barycentric[camera, pixel, 1]
        wa = 1.0 - wb - wc
        red, green, blue = 255.0, 255.0, 255.0
        texture = texture_index[triangle]
        if texture >= 0:
            u = wa * uv[a, 0] + wb * uv[b, 0] + wc * uv[c, 0]
            v = wa * uv[a, 1] + wb * uv[b, 1] + wc * uv[c, 1]
            direction = (directions[camera, pixel, 0], directions[camera, pixel, 1], directions[camera, pixel, 2])
            footprint = _footprint(vertices, uv, (a, b, c), direction, distance, right, down)
            first, last = first_level[texture], first_level[texture + 1] - 1
            red, green, blue = _filtered(texels, levels, first, last, u, v, footprint)
        out[camera, pixel, 0] = _to_byte(red * (wa * colours[a, 0] + wb * colours[b, 0] + wc * colours[c, 0]))
        out[camera, pixel, 1] = _to_byte(green * (wa * colours[a, 1] + wb * colours[b, 1] + wc * colours[c, 1]))
        out[camera, pixel, 2] = _to_byte(blue * (wa * colours[a, 2] + wb * colours[b, 2] + wc * colours[c, 2]))


@njit(cache=True)
def _to_byte(value):  # pragma: no cover - compiled
    return np.uint8(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True, error_model="numpy")
def _footprint(p, uv, corners, direction, distance, right, down):  # pragma: no cover - compiled
    """Change of (u, v) from this pixel to its right and lower neighbours (ray differentials, Igehy 1999)."""
    a, b, c = corners
    e1x, e1y, e1z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    e2x, e2y, e2z = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    nx, ny, nz = _cross(np.float64(e1x), np.float64(e1y), np.float64(e1z), e2x, e2y, e2z)
    area = nx * nx + ny * ny + nz * nz
    dx, dy, dz = direction
    facing = nx * dx + ny * dy + nz * dz
    if area <= 0.0 or facing == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    u1, v1 = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
    u2, v2 = uv[c, 0] - uv[a, 0], uv[c, 1] - uv[a, 1]
    # Gradients of the two barycentric weights within the triangle's plane, metres^-1.
    g1x, g1y, g1z = _cross(np.float64(e2x), np.float64(e2y), np.float64(e2z), nx, ny, nz)
    g2x, g2y, g2z = _cross(nx, ny, nz, e1x, e1y, e1z)
    steps = (0.0, 0.0, 0.0, 0.0)
    for side in range(2):
        step = right if side == 0 else down
        slide = (nx * step[0] + ny * step[1] + nz * step[2]) / facing
        mx, my, mz = step[0] - dx * slide, step[1] - dy * slide, step[2] - dz * slide
        w1 = distance * (mx * g1x + my * g1y + mz * g1z) / area
        w2 = distance * (mx * g2x + my * g2y + mz * g2z) / area
        du, dv = w1 * u1 + w2 * u2, w1 * v1 + w2 * v2
        steps = (du, dv, 0.0, 0.0) if side == 0 else (steps[0], steps[1], du, dv)
    return steps


@njit(cache=True)
def _cross(ax, ay, az, bx, by, bz):  # pragma: no cover - compiled
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, error_model="numpy")
def _filtered(texels, levels, first, last, u, v, footprint):  # pragma: no cover - compiled
    """Mean colour over the footprint, 0 to 255: probes along its long side, each as wide as its short side."""
    width, height = levels[first, 1], levels[first, 2]
    right = np.sqrt((footprint[0] * width) ** 2 + (footprint[1] * height) ** 2)
    down = np.sqrt((footprint[2] * width) ** 2 + (footprint[3] * height) ** 2)
    long, short = max(right, down), max(min(right, down), 1.0)
    du, dv = (footprint[0], footprint[1]) if right >= down else (footprint[2], footprint[3])
    if not long > 1.0:
        probes, level, du, dv = 1, 0.0, 0.0, 0.0
    elif not long < 1e9:
        probes, level, du, dv = 1, float(last - first), 0.0, 0.0
    else:
        probes = min(int(np.ceil(long / short)), _MAX_PROBES)
        level = min(np.log2(max(long / probes, 1.0)), float(last - first))
    lower = first + int(level)
    upper, share = min(lower + 1, last), level - int(level)
    red, green, blue = 0.0, 0.0, 0.0
    for probe in range(probes):
        along = (probe + 0.5) / probes - 0.5
        r, g, b = _bilinear(texels, levels, lower, u + along * du, v + along * dv)
        if share > 0.0:
            r1, g1, b1 = _bilinear(texels, levels, upper, u + along * du, v + along * dv)
            r, g, b = r + share * (r1 - r), g + share * (g1 - g), b + share * (b1 - b)
        red, green, blue = red + r, green + g, blue + b
    return red / probes, green / probes, blue / probes


@njit(cache=True, inline="always")
def _bilinear(texels, levels, row, u, v):  # pragma: no cover - compiled
    """Colour of one level at (u, v), repeating outside [0, 1]; texel centres lie at +0.5."""
    offset, width, height = levels[row, 0], levels[row, 1], levels[row, 2]
    x = (u - np.floor(u)) * width - 0.5
    y = (v - np.floor(v)) * height - 0.5
    floor_x, floor_y = np.floor(x), np.floor(y)
    fx, fy = x - floor_x, y - floor_y
    left, upper = _wrapped(int(floor_x), width), _wrapped(int(floor_y), height)
    right, lower = (left + 1 if left + 1 < width else 0), (upper + 1 if upper + 1 < height else 0)
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    upper, lower = offset + upper * width, offset + lower * width
    a, b = texels[np.uint64(upper + left)], texels[np.uint64(upper + right)]
    c, d = texels[np.uint64(lower + left)], texels[np.uint64(lower + right)]
    return (
        w00 * (a & 255) + w01 * (b & 255) + w10 * (c & 255) + w11 * (d & 255),
        w00 * (a >> 8 & 255) + w01 * (b >> 8 & 255) + w10 * (c >> 8 & 255) + w11 * (d >> 8 & 255),
        w00 * (a >> 16) + w01 * (b >> 16) + w10 * (c >> 16) + w11 * (d >> 16),
    )


@njit(cache=True, inline="always")
def _wrapped(index, count):  # pragma: no cover - compiled
    """An index from -1 to `count`, repeating; anything else, as of a (u, v) that is no number, stays in the picture."""
    return index if 0 <= index < count else count - 1
