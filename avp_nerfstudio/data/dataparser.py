"""The dataparser `avp-data`: a rollout folder becomes nerfstudio's cameras, in metres."""

import functools
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.scene_box import SceneBox
from numpy.typing import NDArray

from avp_habitat.errors import AVPError, RolloutError, UsageError
from avp_habitat.poses import y_up_to_z_up
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import Rollout, View, name_of
from avp_habitat.rollout.images import DEPTH_UNIT_M, read_depth
from avp_nerfstudio.data.frames import (
    Order,
    SeenPoints,
    chosen_views,
    read_merged,
    scene_box,
    seen_points,
    subset,
    verify_pictures,
)
from avp_nerfstudio.data.refusals import UnusableRolloutError, check_device, check_is_rollout, discard_outputs

SPLITS = ("train", "val", "test")
METRES_TO_SCENE = "metres_to_scene"
"""In the metadata of all splits: units of the scene per metre, for methods whose options are in metres."""


class RGBDDataset(InputDataset):
    """nerfstudio's pictures, each with `depth_image` when the rollout's depth is to be used.

    nerfstudio's own `DepthDataset` would download a network that guesses depth where there is none.
    """

    exclude_batch_keys_from_device: ClassVar[list[str]] = [*InputDataset.exclude_batch_keys_from_device, "depth_image"]

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Any]:
        """`depth_image`: `(height, width, 1)` float32 planar depth in units of the scene, 0 = none."""
        files = self.metadata.get("depth_filenames")
        if not files:
            return {}
        depth = torch.from_numpy(read_depth(files[data["image_idx"]]))
        return {"depth_image": depth[..., None] * self._dataparser_outputs.dataparser_scale}


@dataclass
class AVPDataParserConfig(DataParserConfig):
    """Options of `avp-data`; without any, poses are those of the rollout, in metres, Z up."""

    _target: type = field(default_factory=lambda: AVPDataParser)
    data: Path = Path()
    """The rollout: its folder, or its rollout.json. Its captured frames are for training, its held-out views for
    evaluation."""
    also: tuple[Path, ...] = ()
    """More rollouts of the same scene and camera, whose frames are trained with too. The held-out views are those of
    --data: they follow from the scene, so all hold the same."""
    scale: Annotated[float, Range(1e-6, 10**6)] = 1.0
    """Multiplies all positions, depths and the scene box; 1 keeps metres. It is written to
    dataparser_transforms.json, so that nerfstudio's exports and poses can be brought back to metres."""
    every: Annotated[int, Range(1, 10**6)] = 1
    """Train with every n-th captured frame only."""
    max_views: Annotated[int, Range(0, 10**6)] = 0
    """Train with the first n of these frames only; 0 for all."""
    order: Order = "steps"
    """Which frames --max-views takes first: `steps` as they were captured (of several rollouts one after another);
    `spread` always the one farthest in place and viewing direction from those taken; `random`, the same every time."""
    depth: bool = True
    """Give the rollout's depth to methods that use it (depth-nerfacto, avp-nerfacto, splatfacto's initial points).
    False makes the reconstruction one from colours alone; only the scene box still comes from depth. The depth is
    along the camera's axis, not along the ray: leave depth-nerfacto's is_euclidean_depth at False."""
    initial_points: Annotated[int, Range(0, 10**8)] = 50_000
    """Give splatfacto at most so many coloured points to begin with, from the depth of at most 24 of the frames; 0
    for none. Other methods ignore them."""
    box_margin_m: Annotated[float, Range(0, 10**6)] = 0.1
    """The scene box is the box around the frames' cameras and what their depth shows (without the farthest 0.2 % on
    each side; a rollout says how large the navigable area is, not where it lies), and so many metres more on every
    side."""
    verify: bool | None = None
    """Decode every picture before training, each byte held to its checksum; None does so when they have at most
    256 MiB (100 views of 640x480 take about a second). That every picture is there, whole and of the right size is
    always checked."""


