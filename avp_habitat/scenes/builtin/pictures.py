"""Procedural pictures that hang, stand or are looked at through a window: paintings, views, screens, book spines."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.random import Dice
from avp_habitat.scenes.builtin.textures import (
    Colour,
    Field,
    blend,
    coordinates,
    fractal,
    mix,
    plain,
    shade,
    step,
    to_picture,
    turn_of,
    value_noise,
    wave,
)

Picture = NDArray[np.uint8]

SPINES = 31
"""Books in the picture of spines; the cell after the last one is paper."""
SPINE_COLUMNS, SPINE_ROWS = 16, 2


def _brush(dice: Dice, rgb: Field) -> Picture:
    """Give a painting canvas and brush marks."""
    size = rgb.shape[:2]
    marks = fractal(dice, size, (60, 24), 3, 0.8)
    return to_picture(rgb * (0.84 + 0.3 * marks)[..., None])


def _discs(dice: Dice, size: tuple[int, int], colours: list[Colour]) -> Field:
    u, v = coordinates(size)
    rgb = mix(plain(size, colours[0]), colours[1], v)
    for _ in range(12):
        du, dv = (u - dice.number(0.1, 0.9)) * size[1] / size[0], v - dice.number(0.1, 0.9)
        distance, radius = np.sqrt(du * du + dv * dv), dice.number(0.05, 0.28)
        shape = step(-distance, -radius, 0.01)
        if dice.chance(0.4):
            shape = step(-np.abs(distance - radius), -0.02, 0.008)
        rgb = mix(rgb, dice.pick(colours), shape * dice.number(0.55, 0.95))
    return rgb


def _blocks(dice: Dice, size: tuple[int, int], colours: list[Colour]) -> Field:
    u, v = coordinates(size)
    rgb = plain(size, blend(colours[0], (1, 1, 1), 0.6))
    for _ in range(22):
        left, top = int(dice.number(0.0, 0.9) * size[1]), int(dice.number(0.0, 0.9) * size[0])
        wide, high = int(dice.number(0.05, 0.4) * size[1]), int(dice.number(0.05, 0.4) * size[0])
        part = rgb[top : top + high, left : left + wide]
        part[...] = mix(part, dice.pick(colours), dice.number(0.5, 1.0))
    for _ in range(5):
        line = np.minimum(np.abs(u - dice.number(0.05, 0.95)), np.abs(v - dice.number(0.05, 0.95)))
        rgb = mix(rgb, (0.1, 0.1, 0.12), step(-line, -0.008, 0.006))
    return rgb


def _hills(dice: Dice, size: tuple[int, int], colours: list[Colour]) -> Field:
    u, v = coordinates(size)
    rgb = mix(plain(size, blend(colours[1], (1, 1, 1), 0.5)), blend(colours[2], (1, 0.95, 0.85), 0.6), v)
    distance = np.sqrt((u - dice.number(0.2, 0.8)) ** 2 + (v - dice.number(0.15, 0.4)) ** 2)
    rgb = mix(rgb, colours[2], step(-distance, -0.11, 0.01))
    for layer in range(6):
        ridge = 0.35 + 0.11 * layer + 0.22 * (fractal(dice, (1, size[1]), (1, 3 + layer), 4)[0] - 0.5)
        colour = blend(shade(colours[layer % len(colours)], 0.9), (0.1, 0.15, 0.2), 0.08 * layer)
        texture = fractal(dice, size, (20, 10), 3, 0.7)
        rgb = mix(rgb, plain(size, colour) * (0.7 + 0.6 * texture)[..., None], step(v - ridge, 0, 0.008))
    return rgb


def _rays(dice: Dice, size: tuple[int, int], colours: list[Colour]) -> Field:
    u, v = coordinates(size)
    bend = fractal(dice, size, (3, 3), 4)
    turn = turn_of(u - dice.number(0.2, 0.8), v - dice.number(0.2, 0.8))
    field = turn * 10 + bend * 4
    rgb = plain(size, colours[0])
    for index, colour in enumerate(colours[1:] + [(0.95, 0.92, 0.86)]):
        rgb = mix(rgb, colour, step(wave(field * (index + 1) * 0.5 + index * 0.3), 0.62, 0.05))
    return rgb


def painting(dice: Dice, colours: list[Colour], *, wide: bool) -> Picture:
    """An abstract painting or landscape in the room's colours; spans the whole canvas."""
    size = (240, 360) if wide else (320, 240)
    return _brush(dice, dice.pick((_discs, _blocks, _hills, _rays))(dice, size, colours))


