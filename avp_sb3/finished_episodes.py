"""Finding the episodes that ended in the step that Stable-Baselines3 just took."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from avp_habitat.errors import AVPError


class MissingInfoError(AVPError):
    """An environment that does not report what a callback reads."""


def finished_episodes(locals_: Mapping[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    """Index of the environment, and the last `info`, of every episode that ended in this step.

    Args:
        locals_: a callback's `self.locals`.
    """
    dones = np.asarray(locals_["dones"])
    if not dones.any():
        return []
    infos = locals_["infos"]
    return [(int(index), infos[index]) for index in np.flatnonzero(dones)]


def required(info: Mapping[str, Any], key: str, *, reader: str, inside: str = "info") -> Any:
    """`info[key]`.

    Args:
        info: the mapping.
        key: what must be in it.
        reader: the callback that needs it, for the error's text.
        inside: how the mapping is called, for the error's text.

    Raises:
        MissingInfoError: the key is missing.
    """
    if key in info:
        return info[key]
    found = ", ".join(sorted(map(str, info))) or "nothing"
    raise MissingInfoError(
        f"{reader}: expected {key!r} in {inside} at the end of an episode, found {found}; train on AVP-v0 "
        "(gymnasium.make('avp_habitat:AVP-v0')) or another environment that reports it, and keep it in every wrapper"
    )
