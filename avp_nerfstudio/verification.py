"""Finding damaged pictures before a training meets them."""

import os
from collections.abc import Sequence

from tqdm import tqdm

from avp_habitat.errors import RolloutError
from avp_habitat.png import check_png_contents
from avp_habitat.rollout import View

AUTOMATIC_BYTES = 1 << 30
"""Pictures of up to this size together are checked without being asked: about a second's reading."""


def verify_pictures(views: Sequence[View], *, wanted: bool | None) -> None:
    """Hold every byte of the pictures and depth images to its checksum; shows its progress when it takes long.

    Args:
        views: whose files.
        wanted: whether to; None when all of them together have at most `AUTOMATIC_BYTES`.

    Raises:
        RolloutError: a file is damaged; the text names it.
    """
    paths = [path for view in views for path in (view.image, view.depth)]
    if wanted is False or (wanted is None and _bytes_exceed(paths, AUTOMATIC_BYTES)):
        return
    for path in tqdm(paths, desc="checking pictures", unit="file", delay=2, leave=False, disable=None):
        check_png_contents(path)


def _bytes_exceed(paths: Sequence[os.PathLike[str]], limit: int) -> bool:
    total = 0
    for path in paths:
        try:
            total += os.stat(path).st_size
        except OSError as error:
            raise RolloutError(f"{path}: expected a readable PNG, could not read it: {error.strerror}") from None
        if total > limit:
            return True
    return False
