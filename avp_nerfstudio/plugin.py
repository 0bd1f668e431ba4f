"""The objects that nerfstudio's entry points name.

nerfstudio loads them unguarded at the start of every `ns-` command: a part that fails here is reported and left out, so
that it cannot take the user's other methods with it. They are made when asked for, because nerfstudio asks for the
dataparser while the modules that the method needs are still half imported.
"""

import functools
import logging
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_LOGGER = logging.getLogger(__name__)
# What nerfstudio 1.1.5 makes the torch of today say at every command, none of which its users can change.
_HARMLESS: tuple[tuple[str, type[Warning]], ...] = (
    (r"`torch\.jit\.script` is deprecated", FutureWarning),
    (r"`torch\.cuda\.amp\.(custom_fwd|custom_bwd|GradScaler)\(", FutureWarning),
    (r"torch\.cuda\.amp\.GradScaler is enabled, but CUDA is not available", UserWarning),
    (r"This DataLoader will create \d+ worker processes", UserWarning),
    (r"Using a non-tuple sequence for multidimensional indexing is deprecated", UserWarning),
    (r"Converting a tensor with requires_grad=True to a scalar", UserWarning),
    (r"Importing `spectral_angle_mapper` from `torchmetrics\.functional` was deprecated", FutureWarning),
)


@dataclass(frozen=True)
class Unavailable:
    """Stands in for a plug that could not be made; nerfstudio prints it in its own warning and goes on."""

    plug: str
    """Name on the command line."""
    reason: str
    """What failed, and what to do."""


def _data() -> Any:
    from nerfstudio.plugins.registry_dataparser import DataParserSpecification

    from avp_nerfstudio.dataparser import AVPDataParserConfig

    return DataParserSpecification(
        config=AVPDataParserConfig(), description="A rollout of the AVP suite: metric poses, held-out views for eval."
    )


def _nerfacto() -> Any:
    from avp_nerfstudio.method import avp_nerfacto

    return avp_nerfacto()


def _checkpoints() -> None:
    from avp_nerfstudio.checkpoints import allow_checkpoints, refuse_in_one_line

    allow_checkpoints()
    refuse_in_one_line()


def _videos() -> None:
    from avp_nerfstudio.ffmpeg import offer_ffmpeg

    offer_ffmpeg()


def _quiet() -> None:
    """Leave out known harmless warnings, unless warnings were asked for (`python -W`, `PYTHONWARNINGS`)."""
    if not sys.warnoptions:
        for message, category in _HARMLESS:
            warnings.filterwarnings("ignore", message, category)


_PLUGS: dict[str, tuple[str, Callable[[], Any]]] = {
    "AVPData": ("avp-data", _data),
    "AVPNerfacto": ("avp-nerfacto", _nerfacto),
}


def _guarded(plug: str, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except Exception as error:
        unavailable = Unavailable(
            plug,
            f"{type(error).__name__}: {error}; the AVP suite is made for nerfstudio 1.1.5: "
            'reinstall both with pip install "avp-suite[nerfstudio]"',
        )
        _LOGGER.warning("%s is not available: %s", plug, unavailable.reason, exc_info=error)
        return unavailable


@functools.cache
def _made(name: str) -> Any:
    plug, make = _PLUGS[name]
    return _guarded(plug, make)


def __getattr__(name: str) -> Any:
    if name not in _PLUGS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _made(name)


_guarded("quiet", _quiet)
_guarded("loading of checkpoints", _checkpoints)
_guarded("writing of videos", _videos)
