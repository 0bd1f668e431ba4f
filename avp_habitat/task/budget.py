"""How many views a scene of some size gets: `--budget auto`."""

from typing import Literal

VIEWS_PER_M2 = 3.2
"""Of `auto`, per square metre of navigable floor: 25 m² get the 80 views of the paper."""
LEAST, MOST = 20, 400
"""Views that `auto` gives at least and at most."""
Budget = int | Literal["auto"]
"""A number of views, or `auto`."""
BUDGET_HELP = f"steps, which are views; auto: {VIEWS_PER_M2:g} per m² of navigable floor, {LEAST} to {MOST}"
"""Help of the option `--budget`."""


def views_for(area_m2: float) -> int:
    """What `auto` gives a scene with so much navigable floor."""
    return min(max(round(VIEWS_PER_M2 * area_m2), LEAST), MOST)


def budget_for(budget: Budget, area_m2: float) -> int:
    """The number itself, or what `auto` gives a scene with so much navigable floor; then it says so in one line."""
    if budget != "auto":
        return budget
    views = views_for(area_m2)
    print(f"budget: {views} views for {area_m2:.1f} m² of floor", flush=True)
    return views
