"""How a viewer lays out rollouts: one of them like an episode, several side by side, each beside what it came from."""

from collections.abc import Mapping

import rerun.blueprint as rrb

from avp_sb3.rerun_layout import layout

_STEPS_PER_SECOND = 10.0
_BACKGROUND = (30, 32, 38)


def rollout_blueprint(roots: Mapping[str, str], *, with_map: bool) -> rrb.Blueprint:
    """Tabs: all rollouts side by side where there are several, each by itself, and what each came from.

    Args:
        roots: the name of each rollout by its entity path.
        with_map: whether they have maps.
    """
    tabs = [layout(root, name, with_map=with_map) for root, name in roots.items()]
    abouts = [rrb.TextDocumentView(origin=f"{root}/about", name=name) for root, name in roots.items()]
    if len(roots) > 1:
        tabs.insert(0, _side_by_side(roots))
    about = rrb.Horizontal(*abouts, name="about")
    return rrb.Blueprint(
        rrb.Tabs(*tabs, about, active_tab=0),
        rrb.TimePanel(timeline="step", fps=_STEPS_PER_SECOND),
        auto_views=False,
        collapse_panels=True,
    )


def _side_by_side(roots: Mapping[str, str]) -> rrb.Container:
    """The rooms, below each what its camera sees, below all their coverage in one plot."""
    # The depth picture would be drawn as a second cloud over the room.
    seen = ["$origin/**", "- $origin/camera/depth"]
    rooms = [
        rrb.Spatial3DView(origin=f"{root}/world", contents=seen, name=name, background=_BACKGROUND, line_grid=False)
        for root, name in roots.items()
    ]
    cameras = [rrb.Spatial2DView(origin=f"{root}/world/camera/rgb", name=name) for root, name in roots.items()]
    coverage = [f"{root}/plots/coverage" for root in roots]
    return rrb.Vertical(
        rrb.Horizontal(*rooms),
        rrb.Horizontal(*cameras),
        rrb.TimeSeriesView(origin="/", contents=coverage, name="coverage"),
        row_shares=[4, 3, 2],
        name="side by side",
    )
