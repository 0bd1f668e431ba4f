"""The batched environment, callbacks and evaluation for Stable-Baselines3, imported when they are first named."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avp_sb3.callbacks.evaluation import EvaluationCallback
    from avp_sb3.callbacks.metrics import MetricsCallback
    from avp_sb3.callbacks.mlflow import MLflowCallback
    from avp_sb3.callbacks.rerun import RerunCallback
    from avp_sb3.callbacks.stopping import StopCallback
    from avp_sb3.evaluation.policy import PolicyResult, evaluate_policy
    from avp_sb3.vec_env.batched import AVPVecEnv
    from avp_sb3.vec_env.subproc import AVPSubprocVecEnv

__all__ = [
    "AVPSubprocVecEnv",
    "AVPVecEnv",
    "EvaluationCallback",
    "MLflowCallback",
    "MetricsCallback",
    "PolicyResult",
    "RerunCallback",
    "StopCallback",
    "evaluate_policy",
]

_HOME = {
    "AVPSubprocVecEnv": "avp_sb3.vec_env.subproc",
    "AVPVecEnv": "avp_sb3.vec_env.batched",
    "EvaluationCallback": "avp_sb3.callbacks.evaluation",
    "MetricsCallback": "avp_sb3.callbacks.metrics",
    "MLflowCallback": "avp_sb3.callbacks.mlflow",
    "RerunCallback": "avp_sb3.callbacks.rerun",
    "StopCallback": "avp_sb3.callbacks.stopping",
    "PolicyResult": "avp_sb3.evaluation.policy",
    "evaluate_policy": "avp_sb3.evaluation.policy",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
