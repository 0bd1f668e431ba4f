"""Numba's `njit` for the suite's kernels, which keeps compiled code wherever this machine lets it be kept."""

import logging
import os
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

VARIABLE = "NUMBA_CACHE_DIR"
_LOG = logging.getLogger(__name__)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)`, also where neither the package's folder nor the home can be written, as in containers.

    There Numba refuses `cache=True`. The code is then kept in a folder of this user for temporary files, or else not
    at all, so that each program compiles again; one line says which.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(**options)(function)
        except RuntimeError as error:
            if "cannot cache function" not in str(error):
                raise
        again: dict[str, Any] = {**options, "cache": _elsewhere()}
        return numba.njit(**again)(function)

    return compiled


@cache
def _elsewhere() -> bool:
    """Let Numba use a folder for temporary files, also in programs that this one starts; whether there is such one."""
    folder = Path(tempfile.gettempdir()) / f"avp-numba-{os.getuid()}"
    if not _is_own(folder):
        _LOG.warning("compiled code cannot be kept, so that each start takes longer; name a folder in %s", VARIABLE)
        return False
    _LOG.warning("compiled code is kept in %s; name a folder that lasts in %s", folder, VARIABLE)
    os.environ[VARIABLE] = numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    return True


def _is_own(folder: Path) -> bool:
    """Make a folder in which nobody else can write, because what lies there is run."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return private and os.access(folder, os.W_OK)
