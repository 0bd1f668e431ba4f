"""Programs that the doctor starts, because what is asked may crash, hang or print; they answer in JSON.

python -m avp_habitat.doctor.probe host NAME < PLUGS    why the host does not see each plug, or null
python -m avp_habitat.doctor.probe simulator NAME       what it did with the built-in room, or `error`
"""

import importlib
import json
import os
import sys
import time
from typing import Any

Plug = dict[str, str]


def _object(plug: Plug) -> Any:
    module, name = plug["object"].split(":")
    return getattr(importlib.import_module(module), name)


def _is_a(plug: Plug, kind: type) -> str | None:
    found = _object(plug)
    return None if isinstance(found, type) and issubclass(found, kind) else f"{plug['object']} is no {kind.__name__}"


def _gymnasium(plug: Plug) -> str | None:
    import gymnasium

    if plug["group"] == "wrapper":
        return _is_a(plug, gymnasium.Wrapper)
    importlib.import_module("avp_habitat")
    gymnasium.spec(plug["name"])
    return None


def _stable_baselines3(plug: Plug) -> str | None:
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    return _is_a(plug, VecEnv if plug["group"] == "VecEnv" else BaseCallback)


def _rl_zoo3(plug: Plug) -> str | None:
    from rl_zoo3.utils import get_wrapper_class

    if plug["group"] == "--conf-file":
        known = importlib.import_module(plug["name"]).hyperparams
        return None if known else f"{plug['name']} has hyper-parameters of no environment"
    return None if get_wrapper_class({plug["group"]: plug["name"]}, plug["group"]) else "not a wrapper"


def _nerfstudio(plug: Plug) -> str | None:
    from nerfstudio.plugins.registry import discover_methods
    from nerfstudio.plugins.registry_dataparser import discover_dataparsers

    discover = discover_methods if plug["group"] == "nerfstudio.method_configs" else discover_dataparsers
    # The suite's entry points give a stand-in with the reason for a plug that could not be made.
    return None if plug["name"] in discover()[0] else str(getattr(_object(plug), "reason", "it discovers others only"))


def _mlflow(plug: Plug) -> str | None:
    from mlflow.tracking.context.registry import _run_context_provider_registry as providers

    return None if any(type(one) is _object(plug) for one in providers) else "not in its registry"


_HOSTS = {
    "gymnasium": _gymnasium,
    "stable-baselines3": _stable_baselines3,
    "rl_zoo3": _rl_zoo3,
    "nerfstudio": _nerfstudio,
    "mlflow": _mlflow,
}


def _host(name: str) -> list[str | None]:
    return [_reason(name, plug) for plug in json.load(sys.stdin)]


def _reason(host: str, plug: Plug) -> str | None:
    try:
        return _HOSTS[host](plug)
    except Exception as error:  # whatever a host or a plug raises is the answer
        return " ".join(f"{type(error).__name__}: {error}".split())


def _simulator(name: str) -> dict[str, Any]:
    """Version, seconds and nearest depth in metres of one small frame; `error` instead when it cannot run here."""
    import numpy as np

    from avp_habitat.errors import AVPError
    from avp_habitat.poses import Intrinsics
    from avp_habitat.simulators.registry import make_simulator

    start = time.monotonic()
    try:
        simulator = make_simulator(name, "builtin:0")
        pose = np.eye(4)
        pose[:3, 3] = simulator.area.random_points(np.random.default_rng(0), 1)[0] + [0.0, 1.5, 0.0]
        frames = simulator.render(pose[None], Intrinsics.from_hfov(32, 24, hfov_deg=90.0), rgb=True)
    except AVPError as error:
        return {"error": str(error)}
    seen = frames.depth[frames.depth > 0]
    if frames.rgb is None or not len(seen):
        return {"error": "it rendered an empty picture of the built-in room"}
    return {"version": simulator.version, "seconds": time.monotonic() - start, "nearest_m": float(seen.min())}


if __name__ == "__main__":
    # What hosts and engines print must not mix with the answer.
    answer_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print(json.dumps({"host": _host, "simulator": _simulator}[sys.argv[1]](sys.argv[2])), file=answer_to, flush=True)
    # Some leave threads behind that would keep this process, and drivers may crash while Python is taken down.
    os._exit(0)
