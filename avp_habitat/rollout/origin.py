"""Where a rollout comes from: its scene, and the settings of the task that its `rollout.json` names."""

from typing import Any

from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.rollout.format import Rollout, name_of
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings


def _entry(rollout: Rollout, name: str) -> dict[str, Any]:
    found = rollout.meta.get(name, {})
    if not isinstance(found, dict):
        raise RolloutError(f"{rollout.folder}/rollout.json: {name}: expected an object, found {found!r}")
    return found


def task_of(rollout: Rollout) -> TaskSettings:
    """Camera and range of the task, with pictures of the rollout's size; what is not named has its default.

    Raises:
        RolloutError: a value cannot be right.
    """
    camera, coverage, actions = (_entry(rollout, name) for name in ("camera", "coverage", "actions"))
    named = {
        "sensor_height_m": camera.get("height_above_floor_m"),
        "hfov_deg": camera.get("hfov_deg"),
        "max_range_m": coverage.get("max_range_m"),
        "pitch_limit_deg": actions.get("pitch_limit_deg"),
    }
    size = {"width": rollout.intrinsics.width, "height": rollout.intrinsics.height}
    try:
        return TaskSettings(**size, **{name: value for name, value in named.items() if value is not None})
    except UsageError as error:
        raise RolloutError(f"{rollout.folder}/rollout.json: {error}") from None


def expect_scene(rollout: Rollout, simulator: Simulator) -> None:
    """Refuse a rollout of another scene than the open one.

    Raises:
        RolloutError: its scene has another digest, or none.
    """
    if _entry(rollout, "scene").get("sha256") != simulator.scene_digest:
        found = name_of(rollout.meta, "scene") or "a scene without a name"
        raise RolloutError(
            f"{rollout.folder}: expected a rollout of {simulator.scene}, found one of {found} of another digest"
        )
