"""Reading the scores that `ns-eval` wrote."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
