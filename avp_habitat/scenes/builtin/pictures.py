"""Procedural pictures of cloth, and of what hangs, stands or is seen through a window: paintings, screens, books."""

import numpy as np

from avp_habitat.scenes.builtin.noise import (
    Colour,
    Field,
    Picture,
    Random,
    Size,
    blend,
    cosine_of_multiple,
    fractal,
    grid,
    mix,
    plain,
    shade,
    step,
    to_picture,
    turn_of,
    value_noise,
    wave,
)

SPINES = 31
"""Books in the picture of spines; the cell after the last one is paper."""
SPINE_COLUMNS, SPINE_ROWS = 16, 2


def _brush(rng: Random, rgb: Field) -> Picture:
    """Give a painting canvas and brush marks."""
    size = rgb.shape[:2]
    marks = fractal(rng, size, (60, 24), 3, 0.8)
    return to_picture(rgb * (0.84 + 0.3 * marks)[..., None])


def _discs(rng: Random, size: Size, colours: list[Colour]) -> Field:
    _, u, v = grid(*size)
    rgb = mix(plain(size, colours[0]), colours[1], v)
    for _ in range(12):
        du, dv = (u - rng.uniform(0.1, 0.9)) * size[1] / size[0], v - rng.uniform(0.1, 0.9)
        distance, radius = np.sqrt(du * du + dv * dv), rng.uniform(0.05, 0.28)
        shape = step(-distance, -radius, 0.01)
        if rng.chance(0.4):
            shape = step(-np.abs(distance - radius), -0.02, 0.008)
        rgb = mix(rgb, rng.choice(colours), shape * rng.uniform(0.55, 0.95))
    return rgb


def _blocks(rng: Random, size: Size, colours: list[Colour]) -> Field:
    _, u, v = grid(*size)
    rgb = plain(size, blend(colours[0], (1, 1, 1), 0.6))
    for _ in range(22):
        left, top = int(rng.uniform(0.0, 0.9) * size[1]), int(rng.uniform(0.0, 0.9) * size[0])
        wide, high = int(rng.uniform(0.05, 0.4) * size[1]), int(rng.uniform(0.05, 0.4) * size[0])
        part = rgb[top : top + high, left : left + wide]
        part[...] = mix(part, rng.choice(colours), rng.uniform(0.5, 1.0))
    for _ in range(5):
        line = np.minimum(np.abs(u - rng.uniform(0.05, 0.95)), np.abs(v - rng.uniform(0.05, 0.95)))
        rgb = mix(rgb, (0.1, 0.1, 0.12), step(-line, -0.008, 0.006))
    return rgb


def _hills(rng: Random, size: Size, colours: list[Colour]) -> Field:
    _, u, v = grid(*size)
    rgb = mix(plain(size, blend(colours[1], (1, 1, 1), 0.5)), blend(colours[2], (1, 0.95, 0.85), 0.6), v)
    distance = np.sqrt((u - rng.uniform(0.2, 0.8)) ** 2 + (v - rng.uniform(0.15, 0.4)) ** 2)
    rgb = mix(rgb, colours[2], step(-distance, -0.11, 0.01))
    for layer in range(6):
        ridge = 0.35 + 0.11 * layer + 0.22 * (fractal(rng, (1, size[1]), (1, 3 + layer), 4)[0] - 0.5)
        colour = blend(shade(colours[layer % len(colours)], 0.9), (0.1, 0.15, 0.2), 0.08 * layer)
        texture = fractal(rng, size, (20, 10), 3, 0.7)
        rgb = mix(rgb, plain(size, colour) * (0.7 + 0.6 * texture)[..., None], step(v - ridge, 0, 0.008))
    return rgb


def _rays(rng: Random, size: Size, colours: list[Colour]) -> Field:
    _, u, v = grid(*size)
    bend = fractal(rng, size, (3, 3), 4)
    turn = turn_of(u - rng.uniform(0.2, 0.8), v - rng.uniform(0.2, 0.8))
    field = turn * 10 + bend * 4
    rgb = plain(size, colours[0])
    for index, colour in enumerate(colours[1:] + [(0.95, 0.92, 0.86)]):
        rgb = mix(rgb, colour, step(wave(field * (index + 1) * 0.5 + index * 0.3), 0.62, 0.05))
    return rgb


def painting(rng: Random, colours: list[Colour], *, wide: bool) -> Picture:
    """An abstract painting or landscape in the room's colours; spans the whole canvas."""
    size = (240, 360) if wide else (320, 240)
    return _brush(rng, rng.choice((_discs, _blocks, _hills, _rays))(rng, size, colours))


