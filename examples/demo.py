"""The whole chain on one room: capture with the policy that comes with the suite, and with it trained further here.

Two baselines beside it; reconstruct, score, compare.

The experiment's smallest preset. What is done is not done again, so an interrupted demo goes on where it was.
"""

import os
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from avp_experiment.compare import compare
from avp_experiment.configuration import PRESETS, Configuration, chosen_methods, read_scenes, scene_slug
from avp_habitat import command
from avp_habitat.metrics import explained
from avp_habitat.simulators.registry import SimulatorChoice

METHODS = ("random", "heuristic", "pretrained", "pretrained_tuned")
PRESET = PRESETS["demo"]


@dataclass(frozen=True)
class Demo:
    """The whole chain on one room that the policy of the suite has never seen: capture, train, reconstruct, compare.

    Takes about five minutes on two CPU cores.
    """

    scene: str = "builtin:0"
    """The room."""
    steps: int = PRESET.steps
    """Environment steps for which the policy is trained further in the room."""
    iterations: int = PRESET.iterations
    """Of each reconstruction."""
    width: int = PRESET.size[0]
    """Of the pictures in pixels; small, because a CPU reconstructs them."""
    height: int = PRESET.size[1]
    """Of the pictures in pixels."""
    out: Path = Path("runs/demo")
    """Folder of the results."""

    @property
    def configuration(self) -> Configuration:
        """As an experiment without unseen scenes."""
        preset = replace(PRESET, steps=self.steps, iterations=self.iterations, size=(self.width, self.height))
        scenes = read_scenes([self.scene], [], SimulatorChoice(), preset)
        return Configuration("demo", preset, scenes, chosen_methods(METHODS))


def main(options: Demo) -> None:
    """Run what is not done, then show the comparison."""
    configuration, out = options.configuration, options.out
    line = shlex.join(["python", "examples/demo.py", *sys.argv[1:]])
    compare(configuration, out, jobs=len(os.sched_getaffinity(0)), line=line)

    from avp_sb3.rerun.rollout import write_rollout_recording

    slug = scene_slug(configuration.scenes[0].name)
    rollouts = [out / "cells" / "collect" / f"{method.name}-{slug}-0-0" / "rollout" for method in configuration.methods]
    recording = out / "rollouts.rrd"
    recording.unlink(missing_ok=True)
    write_rollout_recording(rollouts, recording)
    print((out / "table2.md").read_text(encoding="utf-8").partition("\n")[2])
    print(explained("coverage", "ANND", "EI", "visibility", "PSNR", "SSIM", "LPIPS"))
    print(f"\npictures:     {rollouts[0].parent.parent}/*/rollout/trajectory.png, {out}/figure5.png, {out}/figure6.png")
    print(f"trajectories: .venv/bin/rerun {recording}")
    print("runs:         .venv/bin/mlflow ui --backend-store-uri sqlite:///mlflow.db")


if __name__ == "__main__":
    sys.exit(command.run(main))
