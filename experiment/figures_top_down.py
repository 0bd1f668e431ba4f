"""The figures that are pictures of the scene: top-down maps of episodes, and a held-out view with its renders."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from avp_habitat.errors import AVPError
from avp_habitat.images import read_rgb
from avp_habitat.poses import heading
from experiment.figures import Made, Missing
from experiment.floor_map import NEVER, NOT_NAVIGABLE, floor_of
from experiment.look import WIDTH_IN, new_figure
from experiment.stored import Reconstruction, Results, Rollout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DEFAULT_MAPS = ("heuristic", "coverage", "proposed")
"""Methods of figure 5."""
PICTURES = "pictures"
_ARROW_M = 0.22
_UNSEEN_COLOUR, _OUTSIDE_COLOUR = "#C9CCD2", "#FFFFFF"
_PATH_COLOUR = "#B22234"
_COLUMNS = 4


def maps(results: Results, methods: Sequence[str] = DEFAULT_MAPS) -> Made:
    """Figure 5: episodes from above, a row for the first scene of training and one for the first unseen one."""
    drawn = {(one.method, one.key[0]): one for one in results.rollouts if one.floor is not None}
    scenes = [names[0] for role in ("train", "unseen") if (names := results.scenes(role))]
    scenes = [scene for scene in scenes if any((method, scene) in drawn for method in methods)]
    shown = [method for method in methods if any((method, scene) in drawn for scene in scenes)]
    if not shown:
        raise Missing(f"no episode of {', '.join(methods)} has a map")
    numbers = {which: floor_of(dict(one.floor or {})) for which, one in drawn.items() if which[0] in shown}
    last = max(int(floor.max()) - 1 for floor in numbers.values())
    tallest = [max(_height_share(numbers[m, scene]) for m in shown if (m, scene) in numbers) for scene in scenes]
    width_in = (WIDTH_IN - 1.2) / len(shown)
    picture = new_figure(min(11.0, sum(share * width_in + 0.55 for share in tallest)))
    panels = picture.subplots(len(scenes), len(shown), squeeze=False, gridspec_kw={"height_ratios": tallest})
    image: Any = None
    for row, scene in zip(panels, scenes, strict=True):
        for axes, method in zip(row, shown, strict=True):
            rollout = drawn.get((method, scene))
            if rollout is None:
                axes.set_axis_off()
                axes.set_title(f"{method}: no episode", fontsize=9)
                continue
            image = _draw_map(axes, rollout, numbers[method, scene], last)
        row[0].set_ylabel(f"{scene}\nz [m]", fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("x [m]", fontsize=9)
    picture.colorbar(image, ax=panels.ravel().tolist(), label="cell first observed by view", shrink=0.8, pad=0.01)
    left_out = [method for method in methods if method not in shown]
    note = f" No map of {', '.join(left_out)}." if left_out else ""
    caption = (
        "One episode of each method from above (seed 0, first start, the same place for all). Cells are shaded by the "
        "view that first observed them, grey: never observed. Red: the path; white dot: first view, red dot: last; "
        "arrows: where the camera faced."
    )
    return Made(picture, caption + note)


def same_view(results: Results, role: str) -> Made:
    """Figure 6: a held-out view and its renders from every method's reconstruction, with its PSNR below each."""
    scenes = results.scenes(role)
    if not scenes:
        raise Missing(f"no scene of role {role}")
    scene = scenes[0]
    number, found = _most_pictures(results, scene)
    panels_of = [("truth", found.pop("truth")), *found.items()]
    first = read_rgb(panels_of[0][1])
    rows = -(-len(panels_of) // _COLUMNS)
    height = WIDTH_IN / _COLUMNS * first.shape[0] / first.shape[1] + 0.4
    picture = new_figure(height * rows)
    panels = picture.subplots(rows, _COLUMNS, squeeze=False).ravel()
    scores = _view_scores(results, scene, number)
    for axes in panels:
        axes.set_axis_off()
    for axes, (name, path) in zip(panels, panels_of, strict=False):
        axes.imshow(_picture(path), interpolation="nearest")
        psnr = scores.get(name)
        axes.set_title(name if psnr is None else f"{name}: {psnr:.1f} dB", fontsize=10)
    caption = (
        f"Held-out view {number} of {scene}: truth, and renders from the reconstructions of whole episodes (seed 0, "
        "first start), each with this view's PSNR."
    )
    return Made(picture, caption)


def _height_share(floor: np.ndarray) -> float:
    return floor.shape[0] / floor.shape[1]


def _draw_map(axes: "Axes", rollout: Rollout, numbers: np.ndarray, last: int) -> Any:
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    # Without its lightest part, which on white cannot be told from what is no floor.
    shades = ListedColormap(colormaps["YlGnBu"](np.linspace(0.2, 1, 256)))
    assert rollout.floor is not None
    cell, (x, z), (rows, columns) = (rollout.floor[name] for name in ("cell_m", "origin_m", "shape"))
    extent = (x, x + columns * cell, z + rows * cell, z)
    base = np.ma.masked_where(numbers == NOT_NAVIGABLE, np.zeros(numbers.shape))
    axes.imshow(base, extent=extent, cmap=ListedColormap([_UNSEEN_COLOUR]), interpolation="nearest")
    seen = np.ma.masked_where(numbers <= NEVER, numbers.astype(float) - 1)
    image = axes.imshow(seen, extent=extent, cmap=shades, vmin=1, vmax=last, interpolation="nearest")
    path = np.array(rollout.floor["path"], dtype=np.float64).reshape(-1, 3)
    ahead = heading(path[:, 2])[:, [0, 2]]
    axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.2)
    axes.plot(path[:, 0], path[:, 1], color=_PATH_COLOUR, linewidth=1.6)
    arrows: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1 / _ARROW_M,
        "width": 0.0035,
        "headwidth": 4,
    }
    axes.quiver(path[:, 0], path[:, 1], ahead[:, 0], ahead[:, 1], color="black", zorder=4, **arrows)
    for place, colour in ((path[0], "white"), (path[-1], _PATH_COLOUR)):
        axes.plot(*place[:2], "o", color=colour, markeredgecolor="black", markersize=6, zorder=5)
    axes.set_title(
        f"{rollout.method}: {len(path)} views, {100 * rollout.metrics['coverage']:.0f} % coverage", fontsize=9
    )
    axes.tick_params(labelsize=8)
    axes.set_facecolor(_OUTSIDE_COLOUR)
    axes.set_aspect("equal")
    return image


