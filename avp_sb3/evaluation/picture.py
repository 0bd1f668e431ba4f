"""One picture of an evaluation in a scene: the first episode from above, and the coverage by view of all episodes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.rollout.drawing import beside, draw_trajectory
from avp_habitat.task.trajectory import Trajectory

_WIDTH, _HEIGHT, _MAP_PX = 420, 320, 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 14, 30, 36
_BACKGROUND, _INK, _GRID = (255, 255, 255), (40, 40, 44), (222, 224, 228)
_EPISODE, _MEAN = (170, 195, 215), (178, 34, 52)
_HEIGHTS = 5


def evaluation_picture(
    curves: Sequence[NDArray[np.floating]], area: NavigableArea | None = None, trajectory: Trajectory | None = None
) -> NDArray[np.uint8]:
    """`(h, w, 3)` of at least one episode, `(v,)` coverage after 1 … v views each; with a map if both are given."""
    curve = draw_curves(curves)
    if area is None or trajectory is None:
        return curve
    return beside(draw_trajectory(area, trajectory, longest_px=_MAP_PX), curve)


def draw_curves(curves: Sequence[NDArray[np.floating]]) -> NDArray[np.uint8]:
    """Coverage by view: each episode thin, the mean over the episodes that have so many views thick."""
    longest = max(len(curve) for curve in curves)
    stacked = np.full((len(curves), longest), np.nan)
    for row, curve in zip(stacked, curves, strict=True):
        row[: len(curve)] = curve
    mean = np.nanmean(stacked, axis=0)
    canvas = Image.new("RGB", (_WIDTH, _HEIGHT), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    _draw_axes(draw, longest)
    for curve in curves:
        draw.line(_points(curve, longest), fill=_EPISODE, width=1)
    draw.line(_points(mean, longest), fill=_MEAN, width=3)
    title = f"coverage by view, mean of {len(curves)}: {100 * mean[-1]:.1f} % after {longest}"
    draw.text((_LEFT, 8), title, fill=_INK, font=ImageFont.load_default(13))
    return np.asarray(canvas)


def _points(curve: NDArray[np.floating], longest: int) -> list[tuple[float, float]]:
    """Pixels of a curve that begins with nothing seen before the first view."""
    values = np.clip(np.concatenate([[0.0], curve]), 0, 1)
    return [_pixel(view / longest, value) for view, value in enumerate(values.tolist())]


def _draw_axes(draw: ImageDraw.ImageDraw, longest: int) -> None:
    font = ImageFont.load_default(11)
    (left, bottom), (right, top) = _pixel(0.0, 0.0), _pixel(1.0, 1.0)
    for height in np.linspace(0, 1, _HEIGHTS):
        y = _pixel(0.0, float(height))[1]
        draw.line([(left, y), (right, y)], fill=_GRID)
        draw.text((left - 6, y), f"{100 * height:.0f} %", fill=_INK, font=font, anchor="rm")
    for view in sorted({0, longest // 2, longest}):
        x = _pixel(view / longest, 0.0)[0]
        draw.line([(x, top), (x, bottom)], fill=_GRID)
        draw.text((x, bottom + 5), str(view), fill=_INK, font=font, anchor="ma")
    draw.text(((left + right) / 2, bottom + 19), "views", fill=_INK, font=font, anchor="ma")
    draw.line([(left, top), (left, bottom), (right, bottom)], fill=_INK)


def _pixel(x: float, y: float) -> tuple[float, float]:
    """Pixel of a place within the axes, both within [0, 1] from the lower left."""
    return _LEFT + x * (_WIDTH - _LEFT - _RIGHT), _TOP + (1 - y) * (_HEIGHT - _TOP - _BOTTOM)
