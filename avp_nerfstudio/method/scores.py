"""Held-out views rendered and scored, as numbers and as pictures; LPIPS where its weights can be had."""

import contextlib
import functools
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torchmetrics.image.lpip
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor, nn

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"
FULL_ERROR = 0.25
"""The error that has the scale's last colour: a quarter of the way from black to white."""
_DOWNLOAD_TIMEOUT_S = 5.0
_LEAST_SIDE_PX = 31
_NARROWEST, _TALLEST_STRIP = 8, 24
_FOREGROUND, _BACKGROUND = (245, 245, 245), (24, 24, 24)
_TorchmetricsLPIPS = torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity


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
    """Render and score all held-out views of a pipeline in evaluation mode by the calls that `ns-eval` makes."""
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


def lpips_weights_path() -> Path:
    """Where torchvision keeps AlexNet's weights: `$TORCH_HOME/hub/checkpoints`, by default in the user's cache."""
    return Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_WEIGHTS


class OptionalLPIPS(nn.Module):
    """LPIPS (AlexNet), made when it is first asked for; left out, with the reason said once, where it cannot be.

    Training therefore neither needs the network nor puts AlexNet into the checkpoint, and a checkpoint opens whether
    LPIPS can be computed or not.
    """

    reason: str | None = None
    """Why LPIPS is not computed; None when it is, or was not asked for."""

    def __init__(self, **options: Any) -> None:
        """Remember what torchmetrics' LPIPS is to be made with."""
        super().__init__()
        self._options = options
        self._made: tuple[nn.Module, ...] = ()

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """LPIPS of two `(1, 3, height, width)` pictures in [0, 1]; NaN when it cannot be computed."""
        if not self._made and self.reason is None:
            self._make(first)
        return self._made[0](first, second) if self._made else torch.tensor(torch.nan)

    def _make(self, picture: Tensor) -> None:
        height, width = picture.shape[-2:]
        before = socket.getdefaulttimeout()
        socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT_S)
        try:
            if min(height, width) < _LEAST_SIDE_PX:
                self.reason = (
                    f"pictures of {width}x{height} pixels are smaller than the {_LEAST_SIDE_PX} that AlexNet needs"
                )
            else:
                # A tuple hides the network from the module, and so from the checkpoint.
                self._made = (_TorchmetricsLPIPS(**self._options).to(picture.device),)
        except Exception as error:  # a download fails in many ways: no route, a proxy's page, half a file
            self.reason = (
                f"AlexNet's weights are not in {lpips_weights_path()} and could not be downloaded ({error}); put "
                f"{LPIPS_WEIGHTS} there, or set TORCH_HOME to a folder that holds it in hub/checkpoints"
            )
        finally:
            socket.setdefaulttimeout(before)
        if self.reason is not None:
            CONSOLE.print(f"LPIPS is not computed: {self.reason}", style="yellow", highlight=False, soft_wrap=True)


@contextlib.contextmanager
def optional_lpips() -> Iterator[None]:
    """Within it nerfacto makes an `OptionalLPIPS` where it would make torchmetrics' LPIPS; it has no hook for that."""
    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = OptionalLPIPS  # type: ignore[misc]
    try:
        yield
    finally:
        torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = _TorchmetricsLPIPS  # type: ignore[misc]


def to_8_bit(colours: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours in [0, 1], any shape, rounded to 8 bits."""
    return np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)


def error_colours(view: HeldoutView) -> NDArray[np.uint8]:
    """`(h, w, 3)` |render - truth|, averaged over the channels, from black (0) through red to pale yellow.

    The last colour stands for `FULL_ERROR` and more.
    """
    error = np.abs(view.render - view.truth).mean(axis=-1)
    return _error_scale()[np.clip(error / FULL_ERROR * 255, 0, 255).astype(np.uint8)]


@functools.cache
def _error_scale() -> NDArray[np.uint8]:
    """`(256, 3)` a scale whose lightness rises evenly, by interpolation between a few colours."""
    stops = np.array([[0, 0, 0], [70, 10, 90], [170, 35, 80], [235, 105, 35], [250, 190, 45], [252, 253, 190]])
    places = np.linspace(0, len(stops) - 1, 256)
    channels = [np.interp(places, np.arange(len(stops)), stops[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def triptych(view: HeldoutView) -> NDArray[np.uint8]:
    """Truth, render and error side by side under a strip of words, `(h + strip, 3 w, 3)`."""
    units = {"psnr": " dB", "ssim": "", "lpips": ""}
    scores = [f"{name.upper()} {view.scores[name]:.3g}{units[name]}" for name in units if name in view.scores]
    parts = (
        (f"truth {view.name}", to_8_bit(view.truth)),
        ("  ".join(["render", *scores]), to_8_bit(view.render)),
        (f"error, 0 to {FULL_ERROR} of full scale", error_colours(view)),
    )
    height, width = view.truth.shape[:2]
    strip = int(np.clip(height // 12, _NARROWEST, _TALLEST_STRIP))
    canvas = Image.new("RGB", (3 * width, height + strip), _BACKGROUND)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=max(strip - 6, 6))
    for column, (words, part) in enumerate(parts):
        canvas.paste(Image.fromarray(part), (column * width, strip))
        while words and draw.textlength(words, font=font) > width - 8:
            words = words[:-1]
        draw.text((column * width + 4, 1), words, font=font, fill=_FOREGROUND)
    return np.asarray(canvas)
