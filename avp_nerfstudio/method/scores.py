"""LPIPS that is computed when its network's weights can be had and is left out, with the reason said once, when not."""

import contextlib
import json
import math
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torchmetrics.image.lpip
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from avp_habitat.errors import AVPError

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"


def lpips_weights_path() -> Path:
    """Where torchvision keeps AlexNet's weights: `$TORCH_HOME/hub/checkpoints`, by default in the user's cache."""
    import torch

    return Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_WEIGHTS


class ScoresError(AVPError):
    """A file that is not what `ns-eval` writes."""


@dataclass(frozen=True)
class Scores:
    """How well the held-out views were reconstructed, averaged over them."""

    psnr: float
    """Decibels; higher is better."""
    ssim: float
    """Structural similarity, at most 1; higher is better."""
    lpips: float | None
    """Learned perceptual distance (AlexNet), lower is better; None when it was not computed."""
    lpips_reason: str | None
    """Why LPIPS was not computed, None when it was."""


def read_scores(path: str | Path, *, lpips_reason: str | None = None) -> Scores:
    """Read the JSON file named by `ns-eval --output-path`.

    Args:
        path: of the file.
        lpips_reason: why LPIPS is missing, for a caller who knows it; else the reader is sent to ns-eval's output.

    Raises:
        ScoresError: the file is missing, not JSON, or holds no PSNR and SSIM.
    """
    path = Path(path)
    results = _results(path)
    computed = "lpips" in results
    return Scores(
        psnr=_number(path, results, "psnr"),
        ssim=_number(path, results, "ssim"),
        lpips=_number(path, results, "lpips") if computed else None,
        lpips_reason=None if computed else lpips_reason or _likely_reason(),
    )


def _likely_reason() -> str:
    path = lpips_weights_path()
    if path.exists():
        return "ns-eval did not compute it; its output says why"
    return f"AlexNet's weights are not in {path}; nerfstudio downloads them there once, where there is a network"


def _results(path: Path) -> dict[str, Any]:
    try:
        results = json.loads(path.read_text(encoding="utf-8"))["results"]
    except FileNotFoundError:
        raise ScoresError(f"{path}: expected the scores that ns-eval writes, found no such file") from None
    except (OSError, ValueError) as error:
        raise ScoresError(f"{path}: expected the JSON that ns-eval writes, could not read it: {error}") from None
    except (KeyError, TypeError):
        raise ScoresError(f"{path}: expected the JSON that ns-eval writes, found none of its `results`") from None
    if not isinstance(results, dict):
        raise ScoresError(f"{path}: expected `results` to be an object, found a {type(results).__name__}")
    return results


def _number(path: Path, results: dict[str, Any], name: str) -> float:
    value = results.get(name)
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ScoresError(f"{path}: expected a finite number for {name}, found {value!r}")
    return float(value)


_DOWNLOAD_TIMEOUT_S = 5.0
_LEAST_SIDE_PX = 31


class OptionalLPIPS(nn.Module):
    """LPIPS (AlexNet), made when it is first asked for.

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
        if min(height, width) < _LEAST_SIDE_PX:
            self._leave_out(f"pictures of {width}x{height} pixels are smaller than the {_LEAST_SIDE_PX} AlexNet needs")
            return
        try:
            # A tuple hides the network from the module, and so from the checkpoint.
            self._made = (_lpips(**self._options).to(picture.device),)
        except Exception as error:  # a download fails in many ways: no route, a proxy's page, half a file
            self._leave_out(
                f"AlexNet's weights are not in {lpips_weights_path()} and could not be downloaded ({error}); put "
                f"{LPIPS_WEIGHTS} there, or set TORCH_HOME to a folder that holds it in hub/checkpoints"
            )

    def _leave_out(self, reason: str) -> None:
        self.reason = reason
        CONSOLE.print(f"LPIPS is not computed: {reason}", style="yellow", highlight=False, soft_wrap=True)


def _lpips(**options: Any) -> nn.Module:
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT_S)
    try:
        return _TorchmetricsLPIPS(**options)
    finally:
        socket.setdefaulttimeout(before)


_TorchmetricsLPIPS = torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity


@contextlib.contextmanager
def optional_lpips() -> Iterator[None]:
    """Within it nerfacto makes an `OptionalLPIPS` where it would make torchmetrics' LPIPS; it has no hook for that."""
    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = OptionalLPIPS  # type: ignore[misc]
    try:
        yield
    finally:
        torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = _TorchmetricsLPIPS  # type: ignore[misc]
