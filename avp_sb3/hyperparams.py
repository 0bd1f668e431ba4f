"""What `rl_zoo3 train --conf-file avp_sb3.hyperparams` trains with: Table 4 of the paper, stepped as one batch.

The three rewards share these values; choose one by `--env-kwargs reward:"'coverage'"`. rl_zoo3 sets the device by
`--device cpu`. PPO's buffer is `n_envs` times `n_steps`: change both together, for example `-params n_envs:4
n_steps:512`. To train in several rooms:
`-params vec_env_wrapper:"{'avp_sb3.zoo.Batched': {'scenes': ['builtin:1', 'builtin:2']}}"`.
"""

from typing import Any

BUFFER = 2048
"""Steps of all agents between two updates."""
AGENTS = 16
"""Agents stepped as one batch; they share the buffer."""

_TABLE_4: dict[str, Any] = {
    "n_timesteps": 300_000,
    "policy": "MlpPolicy",
    "learning_rate": 3e-4,
    "ent_coef": 0.02,
    "clip_range": 0.2,
    "n_envs": AGENTS,
    "n_steps": BUFFER // AGENTS,
    "n_epochs": 10,
    "batch_size": 512,
    "gae_lambda": 0.95,
    "gamma": 0.99,
    "vec_env_wrapper": "avp_sb3.zoo.Batched",
    # When a training is interrupted rl_zoo3 ends the first callback only: the MLflow run is the one to close.
    "callback": ["avp_sb3.MLflowCallback", "avp_sb3.MetricsCallback"],
}

hyperparams: dict[str, dict[str, Any]] = {"AVP-v0": _TABLE_4}
"""By environment, the form in which rl_zoo3 reads it."""
