"""nerfacto for a room: bounded by the scene box, its hash encoding compiled, LPIPS optional."""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.model_components.scene_colliders import AABBBoxCollider
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from torch import Tensor, nn
from tqdm import tqdm

from avp_nerfstudio.data.dataparser import METRES_TO_SCENE
from avp_nerfstudio.method.hash_encoding import compile_hash_encodings
from avp_nerfstudio.method.scores import optional_lpips

_LEAST_SHARE = 1e-3


def termination_loss(weights: Tensor, starts: Tensor, ends: Tensor, distance: Tensor, tolerance: float) -> Tensor:
    """How little of the rays' weight lies at the measured surface: the mean of -log(share within the tolerance).

    The share sums the weights of all samples whose interval touches [distance - tolerance, distance + tolerance], so
    that coarse samples are not pushed beyond their own resolution. Rays without a measured distance do not count.

    Args:
        weights: `(rays, samples)` shares of the ray that end in each sample; their sum is at most 1.
        starts: `(rays, samples)` distances at which the samples begin, units of the scene.
        ends: `(rays, samples)` distances at which they end.
        distance: `(rays,)` along the ray to the surface, 0 where none was measured.
        tolerance: half the width of the surface, units of the scene.

    Returns:
        A scalar; 0 when all weight lies at the surface.
    """
    surface = distance[:, None]
    touching = (starts <= surface + tolerance) & (ends >= surface - tolerance)
    share = (weights * touching).sum(dim=-1)
    measured = distance > 0
    loss = torch.log((1 + _LEAST_SHARE) / (share + _LEAST_SHARE)) * measured
    return loss.sum() / measured.sum().clamp_min(1)


_MOST_VOXELS_PER_AXIS = 256
_MARGIN_VOXELS = 2
"""Around measured points; surfaces seen at a grazing angle have points only so often."""


class SurfaceGrid(nn.Module):
    """Which voxels of the scene box may hold matter; all of them until `fill` is called.

    It is part of the checkpoint, so rendering needs no depth.
    """

    occupied: Tensor
    """`(x, y, z)` bool."""
    carved: Tensor
    """`()` bool, whether `fill` has been called."""
    low: Tensor
    """`(3,)` least corner of the scene box, units of the scene."""

    def __init__(self, aabb: Tensor, voxel: float) -> None:
        """Make a grid.

        Args:
            aabb: `(2, 3)` least and greatest corner of the scene box, units of the scene.
            voxel: edge of the voxels, units of the scene; larger where an axis would need more than 256 of them.
        """
        super().__init__()
        extent = (aabb[1] - aabb[0]).cpu()
        self.voxel = max(voxel, float(extent.max()) / _MOST_VOXELS_PER_AXIS)
        shape = torch.ceil(extent / self.voxel).long().clamp_min(1)
        self.register_buffer("low", aabb[0].clone().cpu(), persistent=False)
        self.register_buffer("occupied", torch.ones(tuple(shape.tolist()), dtype=torch.bool))
        self.register_buffer("carved", torch.zeros((), dtype=torch.bool))

    def forward(self, positions: Tensor) -> Tensor:
        """Whether `(..., 3)` positions lie in voxels that may hold matter: `(...)` bool; outside the box none may."""
        index = torch.floor((positions - self.low) / self.voxel).long()
        shape = torch.tensor(self.occupied.shape, device=index.device)
        inside = ((index >= 0) & (index < shape)).all(dim=-1)
        x, y, z = index.clamp_min(0).minimum(shape - 1).unbind(-1)
        return self.occupied[x, y, z] & inside

    @torch.no_grad()
    def fill(self, frames: Iterable[Tensor]) -> None:
        """Leave matter only in the voxels of measured points and two voxels around them.

        Args:
            frames: `(n, 3)` points each, units of the scene; one frame is held in memory at a time.
        """
        near = torch.zeros(self.occupied.shape, device=self.occupied.device)
        shape = torch.tensor(self.occupied.shape, device=self.occupied.device)
        for points in frames:
            index = torch.floor((points.to(self.low.device) - self.low) / self.voxel).long()
            index = index[((index >= 0) & (index < shape)).all(dim=-1)]
            near[index[:, 0], index[:, 1], index[:, 2]] = 1.0
        near = nn.functional.max_pool3d(
            near[None, None], kernel_size=2 * _MARGIN_VOXELS + 1, stride=1, padding=_MARGIN_VOXELS
        )
        self.occupied.copy_(near[0, 0] > 0)
        self.carved.fill_(True)


