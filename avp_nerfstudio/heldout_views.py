"""Rendering the held-out views of a trained method, each scored as ns-eval scores it."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class HeldoutView:
    """A held-out view, rendered."""

    index: int
    """From 0."""
    name: str
    """Of the true picture's file."""
    truth: NDArray[np.float32]
    """`(h, w, 3)` colours in [0, 1]."""
    render: NDArray[np.float32]
    """`(h, w, 3)` colours in [0, 1]."""
    scores: dict[str, float]
    """`psnr`, `ssim`, `lpips` where it is computed, and whatever else the method measures."""
    seconds: float
    """Time to render and score it."""
    camera: Any
    """nerfstudio's `Cameras`, one camera."""


def heldout_count(pipeline: Any) -> int:
    """How many held-out views there are."""
    return len(pipeline.datamanager.fixed_indices_eval_dataloader)


def render_views(pipeline: Any) -> Iterator[HeldoutView]:
    """Render and score all held-out views by the calls that `ns-eval` makes, one at a time.

    Args:
        pipeline: nerfstudio's, in evaluation mode, made for testing.
    """
    names = [Path(path).name for path in pipeline.datamanager.eval_dataset.image_filenames]
    for index, (camera, batch) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
        started = time.monotonic()
        outputs = pipeline.model.get_outputs_for_camera(camera=camera)
        scores, pictures = pipeline.model.get_image_metrics_and_images(outputs, batch)
        seconds = time.monotonic() - started
        # nerfstudio's methods put the truth first and the final render last into one wide picture.
        wide = pictures["img"].detach().cpu().numpy().astype(np.float32)
        width = int(camera.width)
        yield HeldoutView(
            index,
            names[int(batch["image_idx"])],
            wide[:, :width, :3],
            wide[:, -width:, :3],
            {name: float(score) for name, score in scores.items()},
            seconds,
            camera,
        )


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each score over the views, which is what `ns-eval` reports."""
    return {name: float(np.mean([row[name] for row in scores])) for name in (scores[0] if scores else {})}
