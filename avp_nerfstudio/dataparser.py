"""The dataparser `avp-data`: a rollout folder becomes nerfstudio's cameras, in metres."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.images import DEPTH_UNIT_M, read_depth
from avp_habitat.poses import Intrinsics, unproject, y_up_to_z_up
from avp_habitat.rollout import Rollout, View, read_rollout

_DEPTHS_FOR_BOX = 24
_PIXEL_STRIDE = 8
_BOX_PERCENTILES = (0.2, 99.8)
_BOX_MARGIN_M = 0.1


class UnusableRolloutError(RolloutError, SystemExit):
    """A rollout that nerfstudio cannot use.

    An ordinary `RolloutError` to whoever catches it; where nobody does (in `ns-train`, `ns-eval`, ...) the
    interpreter ends as on `sys.exit(text)`: the text on one line, exit code 1 and no traceback.
    """

    def __init__(self, text: str) -> None:
        """Remember the text as the interpreter's last words."""
        super().__init__(text)
        self.code = f"error: {text}"


@dataclass
class AVPDataParserConfig(DataParserConfig):
    """Options of `avp-data`; without any, poses are those of the rollout, in metres, Z up."""

    _target: type = field(default_factory=lambda: AVPDataParser)
    data: Path = Path()
    """The rollout: its folder, or its rollout.json."""
    scale: float = 1.0
    """Multiplies all positions; 1 keeps metres. It is written to dataparser_transforms.json, so that nerfstudio's
    exports and poses can be brought back to metres."""
    every: int = 1
    """Train with every n-th captured frame only."""
    max_views: int = 0
    """Train with the first n of these frames only; 0 for all."""


@dataclass
class AVPDataParser(DataParser):
    """Train split: the captured frames in the order of the steps; val and test: the held-out views."""

    config: AVPDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        try:
            return self._outputs(split)
        except RolloutError as error:
            raise UnusableRolloutError(str(error)) from None

    def _outputs(self, split: str) -> DataparserOutputs:
        _check_options(self.config)
        rollout = read_rollout(self.config.data)
        frames = captured(rollout, every=self.config.every, max_views=self.config.max_views)
        views = frames if split == "train" else rollout.heldout
        if not views:
            raise RolloutError(f"{rollout.folder}: expected at least one view for the {split} split, found none")
        poses = nerfstudio_poses([view.camera_to_world for view in views], scale=self.config.scale)
        box = scene_box(frames, rollout.intrinsics) * self.config.scale
        return DataparserOutputs(
            image_filenames=[view.image for view in views],
            cameras=_cameras(poses, rollout.intrinsics),
            scene_box=SceneBox(aabb=torch.from_numpy(box.astype(np.float32))),
            metadata={
                "depth_filenames": [view.depth for view in views],
                # nerfstudio multiplies it by dataparser_scale itself, where it reads depth.
                "depth_unit_scale_factor": DEPTH_UNIT_M,
            },
            dataparser_transform=torch.from_numpy(y_up_to_z_up(np.eye(4))[:3].astype(np.float32)),
            dataparser_scale=self.config.scale,
        )


def captured(rollout: Rollout, *, every: int = 1, max_views: int = 0) -> list[View]:
    """The captured frames to train with: every n-th, at most `max_views` of them (0 for all)."""
    frames = rollout.frames[::every]
    return frames[:max_views] if max_views else frames


def nerfstudio_poses(poses: Sequence[NDArray[np.floating]], *, scale: float) -> NDArray[np.float32]:
    """Poses as nerfstudio keeps them.

    Args:
        poses: `(4, 4)` camera_to_world each, habitat axes, Y up, metres.
        scale: multiplies the positions.

    Returns:
        `(n, 3, 4)` camera_to_world; camera axes OpenGL (the same as habitat's), Z up, metres times `scale`.
    """
    turned = y_up_to_z_up(np.stack(poses))[:, :3]
    turned[..., 3] *= scale
    return turned.astype(np.float32)


def scene_box(views: Sequence[View], intrinsics: Intrinsics) -> NDArray[np.float64]:
    """The box that holds the cameras and what they saw, from a few pixels of a few depth images.

    Far outliers (a glimpse through a window) do not stretch it.

    Returns:
        `(2, 3)` least and greatest corner, Z up, metres.

    Raises:
        RolloutError: a depth image cannot be decoded.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _DEPTHS_FOR_BOX)).round().astype(int))
    seen = np.concatenate([_seen_points(views[index], intrinsics) for index in chosen])
    cameras = np.stack([view.camera_to_world[:3, 3] for view in views])
    inner = np.percentile(seen, _BOX_PERCENTILES, axis=0) if len(seen) else cameras[:2]
    points = np.concatenate([inner, cameras])
    points = (y_up_to_z_up(np.eye(4))[:3, :3] @ points.T).T
    return np.stack([points.min(axis=0) - _BOX_MARGIN_M, points.max(axis=0) + _BOX_MARGIN_M])


def _seen_points(view: View, intrinsics: Intrinsics) -> NDArray[np.floating]:
    try:
        depth = read_depth(view.depth)
    except (OSError, ValueError, SyntaxError) as error:
        raise RolloutError(f"{view.depth}: expected a readable PNG, could not decode it: {error}") from None
    sparse = (slice(_PIXEL_STRIDE // 2, None, _PIXEL_STRIDE),) * 2
    points = unproject(depth, view.camera_to_world, intrinsics)
    return points[sparse][depth[sparse] > 0]


def _cameras(poses: NDArray[np.float32], intrinsics: Intrinsics) -> Cameras:
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses),
        fx=intrinsics.fx,
        fy=intrinsics.fy,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        width=intrinsics.width,
        height=intrinsics.height,
        camera_type=CameraType.PERSPECTIVE,
    )


def _check_options(config: AVPDataParserConfig) -> None:
    if config.data == Path():
        raise RolloutError("avp-data: no rollout named; add --data with a rollout's folder")
    if not (np.isfinite(config.scale) and config.scale > 0):
        raise RolloutError(f"avp-data: expected --scale above 0, got {config.scale}")
    if config.every < 1 or config.max_views < 0:
        raise RolloutError(
            f"avp-data: expected --every of at least 1 and --max-views of at least 0, "
            f"got {config.every} and {config.max_views}"
        )