def measured_points(cameras: Cameras, index: int, depth: Tensor) -> Tensor:
    """What the depth image of the frame `index` shows, `(n, 3)` in units of the scene.

    `depth` is `(height, width, 1)`, planar, in units of the scene, 0 = none.
    """
    pixels = depth[..., 0].nonzero()
    rays = cameras.generate_rays(torch.full((len(pixels), 1), index), coords=pixels + 0.5)
    return rays.origins + rays.directions * rays.metadata["directions_norm"] * depth[depth > 0][:, None]


@dataclass
class AVPNerfactoModelConfig(NerfactoModelConfig):
    """nerfacto's options with other defaults; `config.py` sets those that were measured."""

    _target: type = field(default_factory=lambda: AVPNerfactoModel)
    disable_scene_contraction: bool = True
    """Spend the hash tables on the scene box alone and end the rays at its walls: right for a room."""
    view_dependent: bool = False
    """Let colours change with the viewing direction. Habitat shows scenes without light, so theirs do not, and a
    surface seen from one side only keeps its colour from the others; photographs want True."""
    use_depth: bool = True
    """Learn from the rollout's depth where it has some; False reconstructs from the pictures alone."""
    depth_loss_mult: float = 0.005
    """Weight of the loss that makes rays end at the measured depth."""
    depth_tolerance_m: float = 0.05
    """Half the thickness of the surfaces that this loss asks for, metres."""
    carving_voxel_m: float = 0.05
    """Keep space empty that is farther than two voxels of this edge from all measured points, metres; 0 carves
    nothing. Without it, things float where no training ray has passed."""


class SceneBoxCollider(AABBBoxCollider):
    """nerfstudio's box collider on whatever device the rays are."""

    def set_nears_and_fars(self, ray_bundle: RayBundle) -> RayBundle:
        """Set where the rays enter and leave the box, in units of the scene."""
        self.scene_box.aabb = self.scene_box.aabb.to(ray_bundle.origins.device)
        return super().set_nears_and_fars(ray_bundle)


class NoDirections(nn.Module):
    """Stands where the field encodes directions, and tells it nothing about them."""

    def __init__(self, dimensions: int) -> None:
        """Remember how many numbers the field expects."""
        super().__init__()
        self._dimensions = dimensions

    def forward(self, directions: Tensor) -> Tensor:
        """`(n, dimensions)` zeros for `(n, 3)` directions."""
        return directions.new_zeros((len(directions), self._dimensions))


