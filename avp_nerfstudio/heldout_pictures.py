"""The picture that shows how well a held-out view was reconstructed: truth, render and error side by side."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from avp_nerfstudio.heldout_views import HeldoutView

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont
    from PIL.ImageFont import ImageFont as BitmapFont

FULL_ERROR = 0.25
"""The error that has the scale's last colour: a quarter of the way from black to white."""
_UNITS = {"psnr": " dB"}
_NARROWEST, _TALLEST_STRIP = 8, 24
_FOREGROUND, _BACKGROUND = (245, 245, 245), (24, 24, 24)


def error(view: HeldoutView) -> NDArray[np.float32]:
    """`(h, w)` mean over the colour channels of |render - truth|, in [0, 1]."""
    return np.abs(view.render - view.truth).mean(axis=-1)


def error_colours(view: HeldoutView) -> NDArray[np.uint8]:
    """`(h, w, 3)` the error from black (0) through red to pale yellow (`FULL_ERROR` and more)."""
    index = np.clip(error(view) / FULL_ERROR * 255, 0, 255).astype(np.uint8)
    return _scale()[index]


def to_8_bit(colours: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours in [0, 1], any shape, rounded to 8 bits."""
    return np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def triptych(view: HeldoutView) -> NDArray[np.uint8]:
    """Truth, render and error side by side under a strip of words.

    Returns:
        `(h + strip, 3 w, 3)`.
    """
    parts = [to_8_bit(view.truth), to_8_bit(view.render), error_colours(view)]
    height, width = parts[0].shape[:2]
    strip = int(np.clip(height // 12, _NARROWEST, _TALLEST_STRIP))
    canvas = Image.new("RGB", (3 * width, height + strip), _BACKGROUND)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=max(strip - 6, 6))
    for column, (part, words) in enumerate(zip(parts, _labels(view), strict=True)):
        canvas.paste(Image.fromarray(part), (column * width, strip))
        _write(draw, font, words, column * width, width)
    return np.asarray(canvas)


def _labels(view: HeldoutView) -> tuple[str, str, str]:
    shown = [f"{name.upper()} {view.scores[name]:.3g}{_UNITS.get(name, '')}" for name in _shown(view)]
    return f"truth {view.name}", "render  " + "  ".join(shown), f"error, 0 to {FULL_ERROR} of full scale"


def _shown(view: HeldoutView) -> list[str]:
    return [name for name in ("psnr", "ssim", "lpips") if name in view.scores]


def _write(draw: ImageDraw.ImageDraw, font: "FreeTypeFont | BitmapFont", words: str, left: int, width: int) -> None:
    """Words at the top left of a column, as many letters as fit."""
    while words and draw.textlength(words, font=font) > width - 8:
        words = words[:-1]
    draw.text((left + 4, 1), words, font=font, fill=_FOREGROUND)


@cache
def _scale() -> NDArray[np.uint8]:
    """`(256, 3)` a scale whose lightness rises evenly, by interpolation between a few colours."""
    stops = np.array([[0, 0, 0], [70, 10, 90], [170, 35, 80], [235, 105, 35], [250, 190, 45], [252, 253, 190]])
    places = np.linspace(0, len(stops) - 1, 256)
    channels = [np.interp(places, np.arange(len(stops)), stops[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)
