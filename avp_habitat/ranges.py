"""Settings that say their ranges in their types, and the one function that holds them."""

from dataclasses import dataclass, fields
from functools import cache
from numbers import Real
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from avp_habitat.errors import UsageError, unknown_name


@dataclass(frozen=True)
class Range:
    """Numbers from `least` to `most`, both allowed: `width: Annotated[int, Range(1, 4096)]`."""

    least: float
    most: float


def hold_ranges(settings: Any) -> None:
    """Hold every number of a dataclass, frozen or not, to the range of its type, and every `Literal` to its values.

    Whole numbers of any kind (160.0, numpy's) become `int` and others `float`, so that settings look alike
    however they were given.

    Raises:
        UsageError: a value is no such number, is NaN or infinite, or lies outside; the text names the field.
    """
    for name, hint in _hints(type(settings)).items():
        value = getattr(settings, name)
        limits = next((part for part in get_args(hint) if isinstance(part, Range)), None)
        if get_origin(hint) is Annotated and limits is not None:
            kind = get_args(hint)[0]
            object.__setattr__(settings, name, number(name, value, kind, limits))
        elif get_origin(hint) is Literal and value not in get_args(hint):
            raise unknown_name(name, str(value), get_args(hint))
        elif hint is bool and not isinstance(value, bool):
            raise UsageError(f"{name}: expected True or False, got {value!r}")


def number(name: str, value: Any, kind: type, limits: Range) -> Any:
    """The number that a user gave for an option as `kind` (`int` or `float`).

    Raises:
        UsageError: it is no such number.
    """
    whole = kind is int
    # Truth values are whole numbers to Python, and texts none.
    real = isinstance(value, Real) and not isinstance(value, bool)
    given: Any = value
    if not real or not limits.least <= given <= limits.most or (whole and given % 1):
        least, most = (f"{limit:,.0f}" if whole else f"{limit:,g}" for limit in (limits.least, limits.most))
        expected = f"a {'whole ' if whole else ''}number from {least} to {most}"
        raise UsageError(f"{name}: expected {expected}, got {value!r}")
    return kind(given)


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}
