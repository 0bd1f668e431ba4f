"""Errors whose text is meant for the user, with the exit code that each one deserves."""

import difflib
from collections.abc import Iterable


class AVPError(Exception):
    """A failure that the user can act on; command lines print it as one line and exit with `exit_code`."""

    exit_code = 1


class UsageError(AVPError):
    """An option or name that cannot be right, whatever the machine's state."""

    exit_code = 2


class SceneError(AVPError):
    """A scene that cannot be read, or in which no agent can stand."""


class SimulatorError(AVPError):
    """A simulator that is missing or cannot run here."""


class RolloutError(AVPError):
    """A rollout folder that is incomplete, damaged or of another version."""


class PolicyError(AVPError):
    """A policy that cannot be loaded or does not fit the environment."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UsageError:
    """Error for a name of some kind of thing, such as `"reward"`, that is not known, with the nearest known name."""
    names = sorted(known)
    return UsageError(f"unknown {kind} {name!r}: expected one of {', '.join(names)}{did_you_mean(name, names)}")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of an error's text: the nearest known name, if one is near."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else ""
