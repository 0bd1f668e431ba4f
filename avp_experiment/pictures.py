"""The figures that are pictures of the scene: episodes from above, and held-out views with their renders."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from avp_experiment.configuration import TRAIN, UNSEEN, scene_slug
from avp_experiment.plots import WIDTH_IN, Drawn, Missing, new_figure
from avp_experiment.results import PICTURES, EpisodeResult, Results
from avp_habitat.metrics import FIGURES
from avp_habitat.poses import heading
from avp_habitat.rollout.images import read_rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOT_NAVIGABLE, NEVER = 0, 1
"""Numbers of a floor; one of 1 + t was first observed by view t."""
MAPS = ("heuristic", "coverage", "proposed", "nbv", "pretrained")
"""Methods of figure 5 where nobody chooses: the first three that are there."""
DEFAULT_RENDERS = ("heuristic", "proposed", "surface", "nbv", "pretrained", "pretrained_tuned", "survey", "coverage",
                   "greedy")  # fmt: skip
"""Methods of figure 6, as far as they are there; else the first ones."""
_COLUMNS = 5
_ARROW_M = 0.22
_UNSEEN_COLOUR, _PATH_COLOUR = "#C9CCD2", "#B22234"


def maps(results: Results, methods: Sequence[str] = ()) -> Drawn:
    """Figure 5: episodes from above, a row for the first scene of training and one for the first unseen one."""
    methods = methods or ([method for method in MAPS if method in results.methods] or results.methods)[:3]
    drawn = {(one.method, one.key[0]): one for one in results.rollouts if one.floor is not None}
    scenes = [names[0] for role in (TRAIN, UNSEEN) if (names := results.scenes(role))]
    scenes = [scene for scene in scenes if any((method, scene) in drawn for method in methods)]
    shown = [method for method in methods if any((method, scene) in drawn for scene in scenes)]
    if not shown:
        raise Missing(f"no episode of {', '.join(methods or MAPS)} has a map")
    numbers = {which: one.floor["numbers"] for which, one in drawn.items() if one.floor and which[0] in shown}
    last = max(int(floor.max()) - 1 for floor in numbers.values())
    tallest = [max(np.divide(*floor.shape) for (_, of), floor in numbers.items() if of == scene) for scene in scenes]
    width_in = (WIDTH_IN - 1.2) / len(shown)
    picture = new_figure(min(11.0, sum(share * width_in + 0.55 for share in tallest)))
    panels = picture.subplots(len(scenes), len(shown), squeeze=False, gridspec_kw={"height_ratios": tallest})
    image: Any = None
    for row, scene in zip(panels, scenes, strict=True):
        for axes, method in zip(row, shown, strict=True):
            if (method, scene) in drawn:
                image = _draw_map(axes, drawn[method, scene], last)
            else:
                axes.set_axis_off()
                axes.set_title(f"{method}: no episode", fontsize=9)
        row[0].set_ylabel(f"{scene}\nz [m]", fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("x [m]", fontsize=9)
    picture.colorbar(image, ax=panels.ravel().tolist(), label="cell first observed by view", shrink=0.8, pad=0.01)
    left_out = ", ".join(method for method in methods if method not in shown)
    caption = (
        "One episode of each method from above (seed 0, first start, the same place for all). Cells are shaded by the "
        "view that first observed them, grey: never observed. Red: the path; white dot: first view, red dot: last; "
        "arrows: where the camera faced."
    )
    return Drawn(picture, caption + (f" No map of {left_out}." if left_out else ""))


def same_views(results: Results, role: str) -> Drawn:
    """Figure 6: held-out views and what the reconstructions of some methods make of them, each with its PSNR."""
    if not results.scenes(role):
        raise Missing(f"no scene of role {role}")
    scene = results.scenes(role)[0]
    found = _pictures_by_view(results, scene)
    there = [method for method in results.methods if any(method in named for named in found.values())]
    columns = ["truth", *([method for method in DEFAULT_RENDERS if method in there] or there)[:_COLUMNS]]
    first = read_rgb(next(iter(found.values()))["truth"])
    height = WIDTH_IN / len(columns) * first.shape[0] / first.shape[1] + 0.3
    picture = new_figure(min(11.0, height * len(found) + 0.2))
    panels = picture.subplots(len(found), len(columns), squeeze=False)
    for line, (row, (number, named)) in enumerate(zip(panels, found.items(), strict=True)):
        scores = _view_scores(results, scene, number)
        for axes, name in zip(row, columns, strict=True):
            axes.set_axis_off()
            head = f"{name}\n" if line == 0 else ""
            psnr = f"{scores[name]:.1f} dB" if name in scores else f"view {number}" if name == "truth" else ""
            axes.set_title(head + psnr, fontsize=9)
            if name in named:
                axes.imshow(read_rgb(named[name]), interpolation="nearest")
    left_out = ", ".join(method for method in there if method not in columns)
    caption = (
        f"Held-out views {', '.join(map(str, found))} of {scene}: truth, and renders from the reconstructions of whole "
        "episodes (seed 0, first start), each with this view's PSNR."
    )
    return Drawn(picture, caption + (f" Not shown: {left_out}." if left_out else ""))


def _draw_map(axes: "Axes", rollout: EpisodeResult, last: int) -> Any:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    # Without its lightest part, which on white cannot be told from what is no floor.
    shades = ListedColormap(colormaps["YlGnBu"](np.linspace(0.2, 1, 256)))
    assert rollout.floor is not None
    numbers, cell, (x, z) = (rollout.floor[name] for name in ("numbers", "cell_m", "origin_m"))
    rows, columns = numbers.shape
    extent = (x, x + columns * cell, z + rows * cell, z)
    base = np.ma.masked_where(numbers == NOT_NAVIGABLE, np.zeros(numbers.shape))
    axes.imshow(base, extent=extent, cmap=ListedColormap([_UNSEEN_COLOUR]), interpolation="nearest")
    seen = np.ma.masked_where(numbers <= NEVER, numbers.astype(float) - 1)
    image = axes.imshow(seen, extent=extent, cmap=shades, vmin=1, vmax=last, interpolation="nearest")
    path = np.array(rollout.floor["path"], dtype=np.float64).reshape(-1, 3)
    ahead = heading(path[:, 2])[:, [0, 2]]
    axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.2)
    axes.plot(path[:, 0], path[:, 1], color=_PATH_COLOUR, linewidth=1.6)
    arrows: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.0035, "headwidth": 4}
    axes.quiver(*path[:, :2].T, *ahead.T, scale=1 / _ARROW_M, color="black", zorder=4, **arrows)
    for place, colour in ((path[0], "white"), (path[-1], _PATH_COLOUR)):
        axes.plot(*place[:2], "o", color=colour, markeredgecolor="black", markersize=6, zorder=5)
    covered = FIGURES["coverage"].scale * rollout.metrics["coverage"]
    axes.set_title(f"{rollout.method}: {len(path)} views, {covered:.0f} % coverage", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_facecolor("white")
    axes.set_aspect("equal")
    return image


def _pictures_by_view(results: Results, scene: str) -> dict[int, dict[str, Path]]:
    """Held-out views that have a render, by number: the truth's file, then those of methods in order."""
    slug = scene_slug(scene)
    found: dict[int, dict[str, Path]] = {}
    for truth in sorted((results.folder / PICTURES).glob(f"{slug}-truth-*.png")):
        number = truth.stem.rpartition("-")[2]
        files = {method: truth.with_name(f"{slug}-{method}-{number}.png") for method in results.methods}
        renders = {method: path for method, path in files.items() if path.is_file()}
        if number.isdigit() and renders:
            found[int(number)] = {"truth": truth} | renders
    if not found:
        raise Missing(f"no picture of a held-out view of {scene} with a render of it in {PICTURES}/")
    return dict(sorted(found.items()))


def _view_scores(results: Results, scene: str, number: int) -> dict[str, float]:
    whole = [one for one in results.reconstructions if one.whole and one.key == (scene, 0, 0)]
    found = {one.method: one.psnr_by_view[number] for one in whole if number < len(one.psnr_by_view)}
    return {method: psnr for method, psnr in found.items() if psnr is not None}
