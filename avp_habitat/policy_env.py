"""The environment with the kind of observation that a policy was trained on."""

from dataclasses import replace

from avp_habitat.env import AVPEnv
from avp_habitat.policies import MisfitError, Policy, make_policy
from avp_habitat.settings import OBSERVATION_NAMES, TaskSettings
from avp_habitat.simulators import Simulator


def make_policy_env(
    policy: str,
    simulator: Simulator,
    settings: TaskSettings,
    *,
    seed: int = 0,
    observation: str | None = None,
    trusted: bool = False,
) -> tuple[AVPEnv, Policy]:
    """An environment, and the policy that acts in it.

    Args:
        policy: a baseline's name, or a model saved by Stable-Baselines3 (`.zip`).
        simulator: an open one.
        settings: of the task.
        seed: of a policy that draws at random.
        observation: the kind; when omitted, the first one that fits: a baseline fits each, a model its own.
        trusted: open a model's file also where that may run code which the file holds.

    Raises:
        UsageError: no such policy or observation.
        PolicyError: the model cannot be loaded, or fits no kind of observation.
    """
    first: MisfitError | None = None
    for kind in OBSERVATION_NAMES if observation is None else (observation,):
        env = AVPEnv(simulator.scene, simulator=simulator, settings=replace(settings, observation=kind))
        try:
            return env, make_policy(policy, env, seed, trusted=trusted)
        except MisfitError as error:
            first = first or error
    assert first is not None
    raise first
