"""How well what the frames have seen predicts the reconstruction: points, and their rank correlations."""

from collections.abc import Sequence
from dataclasses import dataclass

from experiment.statistics import Correlation, spearman
from experiment.stored import Results

POINT_NAMES = ("visibility", "coverage")
"""What may predict PSNR."""


@dataclass(frozen=True)
class Point:
    """One reconstruction."""

    method: str
    """That took its views."""
    scene: str
    """Its name."""
    rollout: tuple[str, str, int, int]
    """Method, scene, seed and start."""
    whole: bool
    """Whether it was made of all frames of its episode."""
    visibility: float
    """Share of the held-out pixels that its frames have seen."""
    coverage: float
    """Share of the navigable cells that its frames have observed."""
    psnr: float
    """In dB."""

    def share(self, name: str) -> float:
        """Visibility or coverage."""
        return self.visibility if name == "visibility" else self.coverage


@dataclass(frozen=True)
class Entry:
    """A correlation with its name."""

    where: str
    """Which reconstructions."""
    found: Correlation | None
    """None where there are too few."""


def points_of(results: Results) -> list[Point]:
    """All reconstructions of which visibility, coverage and PSNR are known."""
    curves = {(one.method, *one.key): one.coverage_curve for one in results.rollouts}
    points = []
    for one in results.reconstructions:
        curve = curves.get((one.method, *one.key), ())
        if one.visibility is None or "psnr" not in one.scores or not 1 <= one.frames <= len(curve):
            continue
        rollout = (one.method, *one.key)
        points.append(
            Point(one.method, one.key[0], rollout, one.whole, one.visibility, curve[one.frames - 1], one.scores["psnr"])
        )
    return points


def correlations(points: Sequence[Point], name: str) -> list[Entry]:
    """Spearman's ρ of visibility or coverage with PSNR: over all, of whole episodes, of first frames, in each scene.

    Args:
        points: of all reconstructions.
        name: visibility or coverage.
    """
    whole = [point for point in points if point.whole]
    groups = {"all": list(points), "whole episodes": whole, "first frames": [one for one in points if not one.whole]}
    scenes = list(dict.fromkeys(point.scene for point in points))
    for scene in scenes if len(scenes) > 1 else []:
        groups[f"all in {scene}"] = [point for point in points if point.scene == scene]
        groups[f"whole episodes in {scene}"] = [point for point in whole if point.scene == scene]
    return [
        Entry(
            where,
            spearman(
                [point.share(name) for point in group],
                [point.psnr for point in group],
                [point.rollout for point in group],
            ),
        )
        for where, group in groups.items()
    ]
