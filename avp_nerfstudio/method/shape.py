"""The shape that a trained model holds: its depth, rendered all over a scene, and fused."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from numpy.typing import NDArray

from avp_habitat.command import progress
from avp_habitat.errors import RolloutError
from avp_habitat.geometry.fusion import fuse
from avp_habitat.geometry.scores import score
from avp_habitat.geometry.truth import CAMERA, scan_poses, scene_truth
from avp_habitat.poses import pixel_directions
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.rollout.origin import expect_scene, task_of
from avp_habitat.simulators.base import Simulator
from avp_nerfstudio.data.dataparser import AVPDataParserConfig, nerfstudio_poses
from avp_nerfstudio.method.hash_encoding import compile_hash_encodings

_OPAQUE = 0.5
"""Rays of which less than this share ends in the model show no surface."""


def rollout_of(pipeline: Any) -> Rollout:
    """The rollout on which a pipeline was trained.

    Raises:
        RolloutError: it cannot be read, or the data came in by another parser, so that nobody knows the model's frame.
    """
    parser = pipeline.datamanager.config.dataparser
    if not isinstance(parser, AVPDataParserConfig):
        found = type(parser).__name__
        raise RolloutError(f"expected a training on avp-data, whose frame is the rollout's, found {found}")
    return read_rollout(parser.data)


def model_figures(pipeline: Any, rollout: Rollout, simulator: Simulator) -> dict[str, float]:
    """How true the shape of a model is, by the names of `metrics.GEOMETRY`; nothing where it shows no surface.

    Args:
        pipeline: nerfstudio's, in evaluation mode, trained on the rollout through avp-data.
        rollout: says camera height and range.
        simulator: of its scene.

    Raises:
        RolloutError: the rollout is of another scene.
        SimulatorError: the simulator gives no mesh.
    """
    expect_scene(rollout, simulator)
    settings = task_of(rollout)
    truth = scene_truth(simulator, settings)
    poses = scan_poses(simulator, settings)
    views = progress(_views(pipeline, poses), total=len(poses), unit="view", desc="scanning the model")
    shape = fuse(views, CAMERA, max_range_m=settings.max_range_m)
    return {} if shape is None else score(shape, truth).figures()


def _views(pipeline: Any, poses: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    """The depth in metres that a model shows from habitat poses `(n, 4, 4)`, 0 for none, with the pose."""
    compile_hash_encodings(pipeline.model)
    scale = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    length = np.linalg.norm(pixel_directions(CAMERA), axis=-1)
    for pose in poses:
        camera = Cameras(
            torch.from_numpy(nerfstudio_poses([pose], scale=scale)),
            *(float(number) for number in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)),
            width=CAMERA.width,
            height=CAMERA.height,
            camera_type=CameraType.PERSPECTIVE,
        )
        outputs = pipeline.model.get_outputs_for_camera(camera=camera.to(pipeline.device))
        along, share = (outputs[name][..., 0].detach().cpu().numpy() for name in ("depth", "accumulation"))
        yield np.where(share >= _OPAQUE, along / length / scale, 0.0).astype(np.float32), pose
