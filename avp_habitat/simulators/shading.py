"""Colours of ray hits on a textured mesh, filtered over each pixel's footprint."""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.scenes.mesh import TexturedMesh

_MAX_PROBES = 8
_PIXELS_PER_TASK = 1 << 14


class Surface(NamedTuple):
    """A textured mesh as flat arrays for the compiled kernel; all textures' pyramids lie one after the other."""

    vertices: NDArray[np.float32]
    """`(v, 3)` metres."""
    triangles: NDArray[np.int32]
    """`(t, 3)`."""
    uv: NDArray[np.float32]
    """`(v, 2)`, v down."""
    colours: NDArray[np.float32]
    """`(v, 3)` in [0, 1]."""
    texture_index: NDArray[np.int32]
    """`(t,)`, -1 for none."""
    texels: NDArray[np.uint8]
    """`(n, 3)` all levels of all textures."""
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
    flat = [level.reshape(-1, 3) for pyramid in pyramids for level in pyramid]
    return Surface(
        np.ascontiguousarray(mesh.vertices, np.float32),
        np.ascontiguousarray(mesh.triangles, np.int32),
        np.ascontiguousarray(mesh.uv, np.float32),
        np.ascontiguousarray(mesh.colours, np.float32),
        np.ascontiguousarray(mesh.texture_index, np.int32),
        np.concatenate(flat) if flat else np.zeros((0, 3), np.uint8),
        np.array(levels, np.int64).reshape(-1, 3),
        np.cumsum([0] + [len(pyramid) for pyramid in pyramids], dtype=np.int64),
    )


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
    starts = range(0, cameras * pixels, _PIXELS_PER_TASK)
    # Plain threads: numba's own would bring OpenMP or TBB along, which do not survive a fork of the process.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(lambda start: _shade(surface, hits, start, start + _PIXELS_PER_TASK, out), starts))
    return out


@njit(cache=True, nogil=True)
def _shade(surface, hits, start, stop, out):  # pragma: no cover - compiled
    pixels = out.shape[1]
    for ray in range(start, min(stop, out.shape[0] * pixels)):
        camera = ray // pixels
        pixel = ray - camera * pixels
        if hits.distance[camera, pixel] < np.inf:
            _shade_pixel(surface, hits, camera, pixel, out[camera, pixel])


@njit(cache=True)
def _shade_pixel(surface, hits, camera, pixel, out):  # pragma: no cover - compiled
    triangle = hits.triangle[camera, pixel]
    a, b, c = surface.triangles[triangle]
    wb, wc = hits.barycentric[camera, pixel]
    wa = 1.0 - wb - wc
    red, green, blue = 255.0, 255.0, 255.0
    texture = surface.texture_index[triangle]
    if texture >= 0:
        u = wa * surface.uv[a, 0] + wb * surface.uv[b, 0] + wc * surface.uv[c, 0]
        v = wa * surface.uv[a, 1] + wb * surface.uv[b, 1] + wc * surface.uv[c, 1]
        red, green, blue = _filtered(surface, texture, u, v, _footprint(surface, hits, camera, pixel, a, b, c))
    colours = surface.colours
    out[0] = _to_byte(red * (wa * colours[a, 0] + wb * colours[b, 0] + wc * colours[c, 0]))
    out[1] = _to_byte(green * (wa * colours[a, 1] + wb * colours[b, 1] + wc * colours[c, 1]))
    out[2] = _to_byte(blue * (wa * colours[a, 2] + wb * colours[b, 2] + wc * colours[c, 2]))


@njit(cache=True)
def _to_byte(value):  # pragma: no cover - compiled
    return np.uint8(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True)
