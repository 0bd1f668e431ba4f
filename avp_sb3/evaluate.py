"""`python -m avp_sb3.evaluate`: compare policies on one scene, all from the same starts."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import UsageError
from avp_habitat.files import check_new, check_writable
from avp_habitat.metrics import METRICS_HELP
from avp_habitat.plugins import name_of
from avp_habitat.policies.registry import POLICIES_HELP, TRUSTED, check_policy, described, learned_reward
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.budget import BUDGET_HELP, Budget, budget_for
from avp_habitat.task.rewards import REWARDS_HELP
from avp_habitat.task.settings import OBSERVATIONS_HELP, TaskSettings
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_sb3.evaluation.policy import Episode, PolicyRunner
from avp_sb3.evaluation.report import LEGEND, ReportError, table, write_report


@dataclass(frozen=True)
class Evaluate:
    """Run policies on one scene from the same starts; compare coverage per view, views, path, stops.

    Takes about a second for each episode; of policies that plan (greedy, oracle, survey) up to a minute.
    """

    scene: Annotated[str, arg(help=SCENES)]
    policy: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(help=f"{POLICIES_HELP}; give it again for each policy to compare"),
    ]
    episodes: Annotated[int, Range(1, 1e6)] = 20
    """Per policy."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 1000
    """Of the first start; episode i uses SEED + i."""
    reward: Annotated[str | None, arg(help=f"{REWARDS_HELP} (omitted: that of each policy's weights, or proposed)")] = (
        None
    )
    observation: Annotated[str | None, arg(help=f"{OBSERVATIONS_HELP} (omitted: the model's own)")] = None
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scene."""
    metrics: Annotated[tuple[str, ...], arg(help=METRICS_HELP)] = ()
    budget: Annotated[Budget, arg(help=BUDGET_HELP)] = 80
    width: int = 160
    """Of the policy's depth image in pixels."""
    height: int = 120
    """Of the policy's depth image in pixels."""
    stochastic: bool = False
    """Sample a model's actions instead of taking the likeliest."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False
    out: Path | None = None
    """Folder of the report (omitted: runs/evaluation-DATE-TIME)."""
    experiment: Annotated[str | None, arg(help=f"MLflow's (omitted: {DEFAULT_HELP})")] = None
    no_mlflow: bool = False
    """Log nothing to MLflow."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right."""
        hold_ranges(self)
        _ = self.settings
        if not self.policy:
            raise UsageError("policy: expected at least one")
        object.__setattr__(self, "policy", tuple(dict.fromkeys(self.policy)))

    @property
    def settings(self) -> TaskSettings:
        """Of the task; where the budget is `auto`, with the default in its place."""
        reward = self.reward or TaskSettings.reward
        settings = TaskSettings(reward=reward, metrics=self.metrics, width=self.width, height=self.height)
        return settings if self.budget == "auto" else replace(settings, budget=self.budget)


def main(options: Evaluate) -> None:
    """Evaluate, print the table, write the report, log it."""
    out = options.out or Path("runs") / f"evaluation-{datetime.now():%Y%m%d-%H%M%S}"
    check_new(out, option="--out")
    check_writable(out, failure=ReportError)
    for policy in options.policy:
        check_policy(policy)
    print(f"opening {options.scene} for {', '.join(map(described, options.policy))} …", flush=True)
    simulator = open_simulator(options.simulator, options.scene)
    # All of them before the first episode, so that the last one's fault does not cost the others' time.
    how = {name: getattr(options, name) for name in ("observation", "stochastic", "trusted")}
    settings = replace(options.settings, budget=budget_for(options.budget, simulator.area.area_m2))
    rewards = [options.reward or learned_reward(policy) or TaskSettings.reward for policy in options.policy]
    runners = [
        PolicyRunner(policy, simulator, replace(settings, reward=reward), **how)
        for policy, reward in zip(options.policy, rewards, strict=True)
    ]
    done: dict[str, list[Episode]] = {runner.name: [] for runner in runners}
    try:
        with progress(total=len(runners) * options.episodes, desc="evaluating", unit="episode") as bar:
            for runner in runners:
                bar.set_description_str(runner.name, refresh=False)
                for number in range(options.episodes):
                    done[runner.name].append(runner.run(options.seed + number))
                    bar.update()
    finally:
        # What came before an interruption is kept.
        _report(runners, done, options, out)


def _report(runners: Sequence[PolicyRunner], done: dict[str, list[Episode]], options: Evaluate, out: Path) -> None:
    results = [runner.result(done[runner.name], options.seed) for runner in runners if done[runner.name]]
    if not results:
        return
    env, episodes = runners[0].env, sum(map(len, done.values()))
    complete = episodes == len(done) * options.episodes
    about = {"complete": complete, **_about(runners, options)}
    print(f"{table(results, options.metrics)}\n\n{LEGEND}\n")
    write_report(out, results, about, options.metrics)
    if not complete:
        print(f"interrupted after {episodes} episodes, which are kept")
    print(f"report:  {out}")
    if options.no_mlflow:
        return
    # Late: mlflow takes seconds to import.
    from avp_sb3.evaluation.tracking import track_evaluation

    firsts = {name: episodes[0].trajectory for name, episodes in done.items() if episodes}
    pictures = {name: draw_trajectory(env.area, first) for name, first in firsts.items() if first is not None}
    run, experiment, store = track_evaluation(
        results, about, out, experiment=options.experiment, pictures=pictures, metrics=options.metrics
    )
    print(f"MLflow:  run {run} in experiment {experiment!r} at {store}")


def _about(runners: Sequence[PolicyRunner], options: Evaluate) -> dict[str, Any]:
    env = runners[0].env
    settings = env.settings.facts()
    settings["reward"] = ", ".join(dict.fromkeys(name_of(runner.env.settings.reward) for runner in runners))
    del settings["observation"]  # Each policy has its own.
    return {
        "command": shlex.join(["python", "-m", "avp_sb3.evaluate", *sys.argv[1:]]),
        "scene": {"name": env.scene_name, "sha256": env.scene_digest, "navigable_cells": len(env.area.centres)},
        "simulator": {"name": env.simulator.name, "version": env.simulator.version},
        "seed": options.seed,
        "episodes": options.episodes,
        "stochastic": options.stochastic,
        "settings": settings,
    }


if __name__ == "__main__":
    sys.exit(command.run(main))
