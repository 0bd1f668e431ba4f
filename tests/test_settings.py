"""Settings hold their ranges, whoever gives the values, and look alike however they were given."""

import math
from dataclasses import asdict, fields, replace
from typing import Annotated, get_args, get_origin, get_type_hints

import gymnasium
import numpy as np
import pytest

from avp_habitat.errors import UsageError
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import TaskSettings

KINDS = (TaskSettings, RewardConstants, NavigationSettings)


def numbers_of(kind):
    """Name, type and range of every number."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Annotated}


NUMBERS = [(kind, name, *about) for kind in KINDS for name, about in numbers_of(kind).items()]


def test_every_number_has_a_range_and_its_default_lies_within():
    for kind in KINDS:
        plain = {field.name for field in fields(kind) if isinstance(field.default, (int, float))}
        assert plain - set(numbers_of(kind)) <= {"lookup"}
        kind()
    assert len(NUMBERS) > 30


@pytest.mark.parametrize(("kind", "name", "number", "limits"), NUMBERS, ids=lambda value: str(value)[:20])
def test_what_is_outside_the_range_or_no_number_is_refused_by_name(kind, name, number, limits):
    below, above = limits.least - 1e-3, limits.most * 1.01
    whole = [limits.least + 0.5] if number is int else []
    for value in (math.nan, math.inf, -math.inf, below, above, 10**400, True, "1", None, 1j, np.array([1.0]), *whole):
        with pytest.raises(UsageError, match=rf"^{name}: expected a (whole )?number from .* to .*, got"):
            kind(**{name: value})


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({"width": 160.0}, 160),
        ({"width": np.int64(160)}, 160),
        ({"budget": np.float32(12)}, 12),
        ({"forward_m": 1}, 1.0),
        ({"forward_m": np.float64(0.5)}, 0.5),
        ({"turn_deg": np.int8(15)}, 15.0),
    ],
)
def test_numbers_of_any_kind_become_plain_ones(given, kept):
    (name,) = given
    value = asdict(TaskSettings(**given))[name]
    assert value == kept
    assert type(value) is type(kept)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"collision_m": 0.25}, r"^collision_m: expected less than forward_m \(0.25\), or every move is a collision"),
        ({"forward_m": 0.05}, r"^collision_m: expected less than forward_m \(0.05\)"),
        ({"coverage_mode": "under"}, "unknown coverage_mode 'under': expected one of over, visible"),
        ({"observation": "maps"}, "unknown observation 'maps': .*did you mean 'map'"),
        ({"lookup": "no"}, "^lookup: expected True or False, got 'no'"),
        ({"width": 2.5}, "^width: expected a whole number from 1 to 4,096, got 2.5"),
    ],
)
def test_what_does_not_fit_together_or_has_no_such_value_is_refused(change, words):
    with pytest.raises(UsageError, match=words):
        replace(TaskSettings(), **change)


def test_the_environments_own_overrides_are_held_too():
    with pytest.raises(UsageError, match="tolerance_m: expected a number from 0 to 1, got nan"):
        gymnasium.make("avp_habitat:AVP-v0", scene="builtin:0", tolerance_m=math.nan)


def test_a_budget_is_one_whose_steps_can_be_counted():
    """The step that first saw a cell is kept in 16 bits, and would be negative beyond."""
    assert TaskSettings(budget=32767).budget == np.iinfo(np.int16).max
    with pytest.raises(UsageError, match="budget: expected a whole number from 1 to 32,767, got 32768"):
        TaskSettings(budget=32768)