def _house(dice: Dice, rgb: Field, u: Field, v: Field, left: float) -> Field:
    wide, top = dice.number(0.1, 0.2), dice.number(0.4, 0.56)
    right = left + wide
    wall = dice.pick(((0.86, 0.78, 0.66), (0.75, 0.42, 0.33), (0.88, 0.87, 0.84), (0.66, 0.7, 0.74)))
    body = ((u > left) & (u < right) & (v > top)).astype(np.float32)
    rgb = mix(rgb, wall, body)
    peak = np.abs(u - (left + right) / 2) * 0.8
    roof = ((v > top - 0.1 + peak) & (v <= top) & (u > left - 0.01) & (u < right + 0.01)).astype(np.float32)
    rgb = mix(rgb, (0.5, 0.27, 0.22), roof)
    panes = (wave((u - left) / wide * 3) > 0.45) & (wave((v - top) * 14) > 0.4)
    return mix(rgb, (0.25, 0.32, 0.4), body * panes * 0.85)


def view(dice: Dice) -> Picture:
    """What lies outside the window: sky, hills, houses and trees; spans the whole window."""
    size = (384, 512)
    u, v = coordinates(size)
    rgb = mix(plain(size, (0.62, 0.78, 0.95)), (0.95, 0.97, 1.0), np.clip(v * 1.9, 0, 1))
    rgb = mix(rgb, (1, 1, 1), np.clip(fractal(dice, size, (5, 3), 5) * 3 - 1.45, 0, 1) * (v < 0.6))
    for layer, colour in enumerate(((0.62, 0.72, 0.8), (0.5, 0.63, 0.55), (0.46, 0.6, 0.36))):
        ridge = 0.44 + 0.07 * layer + 0.14 * (fractal(dice, (1, size[1]), (1, 4), 4)[0] - 0.5)
        rough = fractal(dice, size, (30, 30), 3, 0.8)
        rgb = mix(rgb, plain(size, colour) * (0.8 + 0.4 * rough)[..., None], step(v - ridge, 0, 0.01))
    for index in range(dice.whole(2, 4)):
        rgb = _house(dice, rgb, u, v, 0.04 + 0.24 * index + dice.number(0.0, 0.05))
    bush = fractal(dice, size, (14, 20), 4, 0.8)
    for _ in range(7):
        du, dv = (u - dice.number(0.0, 1.0)) * 1.4, v - dice.number(0.68, 0.9)
        crown = np.sqrt(du * du + dv * dv) + (bush - 0.5) * 0.16
        green = plain(size, (0.3, dice.number(0.42, 0.56), 0.22)) * (0.45 + 1.1 * bush)[..., None]
        rgb = mix(rgb, green, step(-crown, -dice.number(0.08, 0.16), 0.01))
    lawn = plain(size, (0.5, 0.66, 0.34)) * (0.7 + 0.6 * fractal(dice, size, (60, 30), 3, 0.8))[..., None]
    rgb = mix(rgb, lawn, step(v, 0.86, 0.02))
    return to_picture(rgb * 0.92 + 0.08)


def screen(dice: Dice, colours: list[Colour]) -> Picture:
    """A switched-on screen with windows, text and a picture; spans the whole screen."""
    size = (216, 384)
    u, v = coordinates(size)
    rgb = _hills(dice, size, colours)
    for left, top, right, bottom in ((0.06, 0.12, 0.5, 0.8), (0.55, 0.2, 0.93, 0.6), (0.58, 0.66, 0.9, 0.9)):
        inside = (u > left) & (u < right) & (v > top) & (v < bottom)
        rgb = mix(rgb, (0.95, 0.95, 0.96), inside * np.float32(0.95))
        rgb = mix(rgb, dice.pick(colours), (inside & (v < top + 0.05)).astype(np.float32))
        words = value_noise(dice, size, (216, 60)) > 0.45
        text = inside & (v > top + 0.09) & (wave(v * 26) > 0.5) & words & (u > left + 0.03) & (u < right - 0.04)
        rgb = mix(rgb, (0.2, 0.22, 0.26), text * np.float32(0.85))
    return to_picture(rgb)


