"""The objects that nerfstudio's entry points name.

nerfstudio loads this module at the start of every `ns-` command, so what is to be done in each of them is done here.
The objects are made when asked for, because nerfstudio asks for the dataparser while the modules that the method needs
are still half imported.
"""

import atexit
import functools
import importlib
import importlib.abc
import importlib.machinery
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from nerfstudio.utils import install_checks

from avp_nerfstudio.method.checkpoints import allow_checkpoints

MOVED = {
    f"avp_nerfstudio.{old}": f"avp_nerfstudio.{new}"
    for old, new in {
        "config": "method.config",
        "dataparser": "data.dataparser",
        "dataset": "data.dataparser",
        "model": "method.model",
        "trainer": "method.trainer",
    }.items()
}
"""Modules that a config.yml of a training made before they moved names, and where their objects are now."""
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


class MovedModules(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Lets the old names of `MOVED` be imported: each gives the module that has its objects now."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """This loader, for the old names."""
        return importlib.machinery.ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Put the new module in the place of the old one."""
        sys.modules[module.__name__] = importlib.import_module(MOVED[module.__name__])


def _offer_ffmpeg() -> None:
    """Let nerfstudio's check for a program named `ffmpeg` find that of imageio-ffmpeg where the PATH has none.

    nerfstudio 1.1.5 ends `ns-render` otherwise, although pip cannot install such a program.
    """
    check = install_checks.check_ffmpeg_installed

    def check_ffmpeg_installed() -> None:
        if shutil.which("ffmpeg") is None:
            from imageio_ffmpeg import get_ffmpeg_exe

            folder = Path(tempfile.mkdtemp(prefix="avp-ffmpeg-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            (folder / "ffmpeg").symlink_to(Path(get_ffmpeg_exe()).resolve())
            os.environ["PATH"] = os.pathsep.join([*filter(None, [os.environ.get("PATH")]), str(folder)])
        check()

    install_checks.check_ffmpeg_installed = check_ffmpeg_installed


@functools.cache
def _made(name: str) -> Any:
    if name == "AVPNerfacto":
        from avp_nerfstudio.method.config import avp_nerfacto

        return avp_nerfacto()
    from nerfstudio.plugins.registry_dataparser import DataParserSpecification

    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    return DataParserSpecification(
        config=AVPDataParserConfig(), description="A rollout of the AVP suite: metric poses, held-out views for eval."
    )


def __getattr__(name: str) -> Any:
    if name not in ("AVPData", "AVPNerfacto"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _made(name)


sys.meta_path.append(MovedModules())
allow_checkpoints()
_offer_ffmpeg()
if not sys.warnoptions:  # `python -W`, PYTHONWARNINGS ask for warnings
    for _message, _category in _HARMLESS:
        warnings.filterwarnings("ignore", _message, _category)
