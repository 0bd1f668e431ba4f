"""What nerfstudio's commands refuse before a training starts: one line each, and no folder left behind."""

import contextlib
import shlex
import traceback
from pathlib import Path
from typing import Any

from avp_habitat.errors import AVPError, RolloutError
from avp_habitat.provenance import WITHOUT_GPU

# What each tool leaves in a folder (all of the patterns match something), what it is, and what reads it: a parser of
# `ns-train METHOD PARSER` with its options, a converter of `ns-process-data CONVERTER`, or a sentence.
_KINDS: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("*/rollout.json",), "a folder of rollouts", "name one of them"),
    (("config.yml", "nerfstudio_models"), "a training of nerfstudio", "its data is what --data takes"),
    (("dslr/nerfstudio/transforms.json",), "a scene of ScanNet++", "parser scannetpp-data"),
    (("colmap/sparse/0/cameras.*",), "a COLMAP project", "parser colmap --colmap-path colmap/sparse/0"),
    (("sparse/0/cameras.*",), "a COLMAP project", "parser colmap --colmap-path sparse/0"),
    (("sparse/cameras.*",), "a COLMAP project", "parser colmap --colmap-path sparse"),
    (("keyframes",), "a capture of Polycam (raw data)", "converter polycam"),
    (("metadata.json", "rgb"), "a capture of Record3D", "converter record3d"),
    (("color", "depth", "pose", "intrinsic"), "a scene of ScanNet", "parser scannet-data"),
    (("*_frames/lowres_wide",), "a scene of ARKitScenes", "parser arkit-data"),
    (("meta_data.json",), "a scene of SDFStudio", "parser sdfstudio-data"),
    (("transforms_train.json",), "a synthetic scene of NeRF", "parser blender-data"),
    (("transforms.json",), "data of nerfstudio", "parser nerfstudio-data"),
    (("*.jpg",), "pictures without poses", "converter images"),
    (("*.png",), "pictures without poses", "converter images"),
    (("images",), "pictures without poses", "converter images"),
)
_COLLECT = "take pictures in it first: `python -m avp_habitat.collect --scene …`"
_FILES = {
    **dict.fromkeys((".mp4", ".mov"), ("a video", "converter video")),
    **dict.fromkeys((".glb", ".gltf", ".ply", ".obj"), ("a scene's mesh", _COLLECT)),
}


class CommandError(AVPError, SystemExit):
    """A failure that ends a command of nerfstudio with its text in one line, exit code 1 and no traceback.

    An ordinary error of the suite to whoever catches it; where nobody does the interpreter ends as on `sys.exit(text)`.
    """

    def __init__(self, text: str) -> None:
        """Keep the text as what the interpreter prints."""
        super().__init__(text)
        self.code = f"error: {text}"


class UnusableRolloutError(CommandError, RolloutError):
    """A rollout that nerfstudio cannot use."""


def check_is_rollout(path: Path) -> None:
    """Tell a missing folder, and one of another tool, from a rollout; anything that might be one passes.

    Raises:
        RolloutError: it is none; the text says what it looks like and what reads that.
    """
    if not path.exists():
        here = (
            "" if path.is_absolute() else f"; the path is relative to the folder where ns-train ran, now {Path.cwd()}"
        )
        raise RolloutError(
            f"{path}: expected a rollout folder (made by `python -m avp_habitat.collect`), found none{here}"
        )
    known = path.name == "rollout.json" or (path / "rollout.json").exists()
    if known or all((path / part).is_dir() for part in ("images", "depth", "poses")):
        return
    kind = _FILES.get(path.suffix.lower()) if path.is_file() else _recognised(path)
    if kind is not None:
        what, how = kind
        raise RolloutError(
            f"{path}: expected a rollout (rollout.json), found what looks like {what}: {_reader(path, how)}"
        )


def _recognised(folder: Path) -> tuple[str, str] | None:
    for patterns, what, how in _KINDS:
        if all(next(folder.glob(pattern), None) for pattern in patterns):
            return what, how
    return None


def _reader(path: Path, how: str) -> str:
    """The command that takes a folder."""
    kind, _, rest = how.partition(" ")
    name, _, options = rest.partition(" ")
    where = shlex.quote(str(path))
    if kind == "parser":
        return f"try `{f'ns-train nerfacto {name} --data {where} {options}'.rstrip()}`"
    if kind == "converter":
        return f"try `ns-process-data {name} --data {where} --output-dir NEW`, then `ns-train nerfacto --data NEW`"
    return how


def _training() -> Any:
    """The `TrainerConfig` of the training that is being set up; None outside of one.

    nerfstudio 1.1.5 tells a dataparser its own options only; the rest stands in the functions that are calling it.
    """
    from nerfstudio.engine.trainer import Trainer

    callers = (frame.f_locals.get("self") for frame, _ in traceback.walk_stack(None))
    return next((caller.config for caller in callers if isinstance(caller, Trainer)), None)


def check_device(data: Path) -> None:
    """Refuse a training for a GPU where there is none, which would end in a traceback of the driver's.

    Args:
        data: the rollout.

    Raises:
        CommandError: there is none; the text has the commands that work here.
    """
    import torch

    config = _training()
    if config is None or config.machine.device_type != "cuda" or torch.cuda.is_available():
        return
    method, where = str(config.method_name), shlex.quote(str(data))
    on_cpu = ""
    if method != "avp-nerfacto" and hasattr(config.pipeline.model, "implementation"):  # others need compiled CUDA code
        on_cpu = f", or (seconds per iteration) `ns-train {method} {WITHOUT_GPU} avp-data --data {where}`"
    raise CommandError(
        f"{method} is to train on a GPU, and none was found here (torch {torch.__version__} is built for CUDA "
        f"{torch.version.cuda}); use `ns-train avp-nerfacto --data {where}`, made for this machine{on_cpu}"
    )


def discard_outputs(config: Any = None) -> None:
    """Remove the folder of a training that cannot start, and those above it up to `--output-dir` that are then empty.

    Args:
        config: the training's `TrainerConfig`; by default that of the training that is being set up, if any.
    """
    config = config or _training()
    if config is None:
        return
    folder = config.get_base_dir()
    with contextlib.suppress(OSError):
        if [path.name for path in folder.iterdir()] == ["config.yml"]:
            (folder / "config.yml").unlink()
        for each in (folder, *folder.parents[:3]):
            each.rmdir()
