"""What users are told once about a scene that opens: what of its file is not shown as it was meant."""

import logging
from functools import cache

_log = logging.getLogger(__name__)


@cache
def say_once(scene: str, text: str) -> None:
    """Log a warning about a scene, one line that Python shows on stderr, once in a process.

    Args:
        scene: the path as the user wrote it.
        text: what was found, and what is done with it.
    """
    _log.warning("%s: %s", scene, text)
