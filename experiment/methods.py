"""The methods that are compared: baselines by name, and policies by the reward that they learn from."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.policies import POLICY_NAMES
from avp_habitat.rewards import REWARD_NAMES

ROOMS = "_rooms"
"""A learned method whose name ends so is trained in generated rooms, never in the scenes of the experiment."""
_WITHOUT_STOP = "coverage"


@dataclass(frozen=True)
class Method:
    """A way to take views."""

    name: str
    """In files and tables."""
    reward: str
    """What it learns from; of a baseline, which has no use for it, one without a stop."""
    learned: bool
    """Whether it is trained."""
    rooms: bool = False
    """Whether it is trained in generated rooms."""


METHODS = {
    name: Method(name, _WITHOUT_STOP, learned=False) for name in POLICY_NAMES
} | {
    reward + suffix: Method(reward + suffix, reward, learned=True, rooms=bool(suffix))
    for suffix in ("", ROOMS)
    for reward in REWARD_NAMES
}  # fmt: skip
"""By name."""
BASELINES = ("heuristic", "random", "frontier", "greedy", "oracle", "survey")
"""What learned policies are compared with by default; the last two plan with full knowledge, for floor and for all
surfaces."""
DEFAULT = (*BASELINES, *REWARD_NAMES, f"proposed{ROOMS}", f"surface{ROOMS}")
"""The baselines, every reward, and the rewards with a learned stop trained over many rooms."""


def chosen_methods(names: Iterable[str]) -> tuple[Method, ...]:
    """The methods of these names, in the order of `METHODS`' tables.

    Raises:
        UsageError: no such method, with the nearest name, or none at all.
    """
    names = list(names)
    for name in names:
        if name not in METHODS:
            raise unknown_name("method", name, METHODS)
    if not names:
        raise UsageError("methods: expected at least one, got none")
    return tuple(METHODS[name] for name in in_order(names))


def in_order(names: Iterable[str]) -> Sequence[str]:
    """Each name once: baselines first, then rewards, then those trained in rooms."""
    wanted = set(names)
    return [name for name in METHODS if name in wanted]
