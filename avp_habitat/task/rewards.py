"""The rewards of the task as sums of named parts, for n agents at a time."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat import plugins
from avp_habitat.errors import UsageError
from avp_habitat.ranges import Range, hold_ranges

Number = NDArray[np.number]
Bool = NDArray[np.bool_]
Amount = Annotated[float, Range(0, 1000)]


@dataclass(frozen=True)
class RewardConstants:
    """The constants of all rewards; the paper gives none, so these are ours and the same for every scene."""

    alpha: Amount = 0.004
    """α of `coverage` and `coverage_redundancy`: reward per newly observed cell (0.01 m²)."""
    alpha_proposed: Amount = 0.0088
    """α of `proposed`: reward per (newly observed cell)^β."""
    alpha_surface: Amount = 0.0045
    """α of `surface`: reward per (newly seen surface point)^β, each weighted by how well it is seen (`surfaces`)."""
    alpha_multiview: Amount = 0.02
    """α_m of `multiview`: reward per (growth of Q and S, by their weights)^β."""
    single_weight: Annotated[float, Range(0, 1)] = 0.5
    """w of `multiview`: weight of how well points are seen in one view (Q); 1 - w is that of two views (S)."""
    beta: Annotated[float, Range(0, 1)] = 0.9
    """β of `proposed`, `surface` and `multiview`, no unit, below 1: much that is new at once counts less than step
    after step."""
    visit_decay: Amount = 0.5
    """Weight of earlier visits v in α / (1 + 0.5·v), per visit."""
    spread: Amount = 0.002
    """λ_s: reward per metre between the agent and the mean of the positions it visited."""
    spread_limit_m: Amount = 3.0
    """r_max in metres: more distance than this earns nothing more."""
    step: Amount = 0.045
    """P_step: cost of each step."""
    collision: Amount = 0.05
    """P_collision: cost of a forward move that was blocked."""
    redundancy: Amount = 0.03
    """P_redundancy: cost of a view like an earlier one."""
    redundancy_distance_m: Amount = 0.2
    """d_red in metres: below one forward move, so that walking on is never redundant."""
    redundancy_angle_deg: Annotated[float, Range(0, 180)] = 5.0
    """δ in degrees, for yaw and pitch alike: below one turn, so that turning on is never redundant."""
    stop_bonus: Amount = 1.0
    """B_s of `proposed`: reward of stopping with enough coverage."""
    stop_surface_bonus: Amount = 5.0
    """B_q of `surface` and `multiview`: reward of stopping with all of the surface seen well."""
    stop_per_step_left: Amount = 0.01
    """λ_e: further reward of `proposed` per step of the budget that was not used."""
    early_stop: Amount = 0.02
    """Cost of choosing stop with too little coverage in `proposed`."""
    stop_coverage: Annotated[float, Range(0, 1)] = 0.85
    """τ: the coverage from which stop ends the episode in `proposed`, within [0, 1]."""

    def __post_init__(self) -> None:
        """Refuse what is outside its range."""
        hold_ranges(self)


@dataclass(frozen=True)
class StepFacts:
    """What happened to n agents in one step; every array is `(n,)`."""

    new_cells: Number
    """Δc: navigable cells first observed by this step's view."""
    new_surface: Number
    """ΣΔQ: by how much the qualities of the scene's surface points grew by this step's view; 0 where not computed."""
    earlier_visits: Number
    """v: earlier views taken from the agent's cell."""
    spread_m: Number
    """‖p − p̄‖ in metres on the floor plane; p̄ is the mean of the positions visited so far."""
    collided: Bool
    """Forward was chosen and the agent moved less than 0.05 m."""
    redundant: Bool
    """An earlier view lies within d_red and both its angles within δ."""
    stop_chosen: Bool
    """The stop action was chosen, and this reward has one."""
    coverage: Number
    """C after the step."""
    steps_left: Number
    """T − t after the step."""
    new_shown: Number | float = 0.0
    """Σa·ΔQ: as `new_surface`, each point by how much of the pictures it fills; 0 where not computed."""
    new_shown_twice: Number | float = 0.0
    """Σa·ΔS: so for how well points were seen along two rays; 0 where not computed."""
    surface: Number | float = 0.0
    """ΣQ after the step by the sum of the best qualities in the scene, within [0, 1]; 0 where not computed."""
    shown: Number | float = 0.0
    """Σa·Q after the step by the sum of a times the best qualities, within [0, 1]; 0 where not computed."""
    shown_twice: Number | float = 0.0
    """Σa·S after the step by the same sum, within [0, 1]; 0 where not computed."""