def _house(rng: Random, rgb: Field, u: Field, v: Field, left: float) -> Field:
    wide, top = rng.uniform(0.1, 0.2), rng.uniform(0.4, 0.56)
    right = left + wide
    wall = rng.choice(((0.86, 0.78, 0.66), (0.75, 0.42, 0.33), (0.88, 0.87, 0.84), (0.66, 0.7, 0.74)))
    body = ((u > left) & (u < right) & (v > top)).astype(np.float32)
    rgb = mix(rgb, wall, body)
    peak = np.abs(u - (left + right) / 2) * 0.8
    roof = ((v > top - 0.1 + peak) & (v <= top) & (u > left - 0.01) & (u < right + 0.01)).astype(np.float32)
    rgb = mix(rgb, (0.5, 0.27, 0.22), roof)
    panes = (wave((u - left) / wide * 3) > 0.45) & (wave((v - top) * 14) > 0.4)
    return mix(rgb, (0.25, 0.32, 0.4), body * panes * 0.85)


def view(rng: Random) -> Picture:
    """What lies outside the window: sky, hills, houses and trees; spans the whole window."""
    size, u, v = grid(384, 512)
    rgb = mix(plain(size, (0.62, 0.78, 0.95)), (0.95, 0.97, 1.0), np.clip(v * 1.9, 0, 1))
    rgb = mix(rgb, (1, 1, 1), np.clip(fractal(rng, size, (5, 3), 5) * 3 - 1.45, 0, 1) * (v < 0.6))
    for layer, colour in enumerate(((0.62, 0.72, 0.8), (0.5, 0.63, 0.55), (0.46, 0.6, 0.36))):
        ridge = 0.44 + 0.07 * layer + 0.14 * (fractal(rng, (1, size[1]), (1, 4), 4)[0] - 0.5)
        rough = fractal(rng, size, (30, 30), 3, 0.8)
        rgb = mix(rgb, plain(size, colour) * (0.8 + 0.4 * rough)[..., None], step(v - ridge, 0, 0.01))
    for index in range(rng.integer(2, 4)):
        rgb = _house(rng, rgb, u, v, 0.04 + 0.24 * index + rng.uniform(0.0, 0.05))
    bush = fractal(rng, size, (14, 20), 4, 0.8)
    for _ in range(7):
        du, dv = (u - rng.uniform(0.0, 1.0)) * 1.4, v - rng.uniform(0.68, 0.9)
        crown = np.sqrt(du * du + dv * dv) + (bush - 0.5) * 0.16
        green = plain(size, (0.3, rng.uniform(0.42, 0.56), 0.22)) * (0.45 + 1.1 * bush)[..., None]
        rgb = mix(rgb, green, step(-crown, -rng.uniform(0.08, 0.16), 0.01))
    lawn = plain(size, (0.5, 0.66, 0.34)) * (0.7 + 0.6 * fractal(rng, size, (60, 30), 3, 0.8))[..., None]
    rgb = mix(rgb, lawn, step(v, 0.86, 0.02))
    return to_picture(rgb * 0.92 + 0.08)


def screen(rng: Random, colours: list[Colour]) -> Picture:
    """A switched-on screen with windows, text and a picture; spans the whole screen."""
    size, u, v = grid(216, 384)
    rgb = _hills(rng, size, colours)
    for left, top, right, bottom in ((0.06, 0.12, 0.5, 0.8), (0.55, 0.2, 0.93, 0.6), (0.58, 0.66, 0.9, 0.9)):
        inside = (u > left) & (u < right) & (v > top) & (v < bottom)
        rgb = mix(rgb, (0.95, 0.95, 0.96), inside * np.float32(0.95))
        rgb = mix(rgb, rng.choice(colours), (inside & (v < top + 0.05)).astype(np.float32))
        words = value_noise(rng, size, (216, 60)) > 0.45
        text = inside & (v > top + 0.09) & (wave(v * 26) > 0.5) & words & (u > left + 0.03) & (u < right - 0.04)
        rgb = mix(rgb, (0.2, 0.22, 0.26), text * np.float32(0.85))
    return to_picture(rgb)


def film(rng: Random, colours: list[Colour]) -> Picture:
    """A landscape on a television, with a line of subtitles; spans the whole screen."""
    size, u, v = grid(216, 384)
    words = (value_noise(rng, size, (108, 90)) > 0.42) & (np.abs(v - 0.9) < 0.025) & (np.abs(u - 0.5) < 0.3)
    return to_picture(mix(_hills(rng, size, colours), (1, 1, 1), words.astype(np.float32)))


