"""The program ffmpeg for `ns-render`'s videos, from the package imageio-ffmpeg where the machine has none."""

import atexit
import functools
import os
import shutil
import tempfile
from pathlib import Path


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
