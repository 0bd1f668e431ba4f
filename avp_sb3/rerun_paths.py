"""Which of the paths that a viewer opens are rollouts, decided in milliseconds.

A viewer asks about every path that anyone opens with it, so only small modules of the standard library are imported,
little is read, and nothing that could block (a pipe, a device) is opened.
"""

import os
from collections.abc import Iterator
from pathlib import Path

_META = "rollout.json"
_MARK = b"avp-rollout"
"""The value of `format`, one of the first lines of our `rollout.json`."""
_HEAD_BYTES = 65_536
_PARTS = ("images", "depth", "poses", "steps.csv", "transforms.json")
_MOST_ENTRIES = 4096
"""Of a folder that is searched for rollouts; whoever keeps more in one folder does not want all of them in one view."""


def rollouts_at(path: str) -> list[str]:
    """The rollouts that a path stands for, damaged ones included.

    Args:
        path: any path, also of something that does not exist.

    Returns:
        The folder of the rollout (given itself, or by its `rollout.json`); or the rollouts directly in the folder, by
        name; none for everything else.
    """
    if os.path.isdir(path):
        return [path] if is_rollout(path) else sorted(folder for folder in _folders_in(path) if is_rollout(folder))
    if os.path.basename(path) == _META and os.path.isfile(path):
        folder = os.path.dirname(path) or "."
        return [folder] if is_rollout(folder) else []
    return []


def is_rollout(folder: str) -> bool:
    """Whether a folder is a rollout: by the mark in its `rollout.json`, or (damaged) by all the other parts of one."""
    return _MARK in _head(os.path.join(folder, _META)) or all(
        os.path.lexists(os.path.join(folder, part)) for part in _PARTS
    )


def is_shown_with_its_folder(path: str, application_id: str | None) -> bool:
    """Whether a file of a rollout is asked about only because its folder is being opened.

    A viewer that opens a folder asks about the folder, then about each file in it. The folder's own answer shows the
    rollout already. Such questions carry the folder's name as application id (none for the folder `.`); a file opened
    by itself carries its own name.

    Args:
        path: as asked about.
        application_id: as sent along.
    """
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isfile(path) or not is_rollout(folder):
        return False
    opened = (folder, os.path.dirname(folder))
    if application_id is None:
        return path.startswith((os.curdir + os.sep, os.pardir + os.sep)) and _caller_opened(opened)
    if application_id not in map(_application_id, opened):
        return False
    # A folder named like the file tells nothing; neither answer loses anything, one would show the rollout twice.
    return application_id != _application_id(path) or _caller_opened(opened)


def _head(path: str) -> bytes:
    try:
        if not os.path.isfile(path):
            return b""
        with open(path, "rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""


def _folders_in(path: str) -> Iterator[str]:
    """Those that are not hidden (a rollout being written is)."""
    try:
        with os.scandir(path) as entries:
            for _, entry in zip(range(_MOST_ENTRIES), entries, strict=False):
                if entry.is_dir() and not entry.name.startswith("."):
                    yield entry.path
    except OSError:
        return


def _application_id(path: str) -> str:
    """The name that a viewer makes of a path."""
    return Path(path).stem.replace(".", "_")


def _caller_opened(folders: tuple[str, ...]) -> bool:
    """Whether the calling program's command line names one of the folders; False where that cannot be known."""
    try:
        words = Path(f"/proc/{os.getppid()}/cmdline").read_bytes().split(b"\0")[1:]
    except OSError:
        return False
    wanted = {os.path.realpath(folder) for folder in folders}
    return any(os.path.isdir(word) and os.path.realpath(word) in wanted for word in map(os.fsdecode, words))