def keys(rng: Random) -> Picture:
    """A keyboard with light letters; spans the whole keyboard."""
    size, u, v = grid(96, 288)
    key = (wave(u * 15) > 0.16) & (wave(v * 5) > 0.18)
    letters = key & (wave(u * 15) > 0.6) & (wave(v * 5) > 0.5) & (value_noise(rng, size, (48, 96)) > 0.45)
    rgb = mix(plain(size, (0.2, 0.2, 0.22)), (0.36, 0.36, 0.39), key.astype(np.float32))
    return to_picture(mix(rgb, (0.92, 0.92, 0.9), letters.astype(np.float32)))


def spine_cell(index: int) -> tuple[float, float, float, float]:
    """Texture rectangle (u0, v0, u1, v1) of a book's spine; index `SPINES` is paper."""
    column, row = index % SPINE_COLUMNS, index // SPINE_COLUMNS
    inset = 0.04 / SPINE_COLUMNS
    left, right = column / SPINE_COLUMNS + inset, (column + 1) / SPINE_COLUMNS - inset
    return left, row / SPINE_ROWS + 0.01, right, (row + 1) / SPINE_ROWS - 0.01


def _spine(rng: Random, size: Size, colour: Colour) -> Field:
    _, u, v = grid(*size)
    rgb = plain(size, colour) * (0.82 + 0.3 * wave(u * 0.999))[..., None]
    ink = rng.choice(((0.95, 0.9, 0.75), (0.1, 0.1, 0.1), (0.85, 0.7, 0.3), shade(colour, 1.8)))
    top = rng.uniform(0.08, 0.3)
    for place in (top, top + 0.05, rng.uniform(0.7, 0.9)):
        rgb = mix(rgb, ink, step(-np.abs(v - place), -0.012, 0.01))
    letters = value_noise(rng, size, (size[0] // 5, 4)) > 0.5
    title = letters & (np.abs(u - 0.5) < rng.uniform(0.18, 0.32)) & (v > top + 0.1) & (v < 0.66)
    return mix(rgb, ink, title.astype(np.float32) * 0.9)


def spines(rng: Random, colours: list[Colour]) -> Picture:
    """Spines of `SPINES` books and, in the last cell, the paper of their pages."""
    side, high = 32, 200
    rgb = np.empty((high * SPINE_ROWS, side * SPINE_COLUMNS, 3), np.float32)
    common = [(0.55, 0.16, 0.14), (0.14, 0.26, 0.42), (0.16, 0.36, 0.26), (0.88, 0.84, 0.74), (0.2, 0.2, 0.22)]
    for index in range(SPINES + 1):
        row, column = divmod(index, SPINE_COLUMNS)
        colour = shade(rng.choice(colours + common), rng.uniform(0.75, 1.2))
        cell = _spine(rng, (high, side), colour)
        if index == SPINES:
            lines = fractal(rng, (high, side), (4, 16), 2, 0.9)
            cell = plain((high, side), (0.93, 0.89, 0.8)) * (0.75 + 0.4 * lines)[..., None]
        rgb[row * high : row * high + high, column * side : column * side + side] = cell
    return to_picture(rgb)


def _threads(rng: Random, size: Size, pitch: int) -> Field:
    """`(height, width)` light of a plain weave with `pitch` pixels per thread and uneven yarn."""
    _, u, v = grid(*size)
    across, down = size[1] // pitch, size[0] // pitch
    column, row = np.floor(u * across), np.floor(v * down)
    over = (column + row) % 2
    bump = np.where(over > 0, wave(u * across), wave(v * down))
    yarn = np.where(over > 0, value_noise(rng, size, (12, across)), value_noise(rng, size, (down, 12)))
    return 0.76 + 0.2 * bump + 0.26 * (yarn - 0.5) + 0.18 * (fractal(rng, size, (6, 6), 5, 0.8) - 0.5)


def weave(rng: Random, colour: Colour, second: Colour) -> Picture:
    """Coarse upholstery of two yarns with slubs, 0.6 m x 0.6 m."""
    size = (320, 320)
    slubs = step(value_noise(rng, size, (20, 80)), 0.8, 0.1) + step(value_noise(rng, size, (80, 20)), 0.82, 0.1)
    rgb = mix(plain(size, colour), second, np.clip(slubs, 0, 1) * 0.45)
    for cells, share in ((16, 0.1), (34, 0.13)):
        rgb = mix(rgb, second, step(value_noise(rng, size, (cells, cells)), 1 - share, 0.06) * 0.6)
        rgb = mix(rgb, shade(colour, 0.55), step(value_noise(rng, size, (cells, cells)), 1 - share, 0.06) * 0.5)
    return to_picture(rgb * (_threads(rng, size, 5) * 1.12)[..., None])


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


def printed(rng: Random, colours: list[Colour]) -> Picture:
    """Cloth of three colours with one of several repeating patterns, 0.6 m x 0.6 m."""
    size, u, v = grid(320, 320)
    first, second = rng.choice(PATTERNS)(u, v)
    rgb = mix(mix(plain(size, colours[0]), colours[1], first * 0.9), colours[2], second * 0.9)
    return to_picture(rgb * (_threads(rng, size, 4) * 1.15)[..., None])


def _border(rgb: Field, across: Field, along: Field, colours: list[Colour]) -> Field:
    """Bands with triangles around the rug; `across` is metres from the rim, `along` metres beside it."""
    rgb = mix(rgb, colours[0], step(-across, -0.28, 0.01))
    rgb = mix(rgb, colours[1], step(-np.abs(across - 0.05), -0.018, 0.006))
    rgb = mix(rgb, colours[1], step(-np.abs(across - 0.24), -0.018, 0.006))
    teeth = step(wave(along * 6) * 0.14 + 0.075 - across, 0, 0.008) * step(across, 0.075, 0.004)
    return mix(rgb, colours[2], teeth * step(-across, -0.215, 0.004))


def rug(rng: Random, colours: list[Colour], width_m: float, depth_m: float) -> Picture:
    """A whole knotted rug with border, medallions and a lattice field, mirrored about both axes.

    The first four colours are those of rim, lines, field and ink; the width is along u.
    """
    size = (int(depth_m * 220), int(width_m * 220))
    _, u, v = grid(*size)
    x, y = np.abs(u - 0.5) * np.float32(width_m), np.abs(v - 0.5) * np.float32(depth_m)
    rim_x, rim_y = np.float32(width_m / 2) - x, np.float32(depth_m / 2) - y
    pitch = rng.choice((2.5, 3.0, 4.0))
    lattice = wave(x * pitch) + wave(y * pitch)
    rgb = plain(size, colours[2])
    rgb = mix(rgb, colours[3], step(-np.abs(lattice - 1), -0.12, 0.05) * 0.8)
    rgb = mix(rgb, colours[1], step(-np.abs(lattice - 0.35), -0.15, 0.05) * 0.7)
    distance = x / np.float32(width_m * 0.33) + y / np.float32(depth_m * 0.33)
    rings = np.floor((distance + 0.06 * wave((x - y) * 5)) * 7)
    order = [rng.integer(0, len(colours) - 1) for _ in range(8)]
    for ring in range(7):
        rgb = mix(rgb, colours[order[ring]], (rings == ring).astype(np.float32))
    rgb = _border(rgb, np.minimum(rim_x, rim_y), np.where(rim_x < rim_y, y, x), colours)
    pile = 0.86 + 0.3 * (value_noise(rng, size, (size[0] // 2, size[1] // 2)) - 0.5) * 1.2
    abrash = 0.2 * (fractal(rng, size, (6, 3), 4) - 0.5)
    return to_picture(rgb * (pile + abrash)[..., None])


def bedding(rng: Random, colours: list[Colour]) -> Picture:
    """A quilt of squares with printed patches, 1.2 m x 1.2 m."""
    count, side = 6, 80
    size, u, v = grid(count * side, count * side)
    first, second = rng.choice(PATTERNS)(u * 2, v * 2)
    rgb = plain(size, shade(colours[0], 1.05))
    patch = ((np.floor(u * count) + np.floor(v * count)) % 2).astype(np.float32)
    rgb = mix(rgb, colours[1], patch * (0.35 + 0.6 * first))
    rgb = mix(rgb, colours[2], (1 - patch) * second * 0.7)
    seam = np.maximum(np.abs((u * count) % 1 - 0.5), np.abs((v * count) % 1 - 0.5))
    folds = 0.25 * (fractal(rng, size, (5, 5), 5, 0.7) - 0.5)
    light = _threads(rng, size, 4) * 1.1 * (1 - 0.35 * step(seam, 0.475, 0.03)) + folds
    return to_picture(rgb * light[..., None])
