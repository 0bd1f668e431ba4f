"""`python -m avp_habitat.geometry`: how true the shapes of rollouts and of meshes are."""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import AVPError, RolloutError, SceneError, UsageError
from avp_habitat.metrics import FIGURES, GEOMETRY, explained
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import name_of, read_rollout
from avp_habitat.rollout.origin import expect_scene, task_of
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.tables import table
from avp_habitat.task.settings import TaskSettings

_MESHES = (".ply", ".obj", ".glb", ".gltf")
_ABOUT = ("shape", "scene", "policy", "views")
_MEANING = explained(*(FIGURES[name].title for name in GEOMETRY))


@dataclass(frozen=True)
class GeometryOptions:
    """How true the shapes of rollouts (their depth, fused) and of meshes in the scene's frame are.

    The scene is looked at as the task's camera looks at it. Takes ten seconds or more for each.
    """

    shapes: Positional[tuple[Path, ...]]
    """Rollout folders, and meshes (.ply, .obj, .glb) in metres in the frame of the rollouts: Y up."""
    scene: Annotated[str, arg(help=SCENES)]
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scene."""
    camera_height: Annotated[float, Range(0.01, 10)] = TaskSettings.sensor_height_m
    """Of the camera that says what of the scene meshes should hold, metres above the floor; rollouts name theirs."""
    json: bool = False
    """Print JSON."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        hold_ranges(self)
        if not self.shapes:
            raise UsageError("expected at least one rollout folder or mesh, got none")


def report_on(path: Path, simulator: Simulator, settings: TaskSettings) -> dict[str, Any]:
    """The figures of a rollout folder or a mesh, with what it is; the settings are those of meshes.

    Raises:
        RolloutError: the rollout is damaged, of another scene, shows no surface, or is none but a reconstruction.
        SceneError: the mesh is missing, damaged, empty, or plainly in another frame than the scene.
    """
    from avp_habitat.geometry.scores import rollout_figures
    from avp_habitat.geometry.truth import scene_truth

    if path.suffix.lower() in _MESHES and not path.is_dir():
        return {"shape": str(path), "scene": simulator.scene, **_of_mesh(path, simulator, settings)}
    if path.suffix == ".yml" or (path / "scores.json").is_file():
        raise RolloutError(f"{path}: is a reconstruction; measure it by `python -m avp_nerfstudio.geometry`")
    rollout = read_rollout(path)
    expect_scene(rollout, simulator)
    figures, _ = rollout_figures(rollout, scene_truth(simulator, task_of(rollout)))
    if not figures:
        raise RolloutError(f"{path}: expected depth pictures that show some surface, found none")
    scene, policy = (name_of(rollout.meta, name) for name in ("scene", "policy"))
    return {"shape": str(path), "scene": scene, "policy": policy, "views": len(rollout.frames), **figures}


def _of_mesh(path: Path, simulator: Simulator, settings: TaskSettings) -> dict[str, float]:
    from avp_habitat.geometry.placement import misplacement
    from avp_habitat.geometry.scores import score
    from avp_habitat.geometry.shape import Shape
    from avp_habitat.geometry.truth import scene_truth
    from avp_habitat.scenes.loader import load_scene

    mesh = load_scene(path, up="y", origin=(0.0, 0.0, 0.0)).mesh
    shape, truth = Shape(mesh.vertices, mesh.triangles), scene_truth(simulator, settings)
    if (fault := misplacement(shape, truth)) is not None:
        raise SceneError(f"{path}: expected a mesh in the frame of {simulator.scene}, but {fault}")
    return score(shape, truth).figures()


def main(options: GeometryOptions) -> None:
    """Print a line for each shape."""
    print(f"opening {options.scene} …", file=sys.stderr, flush=True)
    simulator = open_simulator(options.simulator, options.scene)
    settings = replace(TaskSettings(), sensor_height_m=options.camera_height)
    several = len(options.shapes) > 1
    waiting = progress(options.shapes, desc="measuring", unit="shape") if several else options.shapes
    reports, errors = [], []
    for path in waiting:
        try:
            reports.append(report_on(path, simulator, settings))
        except AVPError as error:
            errors.append(error)
    if reports:
        _show(options, reports)
    for error in errors[:-1]:
        print(f"error: {error}", file=sys.stderr)
    if errors:
        raise errors[-1]


def _show(options: GeometryOptions, reports: list[dict[str, Any]]) -> None:
    if options.json:
        print(json.dumps(reports, indent=2, allow_nan=False))
        return
    rows = [
        [*(str(report.get(name, "")) for name in _ABOUT), *(FIGURES[name].text(report[name]) for name in GEOMETRY)]
        for report in reports
    ]
    print(table([*_ABOUT, *(FIGURES[name].heading for name in GEOMETRY)], rows, words=3, markdown=False))
    print(f"\n{_MEANING}")


if __name__ == "__main__":
    sys.exit(command.run(main))
