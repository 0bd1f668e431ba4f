"""The policies by name, and one episode of a policy in `AVP-v0`, step by step."""

import inspect
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from avp_habitat import plugins
from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.policies.saved_model import ALGORITHMS, NormalisedPolicy, load_model, statistics_of
from avp_habitat.policies.weights import PRETRAINED, weights_file
from avp_habitat.policies.weights.format import read_facts, read_weights
from avp_habitat.policies.weights.policy import PretrainedPolicy
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.rewards import REWARDS
from avp_habitat.task.settings import OBSERVATIONS, TaskSettings


class MisfitError(PolicyError):
    """A model that was trained for other observations or actions."""


class Policy(Protocol):
    """Stable-Baselines3's `predict`."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Actions and the next recurrent state."""
        ...


POLICIES = {
    PRETRAINED: "avp_habitat.policies.weights.policy:PretrainedPolicy.for_env",
    "heuristic": "avp_habitat.policies.reactive:HeuristicPolicy.for_env",
    "random": "avp_habitat.policies.reactive:RandomPolicy.for_env",
    "spin": "avp_habitat.policies.reactive:SpinPolicy.for_env",
    "frontier": "avp_habitat.policies.frontier:FrontierPolicy.for_env",
    "greedy": "avp_habitat.policies.greedy:GreedyPolicy.for_env",
    "nbv": "avp_habitat.policies.nbv.planner:NextBestViewPolicy.for_env",
    "oracle": "avp_habitat.policies.oracle.policy:OraclePolicy.for_env",
    "survey": "avp_habitat.policies.oracle.policy:SurveyPolicy.for_env",
    "survey-multiview": "avp_habitat.policies.oracle.policy:MultiviewSurveyPolicy.for_env",
}
"""By name the package's weights and the baselines: each is a function of (env, seed) that gives a `Policy`."""
POLICIES_HELP = (
    f"{', '.join(POLICIES)}, {PRETRAINED}:NAME, MODULE:OBJECT, an exported policy's folder, or a model (.zip)"
)
"""Help of the option `--policy`."""
TRUSTED = "open a model also where that may run code which its file holds: only if you know who made it"
"""Help of the option `--trusted`."""
_FELT = ("forward_m", "turn_deg", "tilt_deg", "pitch_limit_deg", "sensor_height_m", "hfov_deg")
"""Settings of body and camera: a policy acts in others than its own, but hardly well."""


def check_policy(policy: Any) -> Any:
    """The policy itself, as `make_policy` takes it, when there is such a one.

    Raises:
        UsageError: no such name, object or file; the text names the nearest name.
        PolicyError: a model was trained under `VecNormalize`, and its statistics are not beside it; or the files of an
            exported policy cannot be used.
    """
    file, weights = _model_file(policy), exported_file(policy)
    if weights is not None:
        read_weights(weights)
    elif file is None:
        if policy not in POLICIES:  # Those are imported by who makes one.
            plugins.find("avp.policies", policy, POLICIES | {"MODEL.zip": "", "FOLDER": ""})
    elif not file[0].is_file():
        raise UsageError(f"--policy {policy}: no such model file")
    else:
        statistics_of(file[0])
    return policy


def described(policy: Any) -> str:
    """A policy as it will act, for the screen: with the statistics by which a model sees, or its weights' version."""
    file, name = _model_file(policy), plugins.name_of(policy)
    if (weights := exported_file(policy)) is not None:
        facts = read_facts(weights)
        return f"{name} ({facts['name']}, version {facts['version']})"
    statistics = None if file is None else statistics_of(file[0])
    return name if statistics is None else f"{name} with the statistics {statistics}"


def _model_file(policy: Any) -> tuple[Path, str | None] | None:
    """Path and algorithm of `MODEL.zip` or `ALGORITHM:MODEL.zip`; None for what is no such text."""
    if not isinstance(policy, str) or not policy.endswith(".zip"):
        return None
    algorithm, _, path = policy.partition(":")
    return (Path(path), algorithm) if algorithm in ALGORITHMS else (Path(policy), None)


def exported_file(policy: Any) -> Path | None:
    """The `.json` of a policy that is the package's or an exported one; None for every other policy.

    Errors are those of `weights.weights_file`.
    """
    others = [name for name in plugins.names("avp.policies", POLICIES) if name != PRETRAINED]
    return None if policy in others else weights_file(policy)


def learned_reward(policy: Any) -> str | None:
    """The reward from which a policy's weights learned, which decides when a stop ends the episode; None for others.

    A reward that is `module:object` has to be given by the user, so that no file chooses what is imported.
    """
    weights = exported_file(policy)
    name = None if weights is None else read_facts(weights)["settings"].get("reward")
    return name if name in plugins.names("avp.rewards", REWARDS) else None


