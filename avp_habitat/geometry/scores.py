"""The field's figures of geometry, each as it is usually defined, and never the one for the other."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.geometry.fusion import Fusion
from avp_habitat.geometry.shape import Shape
from avp_habitat.geometry.truth import CAMERA, SAMPLES, SceneTruth
from avp_habitat.metrics import NEAR_M
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import read_depth


@dataclass(frozen=True)
class GeometryScores:
    """How a reconstructed shape compares with a scene. Lengths in metres, shares within [0, 1]."""

    accuracy_m: float
    """Mean distance from the reconstruction to the scene's nearest surface, whether that can be seen or not."""
    completion_m: float
    """Mean distance from the observable surface to the reconstruction."""
    chamfer_m: float
    """Chamfer-L1: the mean of these two."""
    precision: float
    """Share of the reconstruction that lies within `NEAR_M` of the scene."""
    completion_ratio: float
    """Share of the observable surface that lies within `NEAR_M` of the reconstruction; recall."""
    f_score: float
    """Harmonic mean of these two (Knapitsch et al., 2017, "Tanks and Temples")."""
    depth_l1_m: float
    """Mean absolute difference of the depths that both show in the held-out views; where the reconstruction shows
    nothing, the whole depth counts."""

    def figures(self) -> dict[str, float]:
        """By the names of `metrics.FIGURES`."""
        return asdict(self)


def score(shape: Shape, truth: SceneTruth, *, samples: int = SAMPLES) -> GeometryScores:
    """Compare a shape, in the scene's frame, with what is known of the scene.

    Distances are exact, from so many points of the shape to the scene's triangles, and from the truth's points to the
    shape's.
    """
    to_scene = truth.whole.distance(shape.samples(samples)).astype(np.float64)
    to_shape = shape.distance(truth.observable).astype(np.float64)
    precision, ratio = float((to_scene <= NEAR_M).mean()), float((to_shape <= NEAR_M).mean())
    accuracy, completion = float(to_scene.mean()), float(to_shape.mean())
    return GeometryScores(
        accuracy_m=accuracy,
        completion_m=completion,
        chamfer_m=(accuracy + completion) / 2,
        precision=precision,
        completion_ratio=ratio,
        f_score=2 * precision * ratio / (precision + ratio) if precision + ratio else 0.0,
        depth_l1_m=_depth_l1(truth.depth, shape.depth(truth.heldout, CAMERA)),
    )


def _depth_l1(true: NDArray[np.floating], found: NDArray[np.floating]) -> float:
    shown = true > 0
    return float(np.abs(found[shown].astype(np.float64) - true[shown]).mean()) if shown.any() else 0.0


def rollout_figures(
    rollout: Rollout, truth: SceneTruth, after: Sequence[int] = ()
) -> tuple[dict[str, float], dict[int, dict[str, float]]]:
    """What the depth pictures of a rollout, fused, are worth; nothing where they show no surface.

    Args:
        rollout: of the scene.
        truth: of the scene.
        after: numbers of views; of the first so many the figures are wanted too.

    Returns:
        The figures of all frames, and by number those of the first so many, where there are more than these.

    Raises:
        RolloutError: a depth picture cannot be decoded.
    """
    fusion, found = Fusion(rollout.intrinsics, max_range_m=truth.max_range_m), {}
    for count, view in enumerate(rollout.frames, start=1):
        fusion.add(read_depth(view.depth), view.camera_to_world)
        if count in after and count < len(rollout.frames):
            found[count] = _figures(fusion.shape(), truth)
    return _figures(fusion.shape(), truth), found


def _figures(shape: Shape | None, truth: SceneTruth) -> dict[str, float]:
    return {} if shape is None else score(shape, truth).figures()
