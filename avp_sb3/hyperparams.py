"""What `rl_zoo3 train --conf-file avp_sb3.hyperparams` trains with: Table 4 of the paper, stepped as one batch.

The rewards share these values; choose one by `--env-kwargs reward:"'coverage'"`. rl_zoo3 sets the device by
`--device cpu`. PPO's buffer is `n_envs` times `n_steps`: change both together, for example `-params n_envs:4
n_steps:512`. To train in several rooms:
`-params vec_env_wrapper:"{'avp_sb3.zoo.Batched': {'scenes': ['builtin:1', 'builtin:2']}}"`.

On Habitat-Sim: `--env-kwargs simulator:"'habitat'"`. It allows one scene per process: for several add
`--vec-env subproc` with as many environments, for example `-params n_envs:2 n_steps:1024`; each is in a
process of its own.

Every training is a run of MLflow and leaves some of its episodes as `runs/avp-DATE-TIME.rrd` for Rerun. To have the
policy evaluated on other scenes too, and the best model kept, name all callbacks again:
`-params callback:"['avp_sb3.MLflowCallback', 'avp_sb3.MetricsCallback', 'avp_sb3.RerunCallback',
{'avp_sb3.EvaluationCallback': {'scenes': ['builtin:7', 'builtin:8'], 'every': 50000}}]"`.
"""

from typing import Any

from avp_sb3.presets import TABLE_4

_COMMON: dict[str, Any] = {
    "n_timesteps": 300_000,
    "policy": "MlpPolicy",
    "vec_env_wrapper": "avp_sb3.zoo.Batched",
    # When a training is interrupted rl_zoo3 ends the first callback only: the MLflow run is the one to close.
    "callback": ["avp_sb3.MLflowCallback", "avp_sb3.MetricsCallback", "avp_sb3.RerunCallback"],
}

hyperparams: dict[str, dict[str, Any]] = {"AVP-v0": TABLE_4.zoo() | _COMMON}
"""By environment, the form in which rl_zoo3 reads it."""
