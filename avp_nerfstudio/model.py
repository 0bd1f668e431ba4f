"""nerfacto for a room: bounded by the scene box, its hash encoding compiled, LPIPS optional."""

import math
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.scene_colliders import AABBBoxCollider
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from torch import Tensor

from avp_nerfstudio.hash_encoding import compile_hash_encodings
from avp_nerfstudio.lpips import optional_lpips


@dataclass
class AVPNerfactoModelConfig(NerfactoModelConfig):
    """nerfacto's options with other defaults; `config.py` sets those that were measured."""

    _target: type = field(default_factory=lambda: AVPNerfactoModel)
    disable_scene_contraction: bool = True
    """Spend the hash tables on the scene box alone and end the rays at its walls: right for a room."""


class SceneBoxCollider(AABBBoxCollider):
    """nerfstudio's box collider on whatever device the rays are."""

    def set_nears_and_fars(self, ray_bundle: RayBundle) -> RayBundle:
        """Set where the rays enter and leave the box, in units of the scene."""
        self.scene_box.aabb = self.scene_box.aabb.to(ray_bundle.origins.device)
        return super().set_nears_and_fars(ray_bundle)


class AVPNerfactoModel(NerfactoModel):
    """nerfacto whose rays end at the scene box."""

    config: AVPNerfactoModelConfig

    def populate_modules(self) -> None:
        """Build nerfacto, then exchange what a room and a CPU want otherwise."""
        with optional_lpips():
            super().populate_modules()
        if self.config.disable_scene_contraction:
            self.collider = SceneBoxCollider(self.scene_box, near_plane=self.config.near_plane)
        if not self.config.predict_normals and self.config.camera_optimizer.mode == "off":
            compile_hash_encodings(self)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Nerfacto's metrics of a picture, without `lpips` where LPIPS is not computed."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if math.isnan(metrics["lpips"]):
            del metrics["lpips"]
        return metrics, images
