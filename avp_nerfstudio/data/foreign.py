"""Recognising the folders of other tools, and what reads them."""

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from avp_habitat.errors import RolloutError

_UNREAD = "no parser of nerfstudio 1.1.5 reads it; bring its poses into a transforms.json for nerfstudio-data"
_SCENE_FILES = (".glb", ".gltf", ".ply", ".obj")

# What each tool leaves in a folder (all of the patterns match something), what it is, and what reads it: a parser of
# `ns-train METHOD PARSER` with its options, a converter of `ns-process-data CONVERTER`, or a sentence.
_KINDS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("*/rollout.json",), "a folder of rollouts", "name one of them: {first}"),
    (("config.yml", "nerfstudio_models"), "a training of nerfstudio", "its data is what --data takes"),
    (("dslr/nerfstudio/transforms.json",), "a scene of ScanNet++", "parser scannetpp-data"),
    (("dense/sparse/cameras.bin",), "a scene of Phototourism", "parser phototourism-data"),
    (("colmap/sparse/0/cameras.*",), "a COLMAP project", "parser colmap --colmap-path colmap/sparse/0"),
    (("sparse/0/cameras.*",), "a COLMAP project", "parser colmap --colmap-path sparse/0"),
    (("sparse/cameras.*",), "a COLMAP project", "parser colmap --colmap-path sparse"),
    (("keyframes",), "a capture of Polycam (raw data)", "converter polycam"),
    (("metadata.json", "rgb"), "a capture of Record3D", "converter record3d"),
    (("color", "depth", "pose", "intrinsic"), "a scene of ScanNet", "parser scannet-data"),
    (("*.sens",), "a scene of ScanNet (.sens)", "unpack it with ScanNet's SensReader, then use scannet-data"),
    (("*_frames/lowres_wide",), "a scene of ARKitScenes", "parser arkit-data"),
    (("*frame-*.color.*", "*frame-*.pose.txt"), "a sequence of 7-Scenes", _UNREAD),
    (("*/*frame-*.color.*", "*/*frame-*.pose.txt"), "a scene of 7-Scenes", _UNREAD),
    (("rgb.txt", "groundtruth.txt"), "a sequence of the TUM RGB-D data set", _UNREAD),
    (("poses_bounds.npy",), "a scene of LLFF", _UNREAD),
    (("meta_data.json",), "a scene of SDFStudio", "parser sdfstudio-data"),
    (("dataset.json", "scene.json", "camera"), "a scene of DyCheck", "parser dycheck-data"),
    (("opensfm/reconstruction.json",), "a project of OpenDroneMap", "converter odm"),
    (("train.npz",), "data for nerfstudio's minimal parser", "parser minimal-parser"),
)
_PICTURES = ("*.jpg", "*.jpeg", "*.png", "*.JPG", "images/*.jpg", "images/*.png", "images/*.JPG")


def check_is_rollout(path: Path) -> None:
    """Tell a folder of another tool from a rollout; anything that might be a (damaged) rollout passes.

    Raises:
        RolloutError: it is another tool's; the text says which, and what reads it.
    """
    if path.name == "rollout.json" or not path.exists():
        return
    if (path / "rollout.json").exists() or all((path / part).is_dir() for part in ("images", "depth", "poses")):
        return
    for what, reader in _recognised(path):
        raise RolloutError(f"{path}: expected a rollout (rollout.json), found what looks like {what}: {reader}")


def _recognised(path: Path) -> Iterator[tuple[str, str]]:
    """What a path looks like and what to do with it, the likeliest first."""
    if path.is_file():
        yield from _file(path)
        return
    for patterns, what, how in _KINDS:
        found = [next(path.glob(pattern), None) for pattern in patterns]
        if all(found):
            yield what, _reader(path, how.format(first=found[0] and found[0].parent))
    if list(path.glob("cameras.*")) and list(path.glob("images.*")):
        project = next(
            (above for above in path.resolve().parents if (above / "images").is_dir()), path.resolve().parent
        )
        model = path.resolve().relative_to(project)
        yield "a COLMAP model", _reader(project, f"parser colmap --colmap-path {shlex.quote(str(model))}")
    yield from _transforms(path)
    if any(next(path.glob(pattern), None) for pattern in _PICTURES):
        yield "pictures without poses", _reader(path, "converter images")


def _file(path: Path) -> Iterator[tuple[str, str]]:
    if path.suffix == ".json":
        yield from _transforms(path.parent)
    elif path.suffix.lower() in _SCENE_FILES:
        collect = shlex.join(["python", "-m", "avp_habitat.collect", "--scene", str(path), "--policy", "frontier"])
        yield "a scene's mesh", f"take pictures in it first: {collect} --out NEW_FOLDER"
    elif path.suffix.lower() in (".mp4", ".mov"):
        yield "a video", _reader(path, "converter video")


def _transforms(path: Path) -> Iterator[tuple[str, str]]:
    """By what stands in the files that NeRF tools call `transforms*.json`, each in its own dialect."""
    if (path / "transforms_train.json").is_file():
        timed = any("time" in frame for frame in _frames(_json(path / "transforms_train.json")))
        what, parser = ("a scene of D-NeRF", "dnerf-data") if timed else ("a synthetic scene of NeRF", "blender-data")
        yield what, _reader(path, f"parser {parser}")
    elif (path / "transforms.json").is_file():
        found = _json(path / "transforms.json")
        ours = "camera_model" in found or not {"aabb_scale", "camera_angle_x"} & found.keys()
        kind = "nerfstudio" if ours else "instant-ngp"
        yield f"data of {kind}", _reader(path, f"parser {kind}-data")


def _json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _frames(found: dict[str, Any]) -> list[dict[str, Any]]:
    frames = found.get("frames")
    return [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []


def _reader(path: Path, how: str) -> str:
    """The command that takes a folder."""
    kind, _, rest = how.partition(" ")
    where = shlex.quote(str(path))
    if kind == "parser":
        name, _, options = rest.partition(" ")
        return f"try `ns-train nerfacto {name} --data {where}{options and ' ' + options}`"
    if kind == "converter":
        return f"try `ns-process-data {rest} --data {where} --output-dir NEW`, then `ns-train nerfacto --data NEW`"
    return how
