"""Procedural pictures of woven and printed cloth: upholstery, cushions, curtains, bedding, rugs."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.random import Dice

Field = NDArray[np.floating]
Colour = tuple[float, float, float]


def _stretch(lattice: Field, length: int) -> Field:
    """Rows of a periodic lattice, interpolated smoothly to `length` rows."""
    rows = len(lattice)
    position = np.arange(length, dtype=np.float32) * np.float32(rows / length)
    index = position.astype(np.int64)
    part = position - index
    part = (part * part * (3 - 2 * part)).reshape(-1, *[1] * (lattice.ndim - 1))
    return lattice[index % rows] * (1 - part) + lattice[(index + 1) % rows] * part


def value_noise(dice: Dice, size: tuple[int, int], cells: tuple[int, int]) -> Field:
    """`(height, width)` periodic noise in [0, 1] with `cells` (rows, columns) of random values."""
    lattice = dice.array(cells)
    return np.ascontiguousarray(_stretch(np.ascontiguousarray(_stretch(lattice, size[0]).T), size[1]).T)


def fractal(dice: Dice, size: tuple[int, int], cells: tuple[int, int], octaves: int = 4, gain: float = 0.5) -> Field:
    """`(height, width)` periodic sum of ever finer and weaker noise, in [0, 1]."""
    total, weight, sum_of_weights = np.zeros(size, np.float32), 1.0, 0.0
    rows, columns = cells
    for _ in range(octaves):
        total += np.float32(weight) * value_noise(dice, size, (min(rows, size[0]), min(columns, size[1])))
        sum_of_weights += weight
        rows, columns, weight = rows * 2, columns * 2, weight * gain
    return total / np.float32(sum_of_weights)


def coordinates(size: tuple[int, int]) -> tuple[Field, Field]:
    """`(height, width)` each: u to the right and v downwards in (0, 1), at pixel centres."""
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32)
    return (u + np.float32(0.5)) / np.float32(size[1]), (v + np.float32(0.5)) / np.float32(size[0])


def plain(size: tuple[int, int], colour: Colour) -> Field:
    """`(height, width, 3)` of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (*size, 3)).copy()


def mix(first: Field, second: Colour | Field, share: Field | float) -> Field:
    """Blend two colour fields; `share` (height, width) in [0, 1] is that of the second."""
    share = np.asarray(share, np.float32)
    share = share[..., None] if share.ndim == 2 else share
    blended = np.asarray(second, np.float32) - first
    blended *= share
    blended += first
    return blended


def shade(colour: Colour, factor: float) -> Colour:
    """A lighter or darker colour, within [0, 1]."""
    red, green, blue = (min(max(part * factor, 0.0), 1.0) for part in colour)
    return red, green, blue


def blend(first: Colour, second: Colour, share: float) -> Colour:
    """The colour between two colours; `share` is that of the second."""
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return red, green, blue


def step(value: Field, edge: float | Field, width: float) -> Field:
    """0 below the edge, 1 above it, with a linear transition of the given width."""
    risen = (value - np.float32(edge)) * np.float32(1 / width)
    risen += np.float32(0.5)
    return np.clip(risen, 0, 1, out=risen)


def wave(value: Field) -> Field:
    """Triangle wave of period 1 in [0, 1]; 0 at whole numbers."""
    rest = value - np.floor(value)
    return 2 * np.minimum(rest, 1 - rest)


def cosine_of_multiple(u: Field, v: Field, count: int) -> Field:
    """cos(count x angle) of the direction (u, v), by Chebyshev's recurrence.

    Arithmetic alone, because processors differ in the last bits of their cosines and pictures must not.
    """
    cosine = u / np.sqrt(u * u + v * v + np.float32(1e-12))
    before, now = np.ones_like(cosine), cosine
    for _ in range(count - 1):
        before, now = now, 2 * cosine * now - before
    return now


def turn_of(u: Field, v: Field) -> Field:
    """A number that rises from 0 to 1 with the direction of (u, v) around the origin, though not evenly."""
    share = u / (np.abs(u) + np.abs(v) + np.float32(1e-12))
    return np.where(v >= 0, 1 - share, 3 + share) / 4


