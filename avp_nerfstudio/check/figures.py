"""The picture of a check: the fused cloud with all cameras, from above and from the side."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_nerfstudio.check.cloud import Cloud, frusta, frustum_colours
from avp_nerfstudio.check.hypotheses import Cameras
from avp_nerfstudio.check.verdict import Verdict

_ABOVE_CAMERAS_M = 0.3
_MOST_POINTS = 150_000
_OUTLIERS = 0.5
_GROUND = "#f4f4f2"
_POINT = 4.0
"""Area of a point, square typographic points: so large that surfaces close and hide what lies behind them."""


def draw_overview(path: Path, cloud: Cloud, cameras: Cameras, bad: NDArray[np.bool_], verdicts: list[Verdict]) -> None:
    """Write the picture as PNG.

    Args:
        path: the file.
        cloud: of the frames.
        cameras: drawn as pyramids.
        bad: `(n,)` those drawn red.
        verdicts: named in the title.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    kept = np.random.default_rng(0).permutation(len(cloud.points))[:_MOST_POINTS]
    points, colours = cloud.points[kept], cloud.colours[kept] / 255
    centres = cameras.poses[:, :3, 3]
    # A ceiling would hide the room.
    below = points[:, 1] < centres[:, 1].max() + _ABOVE_CAMERAS_M
    lines, line_colours = frusta(cameras), frustum_colours(bad) / 255
    figure = Figure(figsize=(14, 6.5), layout="constrained")
    behind = points[:, 2] < np.median(centres[:, 2])
    for axes, (across, along), towards, chosen, title in (
        (*_pair(figure, 0), 1, below, "from above, without the ceiling"),
        (*_pair(figure, 1), 2, behind, "from the side, without the nearer half"),
    ):
        order = np.flatnonzero(chosen)[np.argsort(points[chosen, towards])]
        axes.scatter(
            points[order, across], points[order, along], s=_POINT, c=colours[order], linewidths=0, rasterized=True
        )
        axes.add_collection(LineCollection(list(lines[:, :, [across, along]]), colors=line_colours, linewidths=0.6))
        axes.set_aspect("equal")
        axes.set_xlabel(f"{'xyz'[across]} [m]")
        axes.set_ylabel(f"{'xyz'[along]} [m]")
        _limit(axes, np.concatenate([points[chosen], centres]), across, along)
        axes.set_title(title)
    failed = [verdict.name for verdict in verdicts if not verdict.passed]
    good, wrong = f"{(~bad).sum()} cameras agree (blue)", f"{bad.sum()} disagree (red)"
    figure.suptitle(f"{'FAILED: ' + ', '.join(failed) if failed else 'all checks passed'}; {good}, {wrong}")
    figure.savefig(path, format="png", dpi=110)


def _pair(figure, column: int):
    """The axes of a view and the two coordinates it shows; from above z points down, as on a map."""
    axes = figure.add_subplot(1, 2, column + 1, facecolor=_GROUND)
    if column == 0:
        axes.invert_yaxis()
    return axes, ((0, 2), (0, 1))[column]


def _limit(axes, points: NDArray[np.floating], across: int, along: int) -> None:
    """Leave out the few points that fly far away when poses are wrong."""
    for axis, setter in ((across, axes.set_xlim), (along, axes.set_ylim)):
        low, high = np.percentile(points[:, axis], [_OUTLIERS, 100 - _OUTLIERS])
        margin = 0.08 * (high - low) + 0.1
        limits = (low - margin, high + margin)
        setter(limits[::-1] if axis == 2 else limits)
