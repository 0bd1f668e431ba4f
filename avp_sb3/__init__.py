"""The batched environment, callbacks and evaluation for Stable-Baselines3, imported when they are first named."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avp_sb3.evaluation import PolicyResult, evaluate_policy
    from avp_sb3.evaluation_callback import EvaluationCallback
    from avp_sb3.metrics_callback import MetricsCallback
    from avp_sb3.mlflow_callback import MLflowCallback
    from avp_sb3.rerun_callback import RerunCallback
    from avp_sb3.subproc import AVPSubprocVecEnv
    from avp_sb3.vec_env import AVPVecEnv

__all__ = [
    "AVPSubprocVecEnv",
    "AVPVecEnv",
    "EvaluationCallback",
    "MLflowCallback",
    "MetricsCallback",
    "PolicyResult",
    "RerunCallback",
    "evaluate_policy",
]

_HOME = {
    "AVPSubprocVecEnv": "avp_sb3.subproc",
    "AVPVecEnv": "avp_sb3.vec_env",
    "EvaluationCallback": "avp_sb3.evaluation_callback",
    "MetricsCallback": "avp_sb3.metrics_callback",
    "MLflowCallback": "avp_sb3.mlflow_callback",
    "RerunCallback": "avp_sb3.rerun_callback",
    "PolicyResult": "avp_sb3.evaluation",
    "evaluate_policy": "avp_sb3.evaluation",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