def _footprint(surface, hits, camera, pixel, a, b, c):  # pragma: no cover - compiled
    """Change of (u, v) from this pixel to its right and lower neighbours (ray differentials, Igehy 1999)."""
    p = surface.vertices
    e1x, e1y, e1z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    e2x, e2y, e2z = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    nx, ny, nz = _cross(np.float64(e1x), np.float64(e1y), np.float64(e1z), e2x, e2y, e2z)
    area = nx * nx + ny * ny + nz * nz
    dx, dy, dz = hits.directions[camera, pixel]
    facing = nx * dx + ny * dy + nz * dz
    if area <= 0.0 or facing == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    u1, v1 = surface.uv[b, 0] - surface.uv[a, 0], surface.uv[b, 1] - surface.uv[a, 1]
    u2, v2 = surface.uv[c, 0] - surface.uv[a, 0], surface.uv[c, 1] - surface.uv[a, 1]
    # Gradients of the two barycentric weights within the triangle's plane, metres^-1.
    g1x, g1y, g1z = _cross(np.float64(e2x), np.float64(e2y), np.float64(e2z), nx, ny, nz)
    g2x, g2y, g2z = _cross(nx, ny, nz, e1x, e1y, e1z)
    distance = hits.distance[camera, pixel]
    steps = (0.0, 0.0, 0.0, 0.0)
    for side in range(2):
        step = hits.step_right[camera] if side == 0 else hits.step_down[camera]
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


@njit(cache=True)
def _filtered(surface, texture, u, v, footprint):  # pragma: no cover - compiled
    """Mean colour over the footprint, 0 to 255: probes along its long side, each as wide as its short side."""
    base = surface.first_level[texture]
    width, height = surface.levels[base, 1], surface.levels[base, 2]
    right = np.hypot(footprint[0] * width, footprint[1] * height)
    down = np.hypot(footprint[2] * width, footprint[3] * height)
    long, short = max(right, down), max(min(right, down), 1.0)
    du, dv = (footprint[0], footprint[1]) if right >= down else (footprint[2], footprint[3])
    if not long > 1.0:
        return _bilinear(surface, base, u, v)
    top = surface.first_level[texture + 1] - 1 - base
    if not long < 1e9:
        return _bilinear(surface, base + top, u, v)
    probes = min(int(np.ceil(long / short)), _MAX_PROBES)
    level = min(np.log2(max(long / probes, 1.0)), float(top))
    red, green, blue = 0.0, 0.0, 0.0
    for probe in range(probes):
        along = (probe + 0.5) / probes - 0.5
        r, g, b = _trilinear(surface, base, level, top, u + along * du, v + along * dv)
        red, green, blue = red + r, green + g, blue + b
    return red / probes, green / probes, blue / probes


@njit(cache=True)
def _trilinear(surface, base, level, top, u, v):  # pragma: no cover - compiled
    lower = int(level)
    upper = min(lower + 1, top)
    share = level - lower
    r0, g0, b0 = _bilinear(surface, base + lower, u, v)
    if share == 0.0:
        return r0, g0, b0
    r1, g1, b1 = _bilinear(surface, base + upper, u, v)
    return r0 + share * (r1 - r0), g0 + share * (g1 - g0), b0 + share * (b1 - b0)


@njit(cache=True)
def _bilinear(surface, row, u, v):  # pragma: no cover - compiled
    """Colour of one level at (u, v), repeating outside [0, 1]; texel centres lie at +0.5."""
    offset, width, height = surface.levels[row]
    x = (u - np.floor(u)) * width - 0.5
    y = (v - np.floor(v)) * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    left, right = x0 % width, (x0 + 1) % width
    upper, lower = offset + (y0 % height) * width, offset + ((y0 + 1) % height) * width
    texels = surface.texels
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    a, b, c, d = texels[upper + left], texels[upper + right], texels[lower + left], texels[lower + right]
    return (
        w00 * a[0] + w01 * b[0] + w10 * c[0] + w11 * d[0],
        w00 * a[1] + w01 * b[1] + w10 * c[1] + w11 * d[1],
        w00 * a[2] + w01 * b[2] + w10 * c[2] + w11 * d[2],
    )
