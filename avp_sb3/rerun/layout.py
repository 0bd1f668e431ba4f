"""How a viewer lays out episodes of a training, and rollouts side by side."""

from collections.abc import Mapping

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from avp_habitat.task.settings import ACTION_NAMES

_WINDOW_STEPS = 120
_STEPS_PER_SECOND = 10.0
_BACKGROUND = (30, 32, 38)
_ACTIONS = ", ".join(f"{number} {name.split('_')[-1]}" for number, name in enumerate(ACTION_NAMES))
_EYE_DIRECTION = np.array([0.2, 1.0, 0.45])


def eye_above(points: NDArray[np.floating]) -> rrb.EyeControls3D:
    """An eye that sees all of a scene, given at least one of its `(n, 3)` points, from above at a slant."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    target = (low + high) / 2
    position = target + _EYE_DIRECTION * (1.5 + max(high - low))
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 1, 0))


def training_blueprint(eyes: Mapping[str, rrb.EyeControls3D | None]) -> rrb.Blueprint:
    """The layout of every scene, in tabs when there are several, with the figures of all episodes.

    `eyes` says by the scene's entity path from where it is seen first; Rerun's choice when None.
    """
    parts = []
    for root, eye in eyes.items():
        plots = rrb.Tabs(_step_plots(root), *_episode_plots())
        parts.append(_episode(root, root.strip("/") or "episode", plots, eye=eye))
    panel = rrb.TimePanel(state="collapsed", timeline="step", fps=_STEPS_PER_SECOND)
    return rrb.Blueprint(parts[0] if len(parts) == 1 else rrb.Tabs(*parts), panel, collapse_panels=True)


def rollout_blueprint(roots: Mapping[str, str], *, with_map: bool) -> rrb.Blueprint:
    """Tabs: all rollouts (names by entity path) side by side if several, each by itself, and what each came from."""
    tabs = [_episode(root, name, _step_plots(root), with_map=with_map) for root, name in roots.items()]
    if len(roots) > 1:
        tabs.insert(0, _side_by_side(roots))
    abouts = [rrb.TextDocumentView(origin=f"{root}/about", name=name) for root, name in roots.items()]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, rrb.Horizontal(*abouts, name="about"), active_tab=0),
        rrb.TimePanel(timeline="step", fps=_STEPS_PER_SECOND),
        auto_views=False,
        collapse_panels=True,
    )


def _episode(
    root: str, name: str, plots: rrb.Container, *, with_map: bool = False, eye: rrb.EyeControls3D | None = None
) -> rrb.Container:
    """The scene, beside it the camera, the map of a rollout and the plots."""
    origins = {"RGB": "world/camera/rgb", "depth": "world/camera/depth"} | ({"map": "map"} if with_map else {})
    pictures = [rrb.Spatial2DView(origin=f"{root}/{origin}", name=title) for title, origin in origins.items()]
    right = rrb.Vertical(rrb.Horizontal(*pictures), plots, row_shares=[2, 5])
    return rrb.Horizontal(_scene(root, name, eye), right, column_shares=[3, 2], name=name)


def _scene(root: str, name: str, eye: rrb.EyeControls3D | None = None) -> rrb.View:
    return rrb.Spatial3DView(
        origin=f"{root}/world",
        # The depth picture would be drawn as a second cloud, in false colours over the room.
        contents=["$origin/**", "- $origin/camera/depth"],
        name=name,
        background=_BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )


def _step_plots(root: str) -> rrb.Container:
    """Coverage of all recorded episodes; rewards and actions around the current step, where they can be told apart."""
    around = rrb.VisibleTimeRange(
        "step",
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-_WINDOW_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=_WINDOW_STEPS),
    )
    without = rrb.PlotLegend(visible=False)
    legend, plots = rrb.Corner2D.RightTop, f"{root}/plots"
    return rrb.Vertical(
        rrb.TimeSeriesView(origin=f"{plots}/coverage", name="coverage", plot_legend=without),
        rrb.TimeSeriesView(origin=f"{plots}/reward", name="reward parts", time_ranges=around, plot_legend=legend),
        rrb.TimeSeriesView(origin=f"{plots}/action", name=_ACTIONS, time_ranges=around, plot_legend=without),
        row_shares=[2, 3, 2],
        name="steps",
    )


def _episode_plots() -> list[rrb.Container | rrb.View]:
    """The figures of the episodes as curves and as a table."""
    shares, returns = ("coverage", "ei", "stopped"), "$origin/return/**"
    rest = ["$origin/**", f"- {returns}", *(f"- $origin/{name}" for name in shares)]
    curves = rrb.Vertical(
        rrb.TimeSeriesView(origin="/metrics", contents=[f"$origin/{name}" for name in shares], name="coverage, EI"),
        rrb.TimeSeriesView(origin="/metrics", contents=rest, name="views, metres, counts"),
        rrb.TimeSeriesView(origin="/metrics", contents=returns, name="returns"),
        name="episodes",
    )
    query = rrb.archetypes.DataframeQuery(timeline="episode")
    return [curves, rrb.DataframeView(origin="/metrics", query=query, name="table")]


def _side_by_side(roots: Mapping[str, str]) -> rrb.Container:
    """The rooms, below each what its camera sees, below all their coverage in one plot."""
    cameras = [rrb.Spatial2DView(origin=f"{root}/world/camera/rgb", name=name) for root, name in roots.items()]
    return rrb.Vertical(
        rrb.Horizontal(*(_scene(root, name) for root, name in roots.items())),
        rrb.Horizontal(*cameras),
        rrb.TimeSeriesView(origin="/", contents=[f"{root}/plots/coverage" for root in roots], name="coverage"),
        row_shares=[4, 3, 2],
        name="side by side",
    )