def make_policy(policy: Any, env: AVPEnv, seed: int, *, trusted: bool = False) -> Policy:
    """The policy for an environment.

    Args:
        policy: a baseline's name, another distribution's, or `module:object`, which is (or the object itself) either
            something with `predict`, or a class or function of (env, seed) that gives such a thing; what planners know
            about the agents is `agent_view.agent_views(env)`. Or a model saved by Stable-Baselines3 or sb3-contrib,
            `MODEL.zip`, or `ALGORITHM:MODEL.zip` where the file does not tell. One that was trained under
            `VecNormalize` sees observations normalised with the statistics beside it. Or weights: `pretrained`,
            `pretrained:NAME`, the folder of a policy that `python -m avp_sb3.export` wrote, or the `.json` in it.
        env: what it acts in.
        seed: of a policy that draws at random.
        trusted: open a model's file also where that may run code which the file holds.

    Raises:
        UsageError: no such policy, or it is no policy.
        MisfitError: the model was trained for other observations or actions.
        PolicyError: the file is no such model, holds what may run code, or lacks its statistics.
    """
    weights = exported_file(policy)
    if weights is not None:
        return _of_weights(policy, weights, env, seed)
    check_policy(policy)
    file = _model_file(policy)
    if file is None:
        return _made(policy, plugins.find("avp.policies", policy, POLICIES), env, seed)
    path, algorithm = file
    model = load_model(path, algorithm=algorithm, trusted=trusted)
    for kind in ("observation_space", "action_space"):
        learned, offered = getattr(model, kind), getattr(env, kind)
        if learned != offered:
            raise MisfitError(f"{policy}: trained for the {kind} {learned}, but this environment has {offered}")
    model.set_random_seed(seed)
    statistics = statistics_of(path)
    return model if statistics is None else NormalisedPolicy(model, statistics, trusted=trusted)


def _of_weights(policy: str, path: Path, env: AVPEnv, seed: int) -> Policy:
    weights = read_weights(path)
    kind, shape = plugins.name_of(env.settings.observation), env.observation_space.shape
    if (kind, shape) != (weights.observation, weights.shape):
        made = f"{weights.observation!r} of shape {weights.shape}"
        raise MisfitError(f"{policy}: made for the observation {made}, but this environment has {kind!r} of {shape}")
    actions = len(weights.actor[-1].bias)
    if (offered := getattr(env.action_space, "n", None)) != actions:
        raise MisfitError(f"{policy}: made for {actions} actions, but this environment has {offered}")
    made, offered = weights.settings, env.settings.facts()
    others = [
        f"{name} {made[name]}, here {offered[name]}" for name in _FELT if name in made and made[name] != offered[name]
    ]
    if others:
        warnings.warn(
            f"policy {policy}: made for other settings than this environment has: {', '.join(others)}", stacklevel=3
        )
    return PretrainedPolicy(weights, seed)


def _made(policy: Any, found: Any, env: AVPEnv, seed: int) -> Policy:
    name = plugins.name_of(policy)
    what = f"policy {name!r}: expected something with `predict`, or a class or function of (env, seed)"
    if isinstance(found, type) or not hasattr(found, "predict"):
        try:
            inspect.signature(found).bind(env, seed)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{what} that gives one: {error}") from None
        found = found(env, seed)
    if not callable(getattr(found, "predict", None)):
        raise UsageError(f"{what} that gives one, got {type(found).__name__}")
    return found


def make_policy_env(
    policy: Any,
    simulator: Simulator,
    settings: TaskSettings,
    *,
    seed: int = 0,
    observation: Any = None,
    trusted: bool = False,
) -> tuple[AVPEnv, Policy]:
    """An environment, and the policy that acts in it; arguments that both have are those of `make_policy`.

    Without a kind of observation it is the first one that fits, of the settings' own, those that are built in and those
    that other distributions register: a baseline fits each, a model its own. Weights name theirs; where that is
    `module:object`, it has to be given, so that no file chooses what is imported.

    Raises:
        UsageError: no such policy or observation.
        PolicyError: the model cannot be loaded, or fits no kind of observation.
    """
    kinds, weights = [observation], exported_file(policy)
    if observation is None and weights is not None:
        kinds = [observation_of(weights)]
    elif observation is None:
        kinds = [settings.observation, *plugins.names("avp.observations", OBSERVATIONS)]
    misfits: list[MisfitError] = []
    for kind in kinds:
        env = AVPEnv(simulator.scene, simulator=simulator, settings=replace(settings, observation=kind))
        try:
            return env, make_policy(policy, env, seed, trusted=trusted)
        except MisfitError as error:
            misfits.append(error)
    raise misfits[0]


def observation_of(weights: Path) -> str:
    """The kind of observation that a policy's `.json` names.

    Raises:
        PolicyError: it names an object of a module, which only the user may choose.
    """
    kind = str(read_facts(weights)["observation"]["kind"])
    if ":" in kind:
        raise PolicyError(f"{weights}: made for the observation {kind}, a program's own; give --observation {kind}")
    return kind


@dataclass(frozen=True)
class Step:
    """What one step of the environment gave."""

    observation: Any
    """By which the action was chosen."""
    action: int
    """Number of the action taken."""
    reward: float
    """Of the step."""
    info: dict[str, Any]
    """Of the step; the last one of the episode holds `avp_episode` and `avp_trajectory`."""


def steps_of(env: gymnasium.Env, policy: Policy, *, seed: int, deterministic: bool = True) -> Iterator[Step]:
    """Run one episode of an `AVPEnv`, which stands where each step left it while the caller has that step.

    The policy is asked with its recurrent state, if it has one, and samples a model's actions unless `deterministic`;
    the seed is that of the start.
    """
    observation, _ = env.reset(seed=seed)
    state: Any = None
    first = np.array([True])
    ended = False
    while not ended:
        chosen, state = policy.predict(observation, state, first, deterministic=deterministic)
        action, seen = int(np.asarray(chosen).item()), observation
        observation, reward, terminated, truncated, info = env.step(action)
        first = np.array([False])
        ended = terminated or truncated
        yield Step(seen, action, float(reward), info)