def film(dice: Dice, colours: list[Colour]) -> Picture:
    """A landscape on a television, with a line of subtitles; spans the whole screen."""
    size = (216, 384)
    u, v = coordinates(size)
    words = (value_noise(dice, size, (108, 90)) > 0.42) & (np.abs(v - 0.9) < 0.025) & (np.abs(u - 0.5) < 0.3)
    return to_picture(mix(_hills(dice, size, colours), (1, 1, 1), words.astype(np.float32)))


def keys(dice: Dice) -> Picture:
    """A keyboard with light letters; spans the whole keyboard."""
    size = (96, 288)
    u, v = coordinates(size)
    key = (wave(u * 15) > 0.16) & (wave(v * 5) > 0.18)
    letters = key & (wave(u * 15) > 0.6) & (wave(v * 5) > 0.5) & (value_noise(dice, size, (48, 96)) > 0.45)
    rgb = mix(plain(size, (0.2, 0.2, 0.22)), (0.36, 0.36, 0.39), key.astype(np.float32))
    return to_picture(mix(rgb, (0.92, 0.92, 0.9), letters.astype(np.float32)))


def spine_cell(index: int) -> tuple[float, float, float, float]:
    """Texture rectangle (u0, v0, u1, v1) of a book's spine; index `SPINES` is paper."""
    column, row = index % SPINE_COLUMNS, index // SPINE_COLUMNS
    inset = 0.04 / SPINE_COLUMNS
    left, right = column / SPINE_COLUMNS + inset, (column + 1) / SPINE_COLUMNS - inset
    return left, row / SPINE_ROWS + 0.01, right, (row + 1) / SPINE_ROWS - 0.01


def _spine(dice: Dice, size: tuple[int, int], colour: Colour) -> Field:
    u, v = coordinates(size)
    rgb = plain(size, colour) * (0.82 + 0.3 * wave(u * 0.999))[..., None]
    ink = dice.pick(((0.95, 0.9, 0.75), (0.1, 0.1, 0.1), (0.85, 0.7, 0.3), shade(colour, 1.8)))
    top = dice.number(0.08, 0.3)
    for place in (top, top + 0.05, dice.number(0.7, 0.9)):
        rgb = mix(rgb, ink, step(-np.abs(v - place), -0.012, 0.01))
    letters = value_noise(dice, size, (size[0] // 5, 4)) > 0.5
    title = letters & (np.abs(u - 0.5) < dice.number(0.18, 0.32)) & (v > top + 0.1) & (v < 0.66)
    return mix(rgb, ink, title.astype(np.float32) * 0.9)


def spines(dice: Dice, colours: list[Colour]) -> Picture:
    """Spines of `SPINES` books and, in the last cell, the paper of their pages."""
    side, high = 32, 200
    rgb = np.empty((high * SPINE_ROWS, side * SPINE_COLUMNS, 3), np.float32)
    common = [(0.55, 0.16, 0.14), (0.14, 0.26, 0.42), (0.16, 0.36, 0.26), (0.88, 0.84, 0.74), (0.2, 0.2, 0.22)]
    for index in range(SPINES + 1):
        row, column = divmod(index, SPINE_COLUMNS)
        colour = shade(dice.pick(colours + common), dice.number(0.75, 1.2))
        cell = _spine(dice, (high, side), colour)
        if index == SPINES:
            lines = fractal(dice, (high, side), (4, 16), 2, 0.9)
            cell = plain((high, side), (0.93, 0.89, 0.8)) * (0.75 + 0.4 * lines)[..., None]
        rgb[row * high : row * high + high, column * side : column * side + side] = cell
    return to_picture(rgb)
