"""Top-down pictures of an episode: navigable cells, what was observed, the path and where the agent looked."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import heading
from avp_habitat.task.trajectory import Trajectory

_BACKGROUND = (248, 248, 246)
_UNSEEN = (205, 208, 214)
_SEEN_FIRST, _SEEN_LAST = np.array([49, 104, 142]), np.array([181, 222, 143])
_PATH = (178, 34, 52)
_LOOK = (228, 120, 51)
_INK = (40, 40, 44)
_CAPTION = 46
_MARGIN = 14
_MIN_WIDTH = 440
_LEGEND = (
    "white dot: start    red dot: end    red: path    orange: view    blue to green: first to last seen    grey: unseen"
)


def draw_trajectory(area: NavigableArea, trajectory: Trajectory, *, longest_px: int = 720) -> NDArray[np.uint8]:
    """`(h, w, 3)` picture of an episode, also one that still runs, from above; +X is right, +Z is down.

    The longer side of the map has about `longest_px` pixels; a scale bar gives the metres.
    """
    rows, columns = area.mask.shape
    scale = max(1, round(longest_px / max(rows, columns)))
    cells = _cell_colours(area, trajectory).repeat(scale, axis=0).repeat(scale, axis=1)
    width = max(_MIN_WIDTH, columns * scale + 2 * _MARGIN)
    canvas = Image.new("RGB", (width, rows * scale + _CAPTION + _MARGIN), _BACKGROUND)
    left = (width - columns * scale) // 2
    canvas.paste(Image.fromarray(cells), (left, _CAPTION))
    pixels_per_metre = scale / area.cell_m
    corner = np.array([left, _CAPTION]) - np.asarray(area.origin) * pixels_per_metre

    draw = ImageDraw.Draw(canvas)
    _draw_path(draw, trajectory, corner, pixels_per_metre)
    _draw_caption(draw, trajectory, pixels_per_metre, width)
    return np.asarray(canvas)


def beside(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two `(h, w, 3)` pictures next to each other, the right one scaled to the left one's height."""
    height = left.shape[0]
    width = max(1, round(right.shape[1] * height / right.shape[0]))
    scaled = Image.fromarray(right).resize((width, height), Image.Resampling.LANCZOS)
    return np.concatenate([left, np.asarray(scaled)], axis=1)


def _cell_colours(area: NavigableArea, trajectory: Trajectory) -> NDArray[np.uint8]:
    """`(rows, cols, 3)`: grey where nothing was seen, else from blue (first view) to green (last view)."""
    colours = np.full((*area.mask.shape, 3), _BACKGROUND, dtype=np.uint8)
    seen = trajectory.first_seen.astype(np.float64)
    share = (seen - 1)[:, None] / max(1, len(trajectory.action) - 1)
    gradient = _SEEN_FIRST + np.clip(share, 0, 1) * (_SEEN_LAST - _SEEN_FIRST)
    colours[area.mask] = np.where(seen[:, None] > 0, gradient, _UNSEEN).astype(np.uint8)
    return colours


def _draw_path(draw: ImageDraw.ImageDraw, trajectory: Trajectory, corner: NDArray, scale: float) -> None:
    points = np.concatenate([trajectory.start[None], trajectory.position])[:, [0, 2]] * scale + corner
    ahead = heading(trajectory.yaw)[:, [0, 2]] * 0.3 * scale
    for point, arrow in zip(points[1:], ahead, strict=True):
        draw.line([tuple(point), tuple(point + arrow)], fill=_LOOK, width=2)
    draw.line([tuple(point) for point in points], fill=_PATH, width=3)
    for point in points[1:]:
        _dot(draw, point, 3, _PATH)
    _dot(draw, points[0], 7, (255, 255, 255), outline=_INK)
    _dot(draw, points[-1], 7, _PATH, outline=_INK)


def _dot(draw: ImageDraw.ImageDraw, centre: NDArray, radius: int, fill: tuple, outline: tuple | None = None) -> None:
    x, y = centre
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=fill, outline=outline, width=2)


def _draw_caption(draw: ImageDraw.ImageDraw, trajectory: Trajectory, scale: float, width: int) -> None:
    font = ImageFont.load_default(14)
    views = len(trajectory.action)
    coverage = 100 * float(trajectory.coverage[-1]) if views else 0.0
    draw.text((_MARGIN, 6), f"{views} views, coverage {coverage:.1f} %", fill=_INK, font=font)
    fonts = (ImageFont.load_default(size) for size in (11, 10, 9, 8, 7))
    fits = next((small for small in fonts if draw.textlength(_LEGEND, small) <= width - 2 * _MARGIN), font)
    draw.text((_MARGIN, 25), _LEGEND, fill=_INK, font=fits)
    bar = width - _MARGIN - scale
    draw.line([(bar, 18), (bar + scale, 18)], fill=_INK, width=3)
    draw.text((bar + scale / 2, 2), "1 m", fill=_INK, font=ImageFont.load_default(11), anchor="ma")
