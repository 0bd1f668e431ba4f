"""Finding damaged pictures before a training meets them."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from tqdm import tqdm

from avp_habitat.errors import RolloutError
from avp_habitat.rollout.format import View
from avp_habitat.rollout.images import read_depth, read_rgb
from avp_habitat.rollout.png import check_png_contents

AUTOMATIC_BYTES = 1 << 28
"""Pictures of up to this size together are decoded without being asked: about 600 views of 640x480, seven seconds."""
_THREADS = 2


def verify_pictures(views: Sequence[View], *, wanted: bool | None) -> None:
    """Decode the pictures and depth images, with every byte held to its checksum; shows progress when it takes long.

    A training decodes them all anyway, but ends in Pillow's traceback then. 11 ms for a view of 640x480 on one core.

    Args:
        views: whose files.
        wanted: whether to; None when all of them together have at most `AUTOMATIC_BYTES`.

    Raises:
        RolloutError: a file is damaged; the text names it.
    """
    paths = [path for view in views for path in (view.image, view.depth)]
    if wanted is False or (wanted is None and _bytes_exceed(paths, AUTOMATIC_BYTES)):
        return
    with ThreadPoolExecutor(_THREADS) as threads:
        for _ in tqdm(
            threads.map(_verify, views),
            total=len(views),
            desc="checking pictures",
            unit="view",
            delay=2,
            leave=False,
            disable=None,
        ):
            pass


def _verify(view: View) -> None:
    for path, read in ((view.image, read_rgb), (view.depth, read_depth)):
        check_png_contents(path)
        read(path)


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