class AVPNerfactoModel(NerfactoModel):
    """nerfacto whose rays end at the scene box."""

    config: AVPNerfactoModelConfig

    def populate_modules(self) -> None:
        """Build nerfacto, then exchange what a room and a CPU want otherwise."""
        with optional_lpips():
            super().populate_modules()
        if self.config.disable_scene_contraction:
            self.collider = SceneBoxCollider(self.scene_box, near_plane=self.config.near_plane)
        self.surfaces = SurfaceGrid(self.scene_box.aabb, (self.config.carving_voxel_m or 1.0) * self._scale)
        self.density_fns = [functools.partial(self._proposed_density, density_fn) for density_fn in self.density_fns]
        self.field.get_density = functools.partial(self._density, self.field.get_density)  # type: ignore[method-assign]
        if not self.config.view_dependent:
            dimensions = self.field.direction_encoding.get_out_dim()
            self.field.direction_encoding = NoDirections(dimensions)  # type: ignore[assignment]
        if not self.config.predict_normals and self.config.camera_optimizer.mode == "off":
            compile_hash_encodings(self)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Nerfacto's callbacks; before them, space is carved by the depth of the training's frames."""
        pipeline = training_callback_attributes.pipeline
        if self.config.use_depth and self.config.carving_voxel_m > 0 and pipeline is not None:
            self._carve(pipeline.datamanager.train_dataset)
        return super().get_training_callbacks(training_callback_attributes)

    def _carve(self, dataset: Any) -> None:
        if not dataset.metadata.get("depth_filenames"):
            return
        indices = tqdm(range(len(dataset)), desc="carving space by depth", unit="frame", leave=False, disable=None)
        self.surfaces.fill(
            measured_points(dataset.cameras, index, dataset.get_metadata({"image_idx": index})["depth_image"])
            for index in indices
        )

    def _proposed_density(self, density_fn: Callable[..., Tensor], positions: Tensor, **options: Any) -> Tensor:
        """A proposal network's density `(..., 1)` at `(..., 3)` positions, 0 in carved space without asking it."""
        if not self.surfaces.carved:
            return density_fn(positions, **options)
        flat = positions.reshape(-1, 3)
        solid = self.surfaces(flat).nonzero()[:, 0]
        density = positions.new_zeros((len(flat), 1))
        if len(solid):
            density = density.index_copy(0, solid, density_fn(flat[solid][:, None], **options)[:, 0].to(density))
        return density.view(*positions.shape[:-1], 1)

    def _density(self, get_density: Callable[..., Any], ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """The field's density and features, the density 0 in carved space."""
        density, features = get_density(ray_samples)
        if self.surfaces.carved:
            density = density * self.surfaces(ray_samples.frustums.get_positions())[..., None]
        return density, features

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Nerfacto's outputs and `planar_depth`, `(rays, 1)` in units of the scene, as a depth sensor measures it."""
        outputs = super().get_outputs(ray_bundle)
        directions_norm = ray_bundle.metadata["directions_norm"]
        outputs["planar_depth"] = outputs["expected_depth"] / directions_norm
        if self.training:
            outputs["directions_norm"] = directions_norm
        return outputs

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Nerfacto's losses and, where there is depth, `depth_loss` over the field and the proposals."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self.config.use_depth and "depth_image" in batch:
            losses["depth_loss"] = self.config.depth_loss_mult * self._depth_loss(outputs, batch["depth_image"])
        return losses

    def _depth_loss(self, outputs: dict[str, Any], planar_depth: Tensor) -> Tensor:
        distance = (planar_depth.to(self.device) * outputs["directions_norm"])[..., 0]
        tolerance = self.config.depth_tolerance_m * self._scale
        terms = [
            termination_loss(
                weights[..., 0], samples.frustums.starts[..., 0], samples.frustums.ends[..., 0], distance, tolerance
            )
            for weights, samples in zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True)
        ]
        return torch.stack(terms).mean()

    @property
    def _scale(self) -> float:
        """Units of the scene per metre."""
        return float((self.kwargs.get("metadata") or {}).get(METRES_TO_SCENE, 1.0))

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Nerfacto's metrics of a picture, without `lpips` where LPIPS is not computed.

        Where there is depth, `depth_error_m` is the median of the absolute error of planar depth in metres.
        """
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if math.isnan(metrics["lpips"]):
            del metrics["lpips"]
        if "depth_image" in batch:
            depth = batch["depth_image"].to(self.device)
            error = (outputs["planar_depth"] - depth).abs()[depth > 0]
            metrics["depth_error_m"] = float(error.median() / self._scale) if len(error) else math.nan
        return metrics, images
