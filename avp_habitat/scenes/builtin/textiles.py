"""Procedural pictures of woven and printed cloth: upholstery, cushions, curtains, bedding, rugs."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.noise import (
    Colour,
    Field,
    coordinates,
    cosine_of_multiple,
    fractal,
    mix,
    plain,
    shade,
    step,
    to_picture,
    value_noise,
    wave,
)

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