def to_picture(rgb: Field) -> NDArray[np.uint8]:
    """`(height, width, 3)` colours in [0, 1] as bytes."""
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)


Picture = NDArray[np.uint8]


def _threads(dice: Dice, size: tuple[int, int], pitch: int) -> Field:
    """`(height, width)` light of a plain weave with `pitch` pixels per thread and uneven yarn."""
    u, v = coordinates(size)
    across, down = size[1] // pitch, size[0] // pitch
    column, row = np.floor(u * across), np.floor(v * down)
    over = (column + row) % 2
    bump = np.where(over > 0, wave(u * across), wave(v * down))
    yarn = np.where(over > 0, value_noise(dice, size, (12, across)), value_noise(dice, size, (down, 12)))
    return 0.76 + 0.2 * bump + 0.26 * (yarn - 0.5) + 0.18 * (fractal(dice, size, (6, 6), 5, 0.8) - 0.5)


def weave(dice: Dice, colour: Colour, second: Colour) -> Picture:
    """Coarse upholstery of two yarns with slubs, 0.6 m x 0.6 m."""
    size = (320, 320)
    slubs = step(value_noise(dice, size, (20, 80)), 0.8, 0.1) + step(value_noise(dice, size, (80, 20)), 0.82, 0.1)
    rgb = mix(plain(size, colour), second, np.clip(slubs, 0, 1) * 0.45)
    for cells, share in ((16, 0.1), (34, 0.13)):
        rgb = mix(rgb, second, step(value_noise(dice, size, (cells, cells)), 1 - share, 0.06) * 0.6)
        rgb = mix(rgb, shade(colour, 0.55), step(value_noise(dice, size, (cells, cells)), 1 - share, 0.06) * 0.5)
    return to_picture(rgb * (_threads(dice, size, 5) * 1.12)[..., None])


def _stripes(u: Field, v: Field) -> list[Field]:
    return [step(wave(v * 6), 0.5, 0.06), step(-np.abs(wave(v * 6) - 0.5), -0.08, 0.03)]


def _plaid(u: Field, v: Field) -> list[Field]:
    bands = step(wave(u * 3), 0.6, 0.03) * 0.55 + step(wave(v * 3), 0.6, 0.03) * 0.45
    fine = np.maximum(step(-np.abs(wave(u * 3) - 0.25), -0.04, 0.02), step(-np.abs(wave(v * 3) - 0.25), -0.04, 0.02))
    return [bands, fine]


def _chevrons(u: Field, v: Field) -> list[Field]:
    zigzag = wave(v * 6 + wave(u * 4) * 0.7)
    return [step(zigzag, 0.55, 0.06), step(-np.abs(zigzag - 0.25), -0.07, 0.04)]


def _ikat(u: Field, v: Field) -> list[Field]:
    local_u, local_v = (u * 3) % 1 * 2 - 1, (v * 3 + np.float32(0.5) * (np.floor(u * 3) % 2)) % 1 * 2 - 1
    distance = np.abs(local_u) * 1.2 + np.abs(local_v) + 0.12 * wave(local_v * 6)
    return [step(-distance, -0.8, 0.08), step(-np.abs(distance - 0.45), -0.1, 0.05)]


def _sprigs(u: Field, v: Field) -> list[Field]:
    local_u, local_v = (u * 5) % 1 * 2 - 1, (v * 5 + np.float32(0.5) * (np.floor(u * 5) % 2)) % 1 * 2 - 1
    radius = np.sqrt(local_u * local_u + local_v * local_v)
    flower = step(-radius + 0.42 + 0.2 * cosine_of_multiple(local_u, local_v, 6), 0, 0.08)
    return [flower, step(-radius, -0.17, 0.06)]


PATTERNS = (_stripes, _plaid, _chevrons, _ikat, _sprigs)


