"""A small real experiment of rollouts alone; run as a program it does what is left of it."""

import json
import sys
from dataclasses import replace
from pathlib import Path

from avp_experiment.cells import COLLECT, plan
from avp_experiment.configuration import PRESETS, Configuration, ExperimentScene, chosen_methods
from avp_experiment.folder import Folder
from avp_experiment.runner import Runner, environment


def rollouts(root):
    preset = replace(PRESETS["smoke"], budget=3, size=(32, 24), starts=3, prefixes=())
    scenes = (ExperimentScene("builtin:0", "builtin:0", "00", "train", preset.budget),)
    configuration = Configuration("smoke", preset, scenes, chosen_methods(["heuristic", "random"]))
    return [cell for cell in plan(configuration, root, tracking="avp") if cell.kind == COLLECT]


def run(root, cells, jobs=1):
    runner = Runner(Folder(root), jobs, environment(f"sqlite:///{root}/mlflow.db"), ("avp_experiment.runner",))
    runner.run(cells)
    return runner


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    chosen = rollouts(folder)
    if len(sys.argv) > 2:  # a module to run instead of the first rollout's, beside the experiment
        sys.path.insert(0, str(folder))
        chosen = [replace(chosen[0], words=("python", "-m", sys.argv[2]))]
    print(json.dumps(run(folder, chosen).failed))
