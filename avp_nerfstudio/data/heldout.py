"""The picture that shows how well a held-out view was reconstructed: truth, render and error side by side."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont
    from PIL.ImageFont import ImageFont as BitmapFont


@dataclass(frozen=True)
class HeldoutView:
    """A held-out view, rendered."""

    index: int
    """From 0."""
    name: str
    """Of the true picture's file."""
    truth: NDArray[np.float32]
    """`(h, w, 3)` colours in [0, 1]."""
    render: NDArray[np.float32]
    """`(h, w, 3)` colours in [0, 1]."""
    scores: dict[str, float]
    """`psnr`, `ssim`, `lpips` where it is computed, and whatever else the method measures."""
    seconds: float
    """Time to render and score it."""
    camera: Any
    """nerfstudio's `Cameras`, one camera."""


def heldout_count(pipeline: Any) -> int:
    """How many held-out views there are."""
    return len(pipeline.datamanager.fixed_indices_eval_dataloader)


def render_views(pipeline: Any) -> Iterator[HeldoutView]:
    """Render and score all held-out views by the calls that `ns-eval` makes, one at a time.

    Args:
        pipeline: nerfstudio's, in evaluation mode, made for testing.
    """
    names = [Path(path).name for path in pipeline.datamanager.eval_dataset.image_filenames]
    for index, (camera, batch) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
        started = time.monotonic()
        outputs = pipeline.model.get_outputs_for_camera(camera=camera)
        scores, pictures = pipeline.model.get_image_metrics_and_images(outputs, batch)
        seconds = time.monotonic() - started
        # nerfstudio's methods put the truth first and the final render last into one wide picture.
        wide = pictures["img"].detach().cpu().numpy().astype(np.float32)
        width = int(camera.width)
        yield HeldoutView(
            index,
            names[int(batch["image_idx"])],
            wide[:, :width, :3],
            wide[:, -width:, :3],
            {name: float(score) for name, score in scores.items()},
            seconds,
            camera,
        )


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each score over the views, which is what `ns-eval` reports."""
    return {name: float(np.mean([row[name] for row in scores])) for name in (scores[0] if scores else {})}


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