def printed(dice: Dice, colours: tuple[Colour, Colour, Colour]) -> Picture:
    """Cloth of three colours with one of several repeating patterns, 0.6 m x 0.6 m."""
    size = (320, 320)
    u, v = coordinates(size)
    first, second = dice.pick(PATTERNS)(u, v)
    rgb = mix(mix(plain(size, colours[0]), colours[1], first * 0.9), colours[2], second * 0.9)
    return to_picture(rgb * (_threads(dice, size, 4) * 1.15)[..., None])


def _border(rgb: Field, across: Field, along: Field, colours: list[Colour]) -> Field:
    """Bands with triangles around the rug; `across` is metres from the rim, `along` metres beside it."""
    rgb = mix(rgb, colours[0], step(-across, -0.28, 0.01))
    rgb = mix(rgb, colours[1], step(-np.abs(across - 0.05), -0.018, 0.006))
    rgb = mix(rgb, colours[1], step(-np.abs(across - 0.24), -0.018, 0.006))
    teeth = step(wave(along * 6) * 0.14 + 0.075 - across, 0, 0.008) * step(across, 0.075, 0.004)
    return mix(rgb, colours[2], teeth * step(-across, -0.215, 0.004))


def rug(dice: Dice, colours: list[Colour], width_m: float, depth_m: float) -> Picture:
    """A whole knotted rug with border, medallions and a lattice field, mirrored about both axes.

    Args:
        dice: decides the motifs.
        colours: at least four: rim, lines, field, ink.
        width_m: extent along u in metres.
        depth_m: extent along v in metres.
    """
    size = (int(depth_m * 220), int(width_m * 220))
    u, v = coordinates(size)
    x, y = np.abs(u - 0.5) * np.float32(width_m), np.abs(v - 0.5) * np.float32(depth_m)
    rim_x, rim_y = np.float32(width_m / 2) - x, np.float32(depth_m / 2) - y
    pitch = dice.pick((2.5, 3.0, 4.0))
    lattice = wave(x * pitch) + wave(y * pitch)
    rgb = plain(size, colours[2])
    rgb = mix(rgb, colours[3], step(-np.abs(lattice - 1), -0.12, 0.05) * 0.8)
    rgb = mix(rgb, colours[1], step(-np.abs(lattice - 0.35), -0.15, 0.05) * 0.7)
    distance = x / np.float32(width_m * 0.33) + y / np.float32(depth_m * 0.33)
    rings = np.floor((distance + 0.06 * wave((x - y) * 5)) * 7)
    order = [dice.whole(0, len(colours) - 1) for _ in range(8)]
    for ring in range(7):
        rgb = mix(rgb, colours[order[ring]], (rings == ring).astype(np.float32))
    rgb = _border(rgb, np.minimum(rim_x, rim_y), np.where(rim_x < rim_y, y, x), colours)
    pile = 0.86 + 0.3 * (value_noise(dice, size, (size[0] // 2, size[1] // 2)) - 0.5) * 1.2
    abrash = 0.2 * (fractal(dice, size, (6, 3), 4) - 0.5)
    return to_picture(rgb * (pile + abrash)[..., None])


def bedding(dice: Dice, colours: tuple[Colour, Colour, Colour]) -> Picture:
    """A quilt of squares with printed patches, 1.2 m x 1.2 m."""
    count, side = 6, 80
    size = (count * side, count * side)
    u, v = coordinates(size)
    first, second = dice.pick(PATTERNS)(u * 2, v * 2)
    rgb = plain(size, shade(colours[0], 1.05))
    patch = ((np.floor(u * count) + np.floor(v * count)) % 2).astype(np.float32)
    rgb = mix(rgb, colours[1], patch * (0.35 + 0.6 * first))
    rgb = mix(rgb, colours[2], (1 - patch) * second * 0.7)
    seam = np.maximum(np.abs((u * count) % 1 - 0.5), np.abs((v * count) % 1 - 0.5))
    folds = 0.25 * (fractal(dice, size, (5, 5), 5, 0.7) - 0.5)
    light = _threads(dice, size, 4) * 1.1 * (1 - 0.35 * step(seam, 0.475, 0.03)) + folds
    return to_picture(rgb * light[..., None])
