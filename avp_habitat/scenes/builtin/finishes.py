"""Procedural pictures of what rooms and furniture are finished with: wood, boards, tiles, plaster, paper, brick."""

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
    value_noise,
    wave,
)


def _grain(rng: Random, size: Size, rings: float) -> Field:
    """`(height, width)` darkness of wood fibres that run along u, in [0, 1]."""
    _, _, v = grid(*size)
    bend = fractal(rng, size, (5, 2), 3)
    ring = wave(v * np.float32(rings) + bend * 5)
    fibre = value_noise(rng, size, (size[0] // 2, 6))
    pores = step(value_noise(rng, size, (size[0] // 2, 40)), 0.82, 0.12)
    return 0.45 * ring * ring + 0.35 * fibre + 0.35 * pores + 0.15 * fractal(rng, size, (24, 6), 2)


def _ticks(rng: Random, size: Size) -> Field:
    """`(height, width)` short dark strokes along u, as the rays of oak, 1 inside."""
    return step(value_noise(rng, size, (size[0] // 5, size[1] // 22)), 0.93, 0.06)


def wood(rng: Random, colour: Colour) -> Picture:
    """A wooden face of 1.2 m x 0.6 m, grain along u, with a few knots."""
    size, u, v = grid(256, 512)
    dark = _grain(rng, size, 14) * 0.9
    for index in range(14):
        spread = 0.2 if index < 4 else 0.07
        du = (u - rng.uniform(0.05, 0.95)) * 2.2
        dv = (v - rng.uniform(0.05, 0.95)) * 3.2
        distance = np.sqrt(du * du + dv * dv)
        near = np.clip(1 - distance / spread, 0, 1)
        dark = dark + near * (0.5 + 0.4 * wave(distance * 28)) + step(-distance, -spread * 0.2, 0.01) * 0.3
    rgb = mix(plain(size, shade(colour, 1.2)), shade(colour, 0.5), np.clip(dark, 0, 1))
    rgb = mix(rgb, shade(colour, 1.6), _ticks(rng, size) * 0.5)
    return to_picture(mix(rgb, shade(colour, 0.36), _ticks(rng, size) * 0.7))


def boards(rng: Random, colour: Colour, rows: int = 12) -> Picture:
    """A floor of staggered boards along u, 2.0 m x 1.67 m; every board has its own tone and grain."""
    size = (rows * 50, 720)
    _, u, _ = grid(*size)
    dark = _grain(rng, size, rows * 3)
    tone = np.ones(size, np.float32)
    gap = np.zeros(size, np.float32)
    for row in range(rows):
        band = slice(row * 50, row * 50 + 50)
        dark[band] = np.roll(dark[band], rng.integer(0, size[1]), axis=1)
        start = rng.uniform(0.0, 0.5)
        for begin, end in ((start, start + 0.45), (start + 0.45, start + 1.0)):
            inside = ((u[band] - np.float32(begin)) % 1) < np.float32(end - begin)
            tone[band] = np.where(inside, np.float32(rng.uniform(0.78, 1.14)), tone[band])
            gap[band] = np.maximum(gap[band], np.abs((u[band] - np.float32(begin) + 0.5) % 1 - 0.5) < 1.6 / 720)
        gap[band.start : band.start + 2] = 1
    rgb = mix(plain(size, shade(colour, 1.08)), shade(colour, 0.55), np.clip(dark, 0, 1)) * tone[..., None]
    rgb = mix(rgb, shade(colour, 0.3), np.maximum(_ticks(rng, size), _knots(rng, size, 40)) * 0.85)
    rgb = mix(rgb, shade(colour, 1.35), _ticks(rng, size) * 0.6)
    return to_picture(mix(rgb, shade(colour, 0.28), gap * 0.85))


def _knots(rng: Random, size: Size, count: int) -> Field:
    """`(height, width)` round knots of 1 to 2 cm with rings, 1 in their middle, for boards of 300 pixels a metre."""
    field = np.zeros(size, np.float32)
    y, x = np.mgrid[-12:13, -16:17].astype(np.float32)
    for _ in range(count):
        distance = np.sqrt((x / rng.uniform(1.0, 2.0)) ** 2 + y**2) / rng.uniform(3.0, 6.0)
        top, left = rng.integer(0, size[0] - 25), rng.integer(0, size[1] - 33)
        part = field[top : top + 25, left : left + 33]
        np.maximum(part, np.clip(1.6 - distance, 0, 1) * (0.6 + 0.4 * wave(distance * 2)), out=part)
    return field


def parquet(rng: Random, colour: Colour) -> Picture:
    """A floor of square blocks of five strips that alternate in direction, 1.6 m x 1.6 m, 8 x 8 blocks of 80 px."""
    cells, side, strips = 8, 80, 5
    size = (cells * side, cells * side)
    dark = _grain(rng, size, 40)
    rgb = np.empty((*size, 3), np.float32)
    along = np.arange(side)
    for row in range(cells):
        for column in range(cells):
            top, left = rng.integer(0, size[0] - side), rng.integer(0, size[1] - side)
            tones = np.array([rng.uniform(0.78, 1.15) for _ in range(strips)], np.float32)
            block = mix(plain((side, side), shade(colour, 1.08)), shade(colour, 0.55), dark[top:, left:][:side, :side])
            block *= tones[along * strips // side][:, None, None]
            block[along % (side // strips) == 0] *= 0.55
            block[:, :2] *= 0.6
            turned = (row + column) % 2 == 1
            rgb[row * side :, column * side :][:side, :side] = block.transpose(1, 0, 2) if turned else block
    return to_picture(mix(rgb, shade(colour, 0.3), _knots(rng, size, 30) * 0.85))


def paint(rng: Random, colour: Colour) -> Picture:
    """Brushed paint on wood, strokes along u, 1.2 m x 0.6 m."""
    size = (192, 384)
    strokes = fractal(rng, size, (64, 5), 2, 0.8)
    chips = step(value_noise(rng, size, (64, 128)), 0.93, 0.05)
    light = 0.94 + 0.12 * (strokes - 0.5) + 0.08 * (fractal(rng, size, (6, 6), 4) - 0.5) - 0.1 * chips
    light = light - 0.12 * flakes(rng, size, 24, 0.13) - 0.12 * flakes(rng, size, 50, 0.13)
    return to_picture(plain(size, colour) * light[..., None])


def marble(rng: Random, colour: Colour, vein: Colour) -> Picture:
    """A polished slab with veins, 1.2 m x 1.2 m."""
    size, u, v = grid(384, 384)
    cloud = fractal(rng, size, (3, 3), 5)
    lines = wave(u * 2 + v + cloud * 4)
    fine = wave(u - v * 2 + fractal(rng, size, (4, 4), 5) * 5)
    rgb = mix(plain(size, colour), vein, np.clip(1 - lines * 9, 0, 1) * 0.8)
    rgb = mix(rgb, vein, np.clip(1 - fine * 16, 0, 1) * 0.55)
    return to_picture(rgb * (0.88 + 0.2 * cloud)[..., None])


def _tile_motif(u: Field, v: Field, kind: int) -> Field:
    """Share of ink of one encaustic tile; u, v in [-1, 1]."""
    x, y = np.abs(u), np.abs(v)
    radius = np.sqrt(u * u + v * v)
    corner = np.sqrt((1 - x) * (1 - x) + (1 - y) * (1 - y))
    if kind == 0:
        petals = radius - (0.55 + 0.3 * cosine_of_multiple(u, v, 8))
        return np.maximum(step(-petals, 0, 0.05), step(-np.abs(corner - 0.45), -0.07, 0.04))
    if kind == 1:
        star = np.minimum(x + y, np.maximum(x, y) * np.float32(1.41)) - 0.62
        return np.maximum(step(-np.abs(star), -0.09, 0.04), step(-corner, -0.38, 0.04))
    lattice = np.minimum(np.abs(x - y), np.abs(x + y - 1))
    return np.maximum(step(-lattice, -0.1, 0.04), step(-radius, -0.3, 0.04))


def tiles(rng: Random, colour: Colour, ink: Colour, *, patterned: bool) -> Picture:
    """A floor of 6 x 6 tiles of 0.25 m with joints, 1.5 m x 1.5 m; encaustic motifs when patterned."""
    count, side = 6, 96
    size, u, v = grid(count * side, count * side)
    local_u, local_v = (u * count) % 1 * 2 - 1, (v * count) % 1 * 2 - 1
    tone = rng.array((count, count)) * np.float32(0.2) + np.float32(0.86)
    rgb = plain(size, colour)
    if patterned:
        rgb = mix(rgb, ink, _tile_motif(local_u, local_v, rng.integer(0, 2)) * 0.85)
    rgb = mix(rgb, shade(colour, 0.62), np.clip(fractal(rng, size, (9, 9), 5, 0.7) * 2.4 - 0.9, 0, 1) * 0.45)
    for cells, amount in ((20, 0.3), (48, 0.5)):
        rgb = mix(rgb, shade(colour, 0.5), flakes(rng, size, cells, 0.18) * amount)
        rgb = mix(rgb, shade(colour, 1.35), flakes(rng, size, cells, 0.16) * amount)
    rgb *= np.kron(tone, np.ones((side, side), np.float32))[..., None]
    joint = step(np.maximum(np.abs(local_u), np.abs(local_v)), 0.965, 0.015)
    return to_picture(mix(rgb, shade(blend(colour, (0.5, 0.5, 0.5), 0.5), 0.75), joint))


def flakes(rng: Random, size: Size, cells: int, share: float) -> Field:
    """`(height, width)` islands with clear edges, about `cells` to a side, 1 inside; `share` of them are drawn.

    They are what a camera recognises from two places: distinct, irregular, of several sizes.
    """
    return step(value_noise(rng, size, (cells, cells)) + 0.12 * value_noise(rng, size, (96, 96)), 1.06 - share, 0.05)


def plaster(rng: Random, colour: Colour) -> Picture:
    """A painted wall with trowel strokes and flakes of lighter and darker paint, 1.8 m x 1.8 m."""
    size = (512, 512)
    broad = fractal(rng, size, (4, 4), 4)
    strokes = fractal(rng, size, (40, 10), 3, 0.7)
    light = 0.95 + 0.07 * (broad - 0.5) + 0.1 * (strokes - 0.5)
    for cells, dark, pale in ((14, 0.05, 0.04), (32, 0.09, 0.05), (70, 0.13, 0.05)):
        light = light - dark * flakes(rng, size, cells, 0.16) + pale * flakes(rng, size, cells, 0.16)
    return to_picture(plain(size, colour) * light[..., None])


def _motif(u: Field, v: Field, kind: int) -> Field:
    """Share of ink of one wallpaper motif; u, v in [-1, 1]."""
    radius = np.sqrt(u * u + v * v)
    if kind == 0:
        petals = step(-radius + 0.5 + 0.28 * cosine_of_multiple(u, v, 5), 0, 0.05) * step(radius, 0.16, 0.05)
        return np.maximum(petals, step(-radius, -0.1, 0.04))
    if kind == 1:
        leaf = step(-np.abs(u) + 0.42 * (1 - v * v) * (1 - 0.45 * v), 0, 0.05) * step(-np.abs(v), -0.9, 0.05)
        return leaf * (1 - 0.8 * step(-np.abs(wave(v * 3 - np.abs(u) * 2) - 0.5), -0.08, 0.05))
    if kind == 2:
        return step(-np.abs(np.abs(u) + np.abs(v) - 0.75), -0.09, 0.05) + step(-(np.abs(u) + np.abs(v)), -0.3, 0.05)
    fan = step(-np.abs(wave(radius * 2.5) - 0.5), -0.2, 0.08) * step(-radius, -0.98, 0.04)
    return np.maximum(fan, step(-radius, -0.34, 0.05)) * step(-v, -0.05, 0.05)


def wallpaper(rng: Random, colour: Colour, ink: Colour) -> Picture:
    """Printed wallpaper of half-drop motifs in two inks on textured paper, 1.2 m x 1.2 m."""
    size, u, v = grid(512, 512)
    repeats, kind = rng.choice((4, 6)), rng.integer(0, 3)
    rgb = plain(size, colour)
    for turn, share in ((0.0, 0.75), (0.5, 0.45)):
        column = np.floor(u * repeats + np.float32(turn))
        local_u = (u * repeats + np.float32(turn)) % 1 * 2 - 1
        local_v = (v * repeats + np.float32(0.5) * (column % 2) + np.float32(turn)) % 1 * 2 - 1
        scale = 1.25 if turn == 0 else 2.2
        inside = (np.abs(local_u * scale) < 1) & (np.abs(local_v * scale) < 1)
        drawn = np.clip(_motif(local_u * scale, local_v * scale, (kind + int(turn * 2)) % 4), 0, 1) * inside
        rgb = mix(rgb, ink, drawn * share)
    paper = 0.95 + 0.12 * (fractal(rng, size, (60, 24), 3, 0.8) - 0.5) + 0.1 * (fractal(rng, size, (5, 5), 3) - 0.5)
    for cells, dark in ((34, 0.12), (60, 0.14)):
        paper = paper - dark * flakes(rng, size, cells, 0.14)
    return to_picture(rgb * paper[..., None])


def brick(rng: Random, colour: Colour) -> Picture:
    """A wall of bricks in running bond, 16 courses of 75 mm, 1.25 m x 1.2 m."""
    courses, across, side = 16, 5, 32
    size, u, v = grid(courses * side, 540)
    course = np.floor(v * courses)
    shifted = u * across + np.float32(0.5) * (course % 2)
    local_u, local_v = shifted % 1, (v * courses) % 1
    tones = rng.array((courses, across)) * np.float32(0.45) + np.float32(0.72)
    tone = tones[course.astype(int), np.floor(shifted).astype(int) % across]
    rough = fractal(rng, size, (40, 24), 4, 0.8)
    rgb = plain(size, colour) * (tone * (0.72 + 0.5 * rough))[..., None]
    edge = np.minimum(np.minimum(local_u, 1 - local_u) * 250, np.minimum(local_v, 1 - local_v) * 75)
    mortar = step(-edge + (rough - 0.5) * 6, -5.0, 2.0)
    return to_picture(mix(rgb, blend(colour, (0.78, 0.76, 0.72), 0.85), mortar * 0.9))


def speckled(rng: Random, colour: Colour, fleck: Colour) -> Picture:
    """Glazed ceramic, terrazzo or lacquer with flecks, 0.4 m x 0.4 m."""
    size = (192, 192)
    cloud = fractal(rng, size, (5, 5), 4)
    flecks = step(value_noise(rng, size, (48, 48)), 0.8, 0.06)
    rgb = mix(plain(size, colour), fleck, flecks * 0.75)
    return to_picture(rgb * (0.88 + 0.22 * cloud)[..., None])


def brushed(rng: Random, colour: Colour) -> Picture:
    """Brushed metal, strokes along u, 0.4 m x 0.4 m."""
    size = (128, 128)
    strokes = fractal(rng, size, (64, 4), 2, 0.8)
    return to_picture(plain(size, colour) * (0.75 + 0.5 * strokes)[..., None])


def wicker(rng: Random, colour: Colour) -> Picture:
    """Basket weave, 0.3 m x 0.3 m."""
    size, u, v = grid(192, 192)
    row = np.floor(v * 16)
    strand = wave(u * 6 + np.float32(0.5) * (row % 2))
    round_ = wave(v * 16)
    light = 0.35 + 0.5 * strand * np.sqrt(round_) + 0.25 * fractal(rng, size, (32, 12), 2)
    return to_picture(plain(size, colour) * light[..., None])


def foliage(rng: Random, colour: Colour) -> Picture:
    """A leaf: midrib along v, side veins, blotches; spans one leaf."""
    size, u, v = grid(160, 96)
    across = np.abs(u - 0.5) * 2
    veins = np.clip(1 - wave(v * 8 - across * 1.6) * 5, 0, 1) * 0.5
    rib = step(-across, -0.08, 0.05)
    rgb = mix(plain(size, shade(colour, 0.8)), shade(colour, 1.5), fractal(rng, size, (6, 4), 4))
    return to_picture(mix(rgb, blend(colour, (0.85, 0.9, 0.6), 0.6), np.maximum(veins, rib) * 0.8))
