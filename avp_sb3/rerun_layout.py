"""How recordings of episodes are opened, and how a viewer lays them out."""

from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

APPLICATION = "avp"


def layout(root: str, name: str, *, with_map: bool) -> rrb.Container:
    """How a viewer arranges one root: the scene, beside it the camera, the map of a rollout and the plots."""
    camera = f"{root}/world/camera"
    maps = [rrb.Spatial2DView(origin=f"{root}/map", name="map")] if with_map else []
    return rrb.Horizontal(
        rrb.Spatial3DView(origin=f"{root}/world", name=name),
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=f"{camera}/rgb", name="RGB"),
                rrb.Spatial2DView(origin=f"{camera}/depth", name="depth"),
                *maps,
            ),
            rrb.TimeSeriesView(origin=f"{root}/plots/coverage", name="coverage"),
            rrb.TimeSeriesView(origin=f"{root}/plots/reward", name="reward parts"),
            rrb.TimeSeriesView(origin=f"{root}/plots/action", name="action"),
        ),
        column_shares=[3, 2],
        name=name,
    )


def blueprint(roots: Sequence[str], *, with_map: bool = False) -> rrb.Blueprint:
    """The layout of every root, in tabs when there are several, played by `step`."""
    parts = [layout(root, root.strip("/") or "episode", with_map=with_map) for root in roots]
    top = parts[0] if len(parts) == 1 else rrb.Tabs(*parts)
    return rrb.Blueprint(top, rrb.TimePanel(timeline="step"), collapse_panels=True)


def open_recording(path: Path, roots: Sequence[str], *, with_map: bool = False) -> rr.RecordingStream:
    """A recording that is written to a file, with the layout of its roots; `disconnect()` finishes it.

    Raises:
        OSError: the file cannot be written.
    """
    path.touch()  # Rerun's own error for an unwritable path has neither the path nor an errno.
    recording = rr.RecordingStream(APPLICATION)
    recording.save(path, default_blueprint=blueprint(roots, with_map=with_map))
    return recording