def _most_pictures(results: Results, scene: str) -> tuple[int, dict[str, Path]]:
    """The held-out view that most methods have a render of, and its pictures: the truth, then methods in order."""
    slug = Path(scene).stem.replace(":", "_")
    found: dict[int, dict[str, Path]] = {}
    for truth in sorted((results.folder / PICTURES).glob(f"{slug}-truth-*.png")):
        number = truth.stem.rpartition("-")[2]
        named = {"truth": truth} | {
            method: path
            for method in results.methods
            if (path := truth.with_name(f"{slug}-{method}-{number}.png")).is_file()
        }
        if number.isdigit() and len(named) > 1:
            found[int(number)] = named
    if not found:
        raise Missing(f"no picture of a held-out view of {scene} with a render of it in {PICTURES}/")
    best = max(found, key=lambda number: (len(found[number]), -number))
    return best, found[best]


def _view_scores(results: Results, scene: str, number: int) -> dict[str, float]:
    def shown(one: Reconstruction) -> bool:
        return one.whole and one.key == (scene, 0, 0) and number < len(one.psnr_by_view)

    found = {one.method: one.psnr_by_view[number] for one in results.reconstructions if shown(one)}
    return {method: psnr for method, psnr in found.items() if psnr is not None}


def _picture(path: Path) -> np.ndarray:
    try:
        return read_rgb(path)
    except (OSError, ValueError, SyntaxError) as error:
        raise AVPError(f"{path}: expected a PNG, could not read it: {error}") from None
