"""Train a viewpoint policy with Stable-Baselines3's PPO and the suite's callbacks (Table 4's values)."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.settings import TaskSettings

_BUFFER = 2048


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add("--scene", default="builtin:0", help="a mesh (.glb .gltf .ply .obj), or builtin:SEED")
    add("--reward", default="proposed", help="coverage, coverage_redundancy or proposed")
    add("--steps", default=300_000, type=int, help="environment steps")
    add("--agents", default=16, type=int, help="agents stepped as one batch")
    add("--width", default=160, type=int, help="of the policy's depth image in pixels")
    add("--height", default=120, type=int, help="of the policy's depth image in pixels")
    add("--seed", default=0, type=int, help="of the policy and the starts")
    add("--out", default=Path("runs/ppo.zip"), type=Path, help="the model; also written after Ctrl-C")
    add("--recording", default=None, type=Path, help="the Rerun recording (.rrd) of some episodes; none when omitted")
    add("--run-name", default=None, help="of the MLflow run")
    return parser


def main(argv: Sequence[str]) -> None:
    """Train, track and save."""
    options = _parser().parse_args(argv)
    if options.agents < 1 or _BUFFER % options.agents:
        raise UsageError(f"--agents: expected a divisor of PPO's buffer of {_BUFFER} steps, got {options.agents}")
    if options.steps < 1:
        raise UsageError(f"--steps: expected at least 1, got {options.steps}")
    settings = TaskSettings(reward=options.reward, width=options.width, height=options.height)

    # Late, so that --help and a mistyped option answer at once.
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from avp_sb3 import AVPVecEnv, MetricsCallback, MLflowCallback, RerunCallback

    # The policy is a small network: one thread of torch leaves the other core to the rays.
    torch.set_num_threads(1)
    env = VecMonitor(AVPVecEnv(options.scene, agents=options.agents, settings=settings, seed=options.seed))
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=3e-4,
        ent_coef=0.02,
        clip_range=0.2,
        n_steps=_BUFFER // options.agents,
        n_epochs=10,
        batch_size=512,
        gae_lambda=0.95,
        gamma=0.99,
        device="cpu",
        seed=options.seed,
    )
    tracking = MLflowCallback(run_name=options.run_name)
    callbacks = [MetricsCallback(), tracking]
    if options.recording is not None:
        callbacks.append(RerunCallback(options.recording))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tracking:
            model.learn(options.steps, callback=callbacks, progress_bar=True)
    finally:
        model.save(options.out)
        print(f"{options.out}: the policy after {model.num_timesteps} steps; MLflow run {tracking.run_id}")


if __name__ == "__main__":
    sys.exit(command.run(main))