RewardFunction = Callable[[StepFacts, RewardConstants], Mapping[str, Number | float]]
"""Gives a step's parts by any names, each one finite number per agent or one for all; the reward is their sum. A step
may leave some out, but not all."""


def enough_coverage(facts: StepFacts, constants: RewardConstants) -> Bool:
    """`(n,)` whether C ≥ τ."""
    return np.asarray(facts.coverage >= constants.stop_coverage)


def always(facts: StepFacts, constants: RewardConstants) -> Bool:
    """`(n,)` True."""
    return np.ones(len(facts.coverage), dtype=np.bool_)


def reward(
    *,
    needs_surface: bool = False,
    needs_parallax: bool = False,
    stops: bool | Callable[[StepFacts, RewardConstants], Bool] = False,
) -> Callable[[plugins.Function], plugins.Function]:
    """Declare what a `RewardFunction` needs; one without this decorator needs nothing.

    Args:
        needs_surface: `StepFacts.new_surface`, `surface`, `new_shown` and `shown` are computed, which takes time.
        needs_parallax: `StepFacts.new_shown_twice` and `shown_twice` too, which takes more.
        stops: whether there is the action stop; elsewhere it is "no movement". It ends the episode where this function
            of the step says so; True stands for `enough_coverage`.
    """
    return plugins.declares(
        needs_surface=needs_surface or needs_parallax,
        needs_parallax=needs_parallax,
        stops=enough_coverage if stops is True else stops,
    )


