"""What the callbacks share: episodes that ended, files to log, and who called."""

import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.errors import AVPError
from avp_habitat.task.settings import TaskSettings

NOT_FOR = ("stdout", "log", "json", "csv", "tensorboard")
"""Formats that cannot hold a file: `logger.record(name, LoggedFile(path), exclude=NOT_FOR)`."""


@dataclass(frozen=True)
class LoggedFile:
    """A file to keep with the run; MLflow copies it when the logger is dumped."""

    path: Path
    """Where it lies."""
    name: str
    """How the artifact is called, `/` for folders: an artifact of the same name is replaced."""


_LONGEST = 33
"""Letters behind the first `/` of a name: SB3 cuts longer ones on the screen, and refuses two that are then equal."""


def record(logger: Logger, name: str, value: float) -> None:
    """Record a figure, which is not shown on the screen where its name is too long for that."""
    logger.record(name, value, ("stdout", "log") if len(name.partition("/")[2]) > _LONGEST else None)


class MissingInfoError(AVPError):
    """An environment that does not report what a callback reads."""


def settings_of(env: VecEnv) -> TaskSettings | None:
    """The task's, of the first environment; None where it has none."""
    found = env.get_attr("settings", 0)[0] if env.has_attr("settings") else None
    return found if isinstance(found, TaskSettings) else None


def pool_of(env: VecEnv) -> str | None:
    """What the scenes of a pool are called; None where all are open all the time."""
    return env.get_attr("pool", 0)[0] if env.has_attr("pool") else None


def scenes_told(env: VecEnv) -> list[str]:
    """The names of the scenes that are open all the time, or what those of a pool are called together."""
    return each_once(env, "scene_name") if (pool := pool_of(env)) is None else [pool]


def each_once(env: VecEnv, attribute: str) -> list[str]:
    """The values of an attribute over the environments; none where they have no such attribute."""
    return list(dict.fromkeys(map(str, env.get_attr(attribute)))) if env.has_attr(attribute) else []


def is_learning(model: Any) -> bool:
    """Whether `model.learn` is among the callers, which says that a training came to its own end.

    rl_zoo3 calls the first callback's `on_training_end` once more in a `finally`, whatever ended the training.
    """
    frames = (frame for frame, _ in traceback.walk_stack(None) if frame.f_code.co_name == "learn")
    return any(frame.f_locals.get("self") is model for frame in frames)


def finished_episodes(locals_: Mapping[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    """Index of the environment, and the last `info`, of every episode that ended in this step of a callback."""
    return [(int(index), locals_["infos"][index]) for index in np.flatnonzero(locals_["dones"])]


def required(info: Mapping[str, Any], key: str, *, reader: str, inside: str = "info") -> Any:
    """`info[key]`, which the callback `reader` needs; `inside` is how the error calls the mapping.

    Raises:
        MissingInfoError: the key is missing.
    """
    if key in info:
        return info[key]
    found = ", ".join(sorted(map(str, info))) or "nothing"
    raise MissingInfoError(
        f"{reader}: expected {key!r} in {inside} at the end of an episode, found {found}; train on AVP-v0 or another "
        "environment that reports it, and keep it in every wrapper"
    )