@dataclass
class AVPDataParser(DataParser):
    """Train split: the captured frames that the options choose; val and test: the held-out views."""

    config: AVPDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        try:
            check_device(self.config.data)
            return self._outputs(split)
        except AVPError as error:
            discard_outputs()
            raise UnusableRolloutError(str(error)) from None

    @functools.cached_property
    def _parsed(self) -> tuple[Rollout, list[View], SeenPoints]:
        """The rollout with the frames of those merged into it, the frames to train with, and the points they saw."""
        config = self.config
        if config.data == Path():
            raise RolloutError("avp-data: no rollout named; add --data with a rollout's folder")
        try:
            hold_ranges(config)
        except UsageError as error:
            raise RolloutError(f"avp-data: {error}") from None
        for path in (config.data, *config.also):
            check_is_rollout(path)
        rollout = read_merged(config.data, config.also)
        frames = chosen_views(rollout.frames, every=config.every, max_views=config.max_views, order=config.order)
        if not frames:
            raise RolloutError(f"{rollout.folder}: expected at least one captured frame, found none")
        verify_pictures([*frames, *rollout.heldout], wanted=config.verify)
        return rollout, frames, seen_points(frames, rollout.intrinsics, colours=self._gives_points)

    @property
    def _gives_points(self) -> bool:
        return self.config.depth and self.config.initial_points > 0

    def _outputs(self, split: str) -> DataparserOutputs:
        if split not in SPLITS:
            raise RolloutError(f"avp-data: unknown split {split!r}: expected one of {', '.join(SPLITS)}")
        (rollout, frames, seen), scale = self._parsed, self.config.scale
        views = frames if split == "train" else rollout.heldout
        if not views:
            raise RolloutError(_no_heldout_views(rollout, split))
        poses = nerfstudio_poses([view.camera_to_world for view in views], scale=scale)
        box = scene_box(frames, seen, margin_m=self.config.box_margin_m) * scale
        metadata: dict[str, Any] = {METRES_TO_SCENE: scale}
        if self.config.depth:
            metadata["depth_filenames"] = [view.depth for view in views]
            # nerfstudio multiplies it by dataparser_scale itself, where it reads depth.
            metadata["depth_unit_scale_factor"] = DEPTH_UNIT_M
        if split == "train" and self._gives_points and len(seen.xyz):
            points = subset(seen, self.config.initial_points)
            metadata["points3D_xyz"] = torch.from_numpy(points.xyz * np.float32(scale))
            metadata["points3D_rgb"] = torch.from_numpy(points.rgb)
        return DataparserOutputs(
            image_filenames=[view.image for view in views],
            cameras=Cameras(
                camera_to_worlds=torch.from_numpy(poses),
                **asdict(rollout.intrinsics),
                camera_type=CameraType.PERSPECTIVE,
                metadata={},  # `ns-export cameras` asserts that there is some
            ),
            scene_box=SceneBox(aabb=torch.from_numpy(box.astype(np.float32))),
            metadata=metadata,
            dataparser_transform=torch.from_numpy(y_up_to_z_up(np.eye(4))[:3].astype(np.float32)),
            dataparser_scale=scale,
        )


def nerfstudio_poses(poses: Sequence[NDArray[np.floating]], *, scale: float) -> NDArray[np.float32]:
    """Habitat poses `(4, 4)`, Y up, metres, as nerfstudio keeps them.

    Returns:
        `(n, 3, 4)` camera_to_world; camera axes OpenGL (the same as habitat's), Z up, metres times `scale`.
    """
    turned = y_up_to_z_up(np.stack(poses))[:, :3]
    turned[..., 3] *= scale
    return turned.astype(np.float32)


def _no_heldout_views(rollout: Rollout, split: str) -> str:
    scene = shlex.quote(name_of(rollout.meta, "scene") or "SCENE")
    again = f"python -m avp_habitat.collect --scene {scene} --policy POLICY --out NEW_FOLDER"
    return (
        f"{rollout.folder}: expected held-out views for the {split} split, found none; they are captured with the "
        f"rollout and no command adds them to a folder: collect it again with `{again}`, which captures 20 of them"
    )
