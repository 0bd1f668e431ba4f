"""The objects that nerfstudio's entry points name.

nerfstudio loads them unguarded at the start of every `ns-` command: a part that fails here is reported and left out, so
that it cannot take the user's other methods with it. They are made when asked for, because nerfstudio asks for the
dataparser while the modules that the method needs are still half imported.
"""

import atexit
import functools
import logging
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@functools.cache
def offer_ffmpeg() -> None:
    """Let nerfstudio's own check for ffmpeg find the one of imageio-ffmpeg, where there is no other.

    nerfstudio 1.1.5 looks for a program named `ffmpeg` on the PATH and ends `ns-render` when there is none, although
    pip cannot install such a program. Nothing happens before that check runs.
    """
    from nerfstudio.utils import install_checks

    check = install_checks.check_ffmpeg_installed

    @functools.wraps(check)
    def check_ffmpeg_installed() -> None:
        put_ffmpeg_on_path()
        check()

    install_checks.check_ffmpeg_installed = check_ffmpeg_installed


def put_ffmpeg_on_path() -> None:
    """Append a folder with imageio-ffmpeg's program, under the name `ffmpeg`, to this process's PATH.

    An ffmpeg that is on the PATH already stays the one in use. The folder is removed when the process ends.
    """
    if shutil.which("ffmpeg") is not None:
        return
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        program = Path(get_ffmpeg_exe()).resolve()
    except (ImportError, RuntimeError):
        return  # nerfstudio's own check comes next, and says that there is no ffmpeg and where to get it
    folder = Path(tempfile.mkdtemp(prefix="avp-ffmpeg-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "ffmpeg").symlink_to(program)
    os.environ["PATH"] = os.pathsep.join([*filter(None, [os.environ.get("PATH")]), str(folder)])


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

    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    return DataParserSpecification(
        config=AVPDataParserConfig(), description="A rollout of the AVP suite: metric poses, held-out views for eval."
    )


def _nerfacto() -> Any:
    from avp_nerfstudio.method.config import avp_nerfacto

    return avp_nerfacto()


def _checkpoints() -> None:
    from avp_nerfstudio.method.checkpoints import allow_checkpoints, refuse_in_one_line

    allow_checkpoints()
    refuse_in_one_line()


def _videos() -> None:
    pass

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
