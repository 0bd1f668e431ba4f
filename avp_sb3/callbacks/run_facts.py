"""What is worth knowing about a training before it starts: hyper-parameters, task settings, scenes."""

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.provenance import flat
from avp_habitat.task.settings import TaskSettings

_NOT_HYPERPARAMETERS = {"self", "env", "policy", "verbose", "tensorboard_log", "_init_setup_model"}


def hyperparameters(model: BaseAlgorithm) -> dict[str, Any]:
    """The arguments of the algorithm's constructor with the values in use, flat, plus `algo`, `policy`, `n_envs`.

    A constant schedule is its number; a changing one reads `start -> end`.
    """
    facts: dict[str, Any] = {
        "algo": type(model).__name__,
        "policy": model.policy_class.__name__,
        "n_envs": model.n_envs,
        "total_timesteps": model._total_timesteps,
    }
    for name in inspect.signature(type(model).__init__).parameters:
        if name not in _NOT_HYPERPARAMETERS and hasattr(model, name):
            facts[name] = _plain(getattr(model, name))
    return flat(facts)


def task_settings(env: VecEnv) -> dict[str, Any]:
    """`env.*`: the settings of the first environment (attribute `settings`, a dataclass), flat; its gymnasium id."""
    facts: dict[str, Any] = {}
    settings = env.get_attr("settings", 0)[0] if env.has_attr("settings") else None
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        facts |= settings.facts() if isinstance(settings, TaskSettings) else dataclasses.asdict(settings)
    spec = env.get_attr("spec", 0)[0] if env.has_attr("spec") else None
    if spec is not None:
        facts["id"] = spec.id
    return flat({"env": facts})


def run_name(model: BaseAlgorithm, env: VecEnv) -> str:
    """Algorithm, reward, scene and seed, as far as there are any: `ppo proposed builtin:0 seed 0`.

    MLflow would draw a name at random, the same one after each training with the same seed.
    """
    task, scenes = task_settings(env), _each_once(env, "scene_name")
    words = [type(model).__name__.lower(), task.get("env.reward"), scenes[0] if scenes else task.get("env.id")]
    words += [f"and {len(scenes) - 1} more"] if len(scenes) > 1 else []
    words += [] if model.seed is None else [f"seed {model.seed}"]
    return " ".join(str(word) for word in words if word is not None)


def scene_tags(env: VecEnv) -> dict[str, str]:
    """Names and SHA-256 digests of the scenes of all environments, each once, where they have such attributes."""
    named = {"avp.scene": _each_once(env, "scene_name"), "avp.scene_digest": _each_once(env, "scene_digest")}
    return {tag: ", ".join(values) for tag, values in named.items() if values}


def _each_once(env: VecEnv, attribute: str) -> list[str]:
    """The values of an attribute over the environments; none where they have no such attribute."""
    return list(dict.fromkeys(map(str, env.get_attr(attribute)))) if env.has_attr(attribute) else []


def _plain(value: Any) -> Any:
    """A value whose text says what it is, without memory addresses."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, type) or not callable(value):
        return getattr(value, "__name__", value)
    try:
        start, end = (float(value(progress)) for progress in (1.0, 0.0))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return getattr(value, "__name__", type(value).__name__)
    return start if start == end else f"{start:g} -> {end:g}"
