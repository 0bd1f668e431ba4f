"""Pictures with the rollout's depth, where the dataparser names it."""

from typing import Any, ClassVar

import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from avp_habitat.images import read_depth


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
