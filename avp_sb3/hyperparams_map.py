"""What `rl_zoo3 train --conf-file avp_sb3.hyperparams_map` trains with.

rl_zoo3 takes `--env-kwargs` instead of the `env_kwargs` here: whoever gives some must repeat `observation:"'map'"`.
"""

from typing import Any

from avp_sb3.hyperparams import hyperparams as _numbers
from avp_sb3.presets import MAP

hyperparams: dict[str, dict[str, Any]] = {
    "AVP-v0": _numbers["AVP-v0"] | MAP.zoo() | {"n_timesteps": 1_000_000, "env_kwargs": {"observation": "map"}}
}
"""By environment, the form in which rl_zoo3 reads it."""
