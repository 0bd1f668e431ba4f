"""The Rerun recording of a check: the fused cloud, all cameras, and what each of them sees."""

import io
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.rollout import Rollout
from avp_nerfstudio.check.cloud import Cloud, frusta, frustum_colours
from avp_nerfstudio.check.hypotheses import Cameras

_APPLICATION = "avp-check"
_PICTURES = 200
_PICTURE_WIDTH = 320


def write_recording(path: Path, rollout: Rollout, cloud: Cloud, cameras: Cameras, bad: NDArray[np.bool_]) -> None:
    """Write an `.rrd` file.

    Entities: `world/cloud`, `world/frusta` (red where a frame disagrees), and on the time line `frame` the
    `world/camera` with its picture; of more than 200 frames, of those that are spread evenly.

    Args:
        path: the file.
        rollout: for the pictures.
        cloud: of the frames.
        cameras: of the frames.
        bad: `(n,)` those drawn red.

    Raises:
        OSError: it cannot be written.
    """
    path.touch()  # Rerun's own error for an unwritable path has neither the path nor an errno.
    recording = rr.RecordingStream(_APPLICATION)
    recording.save(path, default_blueprint=_blueprint())
    try:
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world/cloud", rr.Points3D(cloud.points, colors=cloud.colours, radii=[0.008]), static=True)
        lines = rr.LineStrips3D(list(frusta(cameras)), colors=frustum_colours(bad), radii=[0.004])
        recording.log("world/frusta", lines, static=True)
        views = rollout.frames + rollout.heldout
        for frame in np.unique(np.linspace(0, len(views) - 1, min(len(views), _PICTURES)).round().astype(int)):
            recording.set_time("frame", sequence=int(frame))
            _log_camera(recording, cameras, int(frame), views[frame].image)
    finally:
        recording.disconnect()


def _log_camera(recording: rr.RecordingStream, cameras: Cameras, frame: int, image: Path) -> None:
    pose, k = cameras.poses[frame], cameras.intrinsics
    with Image.open(image) as picture:
        width = min(_PICTURE_WIDTH, k.width)
        small = picture.convert("RGB").resize((width, max(1, round(k.height * width / k.width))))
    encoded = io.BytesIO()
    small.save(encoded, format="JPEG", quality=80)
    across, down = small.width / k.width, small.height / k.height
    matrix = k.matrix * np.array([[across], [down], [1.0]])
    recording.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    recording.log(
        "world/camera/picture",
        rr.Pinhole(
            image_from_camera=matrix,
            resolution=[small.width, small.height],
            camera_xyz=rr.ViewCoordinates.RUB,
            image_plane_distance=0.3,
        ),
        rr.EncodedImage(contents=encoded.getvalue(), media_type="image/jpeg"),
    )


def _blueprint() -> rrb.Blueprint:
    scene = rrb.Spatial3DView(origin="world", name="fused cloud and cameras")
    picture = rrb.Spatial2DView(origin="world/camera/picture", name="picture")
    return rrb.Blueprint(
        rrb.Horizontal(scene, picture, column_shares=[3, 2]), rrb.TimePanel(timeline="frame"), collapse_panels=True
    )
