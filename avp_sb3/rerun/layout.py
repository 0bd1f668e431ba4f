"""How a viewer lays out rollouts: one of them like an episode, several side by side, each beside what it came from."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from avp_habitat.task.settings import ACTION_NAMES

APPLICATION = "avp"
_WINDOW_STEPS = 120
_STEPS_PER_SECOND = 10.0
_BACKGROUND = (30, 32, 38)
_ACTIONS = ", ".join(f"{number} {name.split('_')[-1]}" for number, name in enumerate(ACTION_NAMES))
_EYE_DIRECTION = np.array([0.2, 1.0, 0.45])


def eye_above(points: NDArray[np.floating]) -> rrb.EyeControls3D:
    """An eye that sees all of a scene from above, at a slant.

    Args:
        points: `(n, 3)` of the scene, metres, world frame; at least one.
    """
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    target = (low + high) / 2
    position = target + _EYE_DIRECTION * (1.5 + max(high - low))
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 1, 0))


def layout(
    root: str, name: str, *, with_map: bool, with_metrics: bool = False, eye: rrb.EyeControls3D | None = None
) -> rrb.Container:
    """How a viewer arranges one root: the scene, beside it the camera, the map of a rollout and the plots.

    Args:
        root: entity path above `world` and `plots`.
        name: of its tab.
        with_map: whether there is a picture `map`.
        with_metrics: whether the figures of all episodes are shown too, from `/metrics`.
        eye: from where the scene is seen first; Rerun's choice when omitted.
    """
    camera = f"{root}/world/camera"
    maps = [rrb.Spatial2DView(origin=f"{root}/map", name="map")] if with_map else []
    return rrb.Horizontal(
        rrb.Spatial3DView(
            origin=f"{root}/world",
            # The depth picture would be drawn as a second cloud, in false colours over the room.
            contents=["$origin/**", "- $origin/camera/depth"],
            name=name,
            background=_BACKGROUND,
            line_grid=False,
            eye_controls=eye,
        ),
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=f"{camera}/rgb", name="RGB"),
                rrb.Spatial2DView(origin=f"{camera}/depth", name="depth"),
                *maps,
            ),
            rrb.Tabs(_step_plots(root), *(_metrics() if with_metrics else [])) if with_metrics else _step_plots(root),
            row_shares=[2, 5],
        ),
        column_shares=[3, 2],
        name=name,
    )


def blueprint(
    roots: Sequence[str],
    *,
    with_map: bool = False,
    with_metrics: bool = False,
    eyes: Mapping[str, rrb.EyeControls3D] | None = None,
) -> rrb.Blueprint:
    """The layout of every root, in tabs when there are several, played by `step`; `eyes` are those of some roots."""
    eyes = eyes or {}
    parts = [
        layout(root, root.strip("/") or "episode", with_map=with_map, with_metrics=with_metrics, eye=eyes.get(root))
        for root in roots
    ]
    top = parts[0] if len(parts) == 1 else rrb.Tabs(*parts)
    panel = rrb.TimePanel(state="collapsed", timeline="step", fps=_STEPS_PER_SECOND)
    return rrb.Blueprint(top, panel, collapse_panels=True)


def _step_plots(root: str) -> rrb.Container:
    """Coverage of all recorded episodes; rewards and actions around the current step, where they can be told apart."""
    around = rrb.VisibleTimeRange(
        "step",
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-_WINDOW_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=_WINDOW_STEPS),
    )
    without_legend = rrb.PlotLegend(visible=False)
    return rrb.Vertical(
        rrb.TimeSeriesView(origin=f"{root}/plots/coverage", name="coverage", plot_legend=without_legend),
        rrb.TimeSeriesView(
            origin=f"{root}/plots/reward", name="reward parts", time_ranges=around, plot_legend=rrb.Corner2D.RightTop
        ),
        rrb.TimeSeriesView(
            origin=f"{root}/plots/action", name=_ACTIONS, time_ranges=around, plot_legend=without_legend
        ),
        row_shares=[2, 3, 2],
        name="steps",
    )


def _metrics() -> list[rrb.Container | rrb.View]:
    """The figures of the episodes as curves and as a table."""
    shares, returns = ("coverage", "ei", "stopped"), "$origin/return/**"
    curves = rrb.Vertical(
        rrb.TimeSeriesView(origin="/metrics", contents=[f"$origin/{name}" for name in shares], name="coverage, EI"),
        rrb.TimeSeriesView(
            origin="/metrics",
            contents=["$origin/**", f"- {returns}", *(f"- $origin/{name}" for name in shares)],
            name="views, metres, counts",
        ),
        rrb.TimeSeriesView(origin="/metrics", contents=returns, name="returns"),
        name="episodes",
    )
    query = rrb.archetypes.DataframeQuery(timeline="episode")
    return [curves, rrb.DataframeView(origin="/metrics", query=query, name="table")]


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
