"""LPIPS that is computed when its network's weights can be had and is left out, with the reason said once, when not."""

import contextlib
import socket
from collections.abc import Iterator
from typing import Any

import torch
import torchmetrics.image.lpip
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from avp_nerfstudio.scores import LPIPS_WEIGHTS, lpips_weights_path

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
