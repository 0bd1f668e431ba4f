"""Program that asks one host which plugs of the manifest it sees, by the host's own means.

python -m avp_habitat.doctor.ask_host HOST    plugs as a JSON list on standard input, answers as JSON: name and group
                                              joined by a line feed, to null or to why the host does not see it
"""

import importlib
import json
import os
import sys
from collections.abc import Callable
from typing import Any

Plug = dict[str, str]
Look = Callable[[Plug], str | None]


def _object(plug: Plug) -> Any:
    module, name = plug["object"].split(":")
    return getattr(importlib.import_module(module), name)


def _is_a(plug: Plug, kind: type) -> str | None:
    found = _object(plug)
    return None if isinstance(found, type) and issubclass(found, kind) else f"{plug['object']} is no {kind.__name__}"


def _gymnasium() -> Look:
    import gymnasium

    importlib.import_module("avp_habitat")

    def look(plug: Plug) -> str | None:
        if plug["group"] == "wrapper":
            return _is_a(plug, gymnasium.Wrapper)
        gymnasium.spec(plug["name"])
        return None

    return look


def _stable_baselines3() -> Look:
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    return lambda plug: _is_a(plug, VecEnv if plug["group"] == "VecEnv" else BaseCallback)


def _rl_zoo3() -> Look:
    from rl_zoo3.utils import get_wrapper_class

    def look(plug: Plug) -> str | None:
        if plug["group"] == "--conf-file":
            ids = importlib.import_module(plug["name"]).hyperparams
            return None if ids else f"{plug['name']} has hyper-parameters of no environment"
        return None if get_wrapper_class({plug["group"]: plug["name"]}, plug["group"]) else "not a wrapper"

    return look


def _nerfstudio() -> Look:
    from nerfstudio.plugins.registry import discover_methods
    from nerfstudio.plugins.registry_dataparser import discover_dataparsers

    names = {
        "nerfstudio.method_configs": set(discover_methods()[0]),
        "nerfstudio.dataparser_configs": set(discover_dataparsers()[0]),
    }

    def look(plug: Plug) -> str | None:
        if plug["name"] in names.get(plug["group"], ()):
            return None
        # The suite's entry points give a stand-in with the reason for a plug that could not be made.
        return str(getattr(_object(plug), "reason", "not among what it discovers"))

    return look


def _mlflow() -> Look:
    from mlflow.tracking.context.registry import _run_context_provider_registry as providers

    return lambda plug: None if any(type(one) is _object(plug) for one in providers) else "not in its registry"


HOSTS: dict[str, Callable[[], Look]] = {
    "gymnasium": _gymnasium,
    "stable-baselines3": _stable_baselines3,
    "rl_zoo3": _rl_zoo3,
    "nerfstudio": _nerfstudio,
    "mlflow": _mlflow,
}


def _reason(look: Look, plug: Plug) -> str | None:
    try:
        return look(plug)
    except Exception as error:  # whatever a host or a plug raises is the answer
        return " ".join(f"{type(error).__name__}: {error}".split())


def main(host: str) -> None:
    """Read the plugs, ask the host, print the answers."""
    # What hosts print must not mix with the answer.
    answer_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    plugs = json.load(sys.stdin)
    look = HOSTS[host]()
    answers = {f"{plug['name']}\n{plug['group']}": _reason(look, plug) for plug in plugs}
    print(json.dumps(answers), file=answer_to, flush=True)
    # Some hosts leave threads behind that would keep this process.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1])