@reward()
def coverage(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """Eq. 24: α·Δc − P_collision."""
    return {"coverage": constants.alpha * facts.new_cells, "collision": -constants.collision * facts.collided}


@reward()
def coverage_redundancy(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """Eq. 25: α·Δc + λ_s·min(‖p − p̄‖, r_max) − P_redundancy − P_collision."""
    return {
        "coverage": constants.alpha * facts.new_cells,
        "spread": _spread(facts, constants),
        "collision": -constants.collision * facts.collided,
        "redundancy": -constants.redundancy * facts.redundant,
    }


@reward(stops=enough_coverage)
def proposed(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """Eq. 19–22: sublinear, visit-discounted coverage with dispersion, step cost and a learned stop."""
    new = _discounted(facts.new_cells, constants.alpha_proposed, facts, constants)
    success = constants.stop_bonus + constants.stop_per_step_left * facts.steps_left
    stop = np.where(enough_coverage(facts, constants), success, -constants.early_stop)
    return {"coverage": new} | _costs(facts, constants) | {"stop": np.where(facts.stop_chosen, stop, 0.0)}


@reward(needs_surface=True, stops=always)
def surface(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """`proposed` with new surface ΣΔQ in place of new cells Δc; stop pays for the share of the surface seen well."""
    new = _discounted(facts.new_surface, constants.alpha_surface, facts, constants)
    return {"surface": new} | _costs(facts, constants) | {"stop": _stop(facts.surface, facts, constants)}


@reward(needs_parallax=True, stops=always)
def multiview(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """`surface` with Σa·(w·ΔQ + (1 − w)·ΔS) in place of ΣΔQ, without the discount of visits.

    What a view adds is new already, and a turn on the spot is how a second place pays.
    """
    w = constants.single_weight
    grown = w * facts.new_shown + (1 - w) * facts.new_shown_twice
    new = constants.alpha_multiview * np.power(grown, constants.beta)
    stop = _stop(w * facts.shown + (1 - w) * facts.shown_twice, facts, constants)
    return {"multiview": new} | _costs(facts, constants) | {"stop": stop}


def _discounted(amount: Number, alpha: float, facts: StepFacts, constants: RewardConstants) -> Number:
    """α / (1 + 0.5·v) · amount^β."""
    return alpha / (1 + constants.visit_decay * facts.earlier_visits) * np.power(amount, constants.beta)


def _costs(facts: StepFacts, constants: RewardConstants) -> dict[str, Number]:
    """What `proposed`, `surface` and `multiview` share: dispersion and costs."""
    return {
        "spread": _spread(facts, constants),
        "step": np.full(len(facts.coverage), -constants.step),
        "collision": -constants.collision * facts.collided,
        "redundancy": -constants.redundancy * facts.redundant,
    }


def _stop(share: Number | float, facts: StepFacts, constants: RewardConstants) -> Number:
    """B_q · share where the episode is ended: going on pays while a view brings more than it costs."""
    return np.where(facts.stop_chosen, constants.stop_surface_bonus * share, 0.0)


def _spread(facts: StepFacts, constants: RewardConstants) -> Number:
    return constants.spread * np.minimum(facts.spread_m, constants.spread_limit_m)


REWARDS: dict[str, RewardFunction] = {
    "coverage": coverage,
    "coverage_redundancy": coverage_redundancy,
    "proposed": proposed,
    "surface": surface,
    "multiview": multiview,
}
"""What is built in, by name."""
REWARDS_HELP = f"{', '.join(REWARDS)} or MODULE:FUNCTION"
"""Help of the option `--reward`."""


def find_reward(reward: str | RewardFunction) -> RewardFunction:
    """The function of a reward, which is given by a name as `plugins.find` takes it, or itself.

    Raises:
        UsageError: no such reward, or it is no function of a step's facts and the constants.
    """
    found = plugins.find("avp.rewards", reward, REWARDS)
    try:
        inspect.signature(found).bind("facts", "constants")
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"reward {plugins.name_of(reward)!r}: expected a function of (facts, constants), got "
            f"{plugins.name_of(found)}: {error}"
        ) from None
    return found


def needs_surface(thing: Any) -> bool:
    """Whether a reward's function or an observation declares that it needs what was seen of the surface."""
    return bool(getattr(thing, "needs_surface", False)) or needs_parallax(thing)


def needs_parallax(thing: Any) -> bool:
    """Whether it declares that it needs how well the surface was seen along two rays."""
    return bool(getattr(thing, "needs_parallax", False))


def has_stop(reward: RewardFunction) -> bool:
    """Whether the stop action is available under this reward; elsewhere it is "no movement"."""
    return bool(getattr(reward, "stops", False))


def stops_always(reward: RewardFunction) -> bool:
    """Whether stop ends the episode whenever it is chosen."""
    return getattr(reward, "stops", None) is always


def stops_episode(reward: RewardFunction, facts: StepFacts, constants: RewardConstants) -> Bool:
    """`(n,)` whether stop was chosen where the reward lets it end the episode."""
    if not has_stop(reward):
        return np.zeros(len(facts.coverage), dtype=np.bool_)
    return facts.stop_chosen & reward.stops(facts, constants)  # type: ignore[attr-defined]


def stop_pays(reward: RewardFunction, facts: StepFacts, constants: RewardConstants) -> NDArray[np.float64]:
    """`(n,)` what choosing stop adds to the reward of a step."""
    totals = []
    for chosen in (True, False):
        parts = reward_parts(reward, replace(facts, stop_chosen=np.full(len(facts.coverage), chosen)), constants)
        totals.append(np.sum(list(parts.values()), axis=0))
    return totals[0] - totals[1]


def reward_parts(
    reward: RewardFunction, facts: StepFacts, constants: RewardConstants
) -> dict[str, NDArray[np.float64]]:
    """The parts of a reward that `find_reward` gave, `(n,)` each, as its function names them; the reward is their sum.

    Raises:
        UsageError: there is no part, or one is neither one finite number for each agent nor one for all of them.
    """
    parts = reward(facts, constants)
    if not isinstance(parts, Mapping) or not parts:
        got = "none" if isinstance(parts, Mapping) else type(parts).__name__
        raise UsageError(f"reward {plugins.name_of(reward)}: expected parts by name, as {{'new': …}}, got {got}")
    agents, checked = len(facts.coverage), {}
    for name, value in parts.items():
        try:
            checked[name] = _for_each(agents, value)
        except (TypeError, ValueError) as error:
            raise UsageError(f"reward {plugins.name_of(reward)}: part {name!r}: {error}") from None
    return checked


def _for_each(agents: int, value: Number | float) -> NDArray[np.float64]:
    numbers = np.asarray(value, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers, got {' '.join(repr(value).split())}")
    if numbers.shape not in ((), (agents,)):
        raise ValueError(f"expected one number for each of {agents} agents, got shape {numbers.shape}")
    return np.full(agents, numbers) if numbers.ndim == 0 else numbers
