"""The Rerun recording of a training.

Its `world` is nerfstudio's (Z up), in the units of the data before nerfstudio scaled them: metres for a rollout. Below
it are `training` and `heldout` (all cameras) and `camera` (the held-out view of the time line `view`, with its render);
`pictures` holds truth, render and error of that view, `plots` the numbers of the training by `step`.
"""

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.files import check_new
from avp_nerfstudio.method.scores import HeldoutView, error_colours, to_8_bit

_FRUSTUM_M, _VIEW_FRUSTUM_M = 0.15, 0.3
_TRAINING_COLOUR, _HELDOUT_COLOUR = (228, 120, 51), (66, 110, 190)
_JPEG_QUALITY = 90


class ReconstructionRecording:
    """A Rerun recording, written to a file while things happen: what came before an interruption is kept."""

    def __init__(self, path: Path, pipeline: Any) -> None:
        """Start a recording that shows the cameras of a pipeline (nerfstudio's) as small pyramids.

        Raises:
            UsageError: the file exists or cannot be written.
        """
        check_new(path, option="--rerun")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        except OSError as error:
            raise UsageError(f"--rerun {path}: cannot write there: {error.strerror}") from None
        manager = pipeline.datamanager
        outputs = getattr(manager, "train_dataparser_outputs", None)
        self.path = path
        self._units_per_metre = 1.0 if outputs is None else outputs.dataparser_scale
        self._recording = rr.RecordingStream("avp")
        self._recording.save(path, default_blueprint=_blueprint())
        self._recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._cameras("world/training", manager.train_dataset, _TRAINING_COLOUR)
        self._cameras("world/heldout", manager.eval_dataset, _HELDOUT_COLOUR)

    def scalar(self, name: str, value: float, step: int) -> None:
        """Add a number of the training to its plot."""
        self._recording.set_time("step", sequence=step)
        parts = [rr.escape_entity_path_part(part) for part in name.split("/")]
        self._recording.log("/".join(["plots", *parts]), rr.Scalars(value))
        self._recording.reset_time()

    def view(self, view: HeldoutView) -> None:
        """Add a held-out view at its place on the time line `view`."""
        self._recording.set_time("view", sequence=view.index)
        self._camera("world/camera", view.camera, _VIEW_FRUSTUM_M, _HELDOUT_COLOUR, static=False)
        self._picture("world/camera/render", to_8_bit(view.render))
        self._picture("pictures/truth", to_8_bit(view.truth))
        self._picture("pictures/render", to_8_bit(view.render))
        self._picture("pictures/error", error_colours(view))
        for name, score in view.scores.items():
            self._recording.log(f"scores/{name}", rr.Scalars(score))
        self._recording.reset_time()

    def close(self) -> None:
        """Finish the file."""
        self._recording.disconnect()

    def _cameras(self, path: str, dataset: Any, colour: tuple[int, int, int]) -> None:
        cameras = () if dataset is None else dataset.cameras
        for index in range(len(cameras)):
            self._camera(f"{path}/{index:05d}", cameras[index], _FRUSTUM_M, colour, static=True)

    def _picture(self, path: str, colours: NDArray[np.uint8]) -> None:
        self._recording.log(path, rr.Image(colours).compress(jpeg_quality=_JPEG_QUALITY))

    def _camera(self, path: str, camera: Any, size_m: float, colour: tuple[int, int, int], *, static: bool) -> None:
        """A camera with nerfstudio's axes: x right, y up, looking along -z."""
        pose = camera.camera_to_worlds.detach().cpu().numpy().reshape(3, 4).astype(np.float64)
        pinhole = rr.Pinhole(
            image_from_camera=camera.get_intrinsics_matrices().cpu().numpy().reshape(3, 3),
            resolution=[int(camera.width), int(camera.height)],
            camera_xyz=rr.ViewCoordinates.RUB,
            image_plane_distance=size_m,
            color=colour,
        )
        place = rr.Transform3D(translation=pose[:, 3] / self._units_per_metre, mat3x3=pose[:, :3])
        self._recording.log(path, place, pinhole, static=static)


def _blueprint() -> rrb.Blueprint:
    pictures = [rrb.Spatial2DView(origin=f"pictures/{name}", name=name) for name in ("truth", "render", "error")]
    plots = [rrb.TimeSeriesView(origin="scores", name="scores"), rrb.TimeSeriesView(origin="plots", name="training")]
    scene = rrb.Spatial3DView(origin="world", name="cameras")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*pictures), rrb.Horizontal(scene, *plots)), collapse_panels=True)
