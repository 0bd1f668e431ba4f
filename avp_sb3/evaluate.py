"""`python -m avp_sb3.evaluate`: compare policies on one scene, all from the same starts."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import UsageError
from avp_habitat.files import check_writable
from avp_habitat.policies.registry import POLICY_NAMES, TRUSTED, check_policy, described
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import add_simulator_options, simulator_choice
from avp_habitat.task.rewards import REWARD_NAMES
from avp_habitat.task.settings import OBSERVATION_NAMES, TaskSettings
from avp_habitat.task.trajectory import Trajectory
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_sb3.evaluation.policy import Contestant, EpisodeResult, PolicyResult, run_episodes
from avp_sb3.evaluation.report import LEGEND, ReportError, check_new, table, write_report


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_sb3.evaluate",
        description="Run policies on one scene from the same starts; compare coverage per view, views, path, stops. "
        "Takes about a second for each episode; of policies that plan (greedy, oracle, survey) up to a minute.",
    )
    add = parser.add_argument
    add("--scene", required=True, help=SCENES)
    add(
        "--policy",
        required=True,
        action="append",
        metavar="POLICY",
        help=f"{', '.join(POLICY_NAMES)}, or a PPO model (.zip); give it again for each policy to compare",
    )
    add("--episodes", default=20, type=int, help="per policy (default: %(default)s)")
    add("--seed", default=1000, type=int, help="of the first start; episode i uses SEED + i (default: %(default)s)")
    add("--reward", default="proposed", metavar="REWARD", help=f"{', '.join(REWARD_NAMES)} (default: %(default)s)")
    add(
        "--observation", default=None, metavar="KIND", help=f"{', '.join(OBSERVATION_NAMES)} (default: the model's own)"
    )
    add_simulator_options(parser)
    add("--budget", default=80, type=int, help="steps, which are views (default: %(default)s)")
    add("--width", default=160, type=int, help="of the policy's depth image in pixels (default: %(default)s)")
    add("--height", default=120, type=int, help="of the policy's depth image in pixels (default: %(default)s)")
    add("--stochastic", action="store_true", help="sample a model's actions instead of taking the likeliest")
    add("--trusted", action="store_true", help=TRUSTED)
    add("--out", default=None, type=Path, help="folder of the report (default: runs/evaluation-DATE-TIME)")
    add("--experiment", metavar="NAME", help=f"of MLflow (default: {DEFAULT_HELP})")
    add("--no-mlflow", action="store_true", help="log nothing to MLflow")
    return parser


def _options(argv: Sequence[str]) -> argparse.Namespace:
    options = _parser().parse_args(argv)
    if options.episodes < 1:
        raise UsageError(f"--episodes: expected at least 1, got {options.episodes}")
    if options.seed < 0:
        raise UsageError(f"--seed: expected a whole number from 0, got {options.seed}")
    if options.out is None:
        options.out = Path("runs") / f"evaluation-{datetime.now():%Y%m%d-%H%M%S}"
    check_new(options.out)
    check_writable(options.out, failure=ReportError)
    options.policy = list(dict.fromkeys(options.policy))
    return options


def main(argv: Sequence[str]) -> None:
    """Evaluate, print the table, write the report, log it."""
    options = _options(argv)
    settings = TaskSettings(reward=options.reward, budget=options.budget, width=options.width, height=options.height)
    choice = simulator_choice(options)
    for policy in options.policy:
        check_policy(policy)
    print(f"opening {options.scene} for {', '.join(map(described, options.policy))} …", flush=True)
    # All of them before the first episode, so that the last one's fault does not cost the others' time.
    contestants = [
        Contestant(
            policy,
            options.scene,
            settings,
            simulator=choice.simulator,
            gpu=choice.gpu,
            navmesh=choice.navmesh,
            up=choice.up,
            observation=options.observation,
            stochastic=options.stochastic,
            trusted=options.trusted,
        )
        for policy in options.policy
    ]
    done: dict[str, list[EpisodeResult]] = {}
    trajectories: dict[str, Trajectory] = {}
    try:
        _run(contestants, options, done, trajectories)
    except KeyboardInterrupt:
        _finish(contestants, done, trajectories, options, argv, complete=False)
        raise
    _finish(contestants, done, trajectories, options, argv, complete=True)


def _run(
    contestants: Sequence[Contestant],
    options: argparse.Namespace,
    done: dict[str, list[EpisodeResult]],
    trajectories: dict[str, Trajectory],
) -> None:
    """Fill in each policy's episodes, and the trajectory of its first one."""
    with progress(total=len(contestants) * options.episodes, desc="evaluating", unit="episode") as bar:
        for contestant in contestants:
            bar.set_description_str(contestant.name, refresh=False)
            done[contestant.name] = []
            for episode in run_episodes(contestant, options.episodes, options.seed, bar.update):
                done[contestant.name].append(episode)
                if contestant.trajectory is not None:
                    trajectories.setdefault(contestant.name, contestant.trajectory)


def _finish(
    contestants: Sequence[Contestant],
    done: dict[str, list[EpisodeResult]],
    trajectories: dict[str, Trajectory],
    options: argparse.Namespace,
    argv: Sequence[str],
    *,
    complete: bool,
) -> None:
    results = [contestant.result(done[contestant.name]) for contestant in contestants if done.get(contestant.name)]
    if not results:
        return
    about = _about(contestants[0], options, argv, complete=complete)
    print(f"{table(results)}\n\n{LEGEND}\n")
    write_report(options.out, results, about)
    if not complete:
        print(f"interrupted after {sum(len(result.seeds) for result in results)} episodes, which are kept")
    print(f"report:  {options.out}")
    if not options.no_mlflow:
        area = contestants[0].env.area
        pictures = {name: draw_trajectory(area, trajectory) for name, trajectory in trajectories.items()}
        _track(results, about, options, complete=complete, pictures=pictures)


def _track(results: Sequence[PolicyResult], about: dict[str, Any], options: argparse.Namespace, **more: Any) -> None:
    # Late: mlflow takes seconds to import.
    from avp_sb3.evaluation.tracking import track_evaluation

    run, experiment, store = track_evaluation(results, about, options.out, experiment=options.experiment, **more)
    print(f"MLflow:  run {run} in experiment {experiment!r} at {store}")


def _about(
    contestant: Contestant, options: argparse.Namespace, argv: Sequence[str], *, complete: bool
) -> dict[str, Any]:
    env = contestant.env
    settings = asdict(env.settings)
    del settings["observation"]  # Each policy has its own.
    return {
        "command": shlex.join(["python", "-m", "avp_sb3.evaluate", *argv]),
        "complete": complete,
        "scene": {"name": env.scene_name, "sha256": env.scene_digest, "navigable_cells": len(env.area.centres)},
        "simulator": {"name": env.simulator.name, "version": env.simulator.version},
        "seed": options.seed,
        "episodes": options.episodes,
        "stochastic": options.stochastic,
        "settings": settings,
    }


if __name__ == "__main__":
    sys.exit(command.run(main))
