"""How a scene is handed to Habitat-Sim: its own dataset config, or one that is written to a temporary folder."""

import json
from pathlib import Path

from avp_habitat.scenes.location import SceneLocation

_NAME = "scene"


def write_stage(location: SceneLocation, folder: Path) -> tuple[Path, str]:
    """The dataset config and the id in it by which Habitat-Sim opens a scene.

    A bare `.glb` would be read as Z-up, and Habitat-Sim looks beside a bare asset for a NavMesh and semantics that may
    not fit; a stage config of our own says what is meant. It is written to `folder`, never beside the user's files.

    Args:
        location: of the scene; a generated room is written to `folder` too.
        folder: a temporary one.

    Returns:
        Path of the `.scene_dataset_config.json`, and the scene's id.
    """
    if location.dataset is not None and location.scene_id is not None:
        return location.dataset.resolve(), location.scene_id
    asset = location.asset.resolve() if location.asset is not None else _generated(location.name, folder)
    stage = {
        "render_asset": str(asset),
        "up": list(location.up),
        "front": list(location.front),
        "force_flat_shading": True,
    }
    (folder / f"{_NAME}.stage_config.json").write_text(json.dumps(stage), encoding="utf-8")
    dataset = folder / "avp.scene_dataset_config.json"
    dataset.write_text(json.dumps({"stages": {"paths": {".json": ["*.stage_config.json"]}}}), encoding="utf-8")
    return dataset, _NAME


def _generated(name: str, folder: Path) -> Path:
    from avp_habitat.scenes.export import export_glb
    from avp_habitat.scenes.loader import load_scene

    asset = folder / "room.glb"
    export_glb(load_scene(name).mesh, asset)
    return asset
