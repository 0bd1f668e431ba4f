"""What is chosen by name: built in, `module:object`, or registered by another installed distribution."""

import os
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from avp_habitat.errors import UsageError, did_you_mean, unknown_name

Function = TypeVar("Function", bound=Callable[..., Any])
KINDS = {
    "avp.rewards": "reward",
    "avp.observations": "observation",
    "avp.policies": "policy",
    "avp.simulators": "simulator",
    "avp.metrics": "metric",
}
"""What is chosen by name, by the group of entry points in which other distributions register theirs."""


def find(group: str, name: Any, known: Mapping[str, Any]) -> Any:
    """The object behind a name.

    Args:
        group: one of `KINDS`.
        name: one of `known`, `module:object` (the module may lie in the current folder, as for `python -m`), or a name
            that another distribution registers. What is no text is the object itself.
        known: what is built in, by name; a text there is the `module:object` for which it stands.

    Raises:
        UsageError: nothing has that name, two have it, or its module cannot be imported or has no such object.
    """
    if not isinstance(name, str):
        return name
    kind, others = KINDS[group], [point for point in _registered(group) if point.name == name]
    owners = ["avp-suite (built in)"] * (name in known) + [_owner(point) for point in others]
    if len(owners) > 1:
        raise UsageError(f"{kind} {name!r}: expected one distribution to register it, found {' and '.join(owners)}")
    if others:
        return _load(kind, name, others[0].value.partition("[")[0].strip())
    if name in known:
        found = known[name]
        return _load(kind, name, found) if isinstance(found, str) else found
    if ":" in name:
        return _load(kind, name, name)
    if not (there := names(group, known)):
        raise UsageError(
            f"unknown {kind} {name!r}: expected MODULE:OBJECT; no installed distribution registers {group}"
        )
    raise unknown_name(kind, name, there)


def declares(**facts: Any) -> Callable[[Function], Function]:
    """Decorator: what a function declares about itself, as its attributes, which a class says in its body."""

    def declared(function: Function) -> Function:
        vars(function).update(facts)
        return function

    return declared


def names(group: str, known: Iterable[str]) -> list[str]:
    """What is built in, then what other distributions register, each once."""
    return list(dict.fromkeys([*known, *(point.name for point in _registered(group))]))


def name_of(thing: Any) -> str:
    """The text under which a thing is stored: its name, or `module:name` of an object."""
    if isinstance(thing, str):
        return thing
    named = thing if hasattr(thing, "__qualname__") else type(thing)
    return f"{named.__module__}:{named.__qualname__}"


@cache
def _registered(group: str) -> Iterable[EntryPoint]:
    return entry_points(group=group)


def _owner(point: EntryPoint) -> str:
    return f"{point.dist.name if point.dist else 'an unnamed distribution'} ({point.value})"


def _load(kind: str, name: str, reference: str) -> Any:
    module, _, path = reference.partition(":")
    folder = os.getcwd()
    if not {"", folder} & set(sys.path):
        sys.path.insert(0, folder)
    try:
        found = import_module(module)
    except Exception as error:  # A user's module may raise anything.
        missing = isinstance(error, ModuleNotFoundError) and error.name == module
        near = did_you_mean(module, (each.name for each in pkgutil.iter_modules([folder]))) if missing else ""
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise UsageError(f"{kind} {name!r}: expected a module that can be imported, got {why}{near}") from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise UsageError(f"{kind} {name!r}: {module} has no {path!r}{did_you_mean(part, vars(found))}")
        found = getattr(found, part)
    return found
