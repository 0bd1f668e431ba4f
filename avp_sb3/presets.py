"""PPO's settings for each kind of observation, shared by rl_zoo3's configurations and scripts."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class PPOPreset:
    """Arguments of PPO, and how many agents share its buffer."""

    n_envs: int
    """Agents stepped as one batch."""
    n_steps: int
    """Steps of each agent between two updates; the buffer holds `n_envs * n_steps`."""
    batch_size: int
    """Steps in a minibatch."""
    n_epochs: int
    """Passes over the buffer in an update."""
    learning_rate: float
    """At the start."""
    linear: bool
    """Whether the learning rate falls to zero at the end."""
    ent_coef: float
    """Weight of the policy's entropy."""
    clip_range: float = 0.2
    """Of the policy's ratio."""
    gae_lambda: float = 0.95
    """Of the advantage estimate."""
    gamma: float = 0.99
    """Discount per step."""
    net_arch: tuple[int, ...] = (64, 64)
    """Units of the layers of the policy's network, and of the value's; these are SB3's own."""

    def arguments(self) -> dict[str, Any]:
        """The keyword arguments of `stable_baselines3.PPO` but the number of agents."""
        from stable_baselines3.common.utils import LinearSchedule

        arguments = asdict(self)
        del arguments["n_envs"]
        arguments["policy_kwargs"] = {"net_arch": list(arguments.pop("net_arch"))}
        if arguments.pop("linear"):
            arguments["learning_rate"] = LinearSchedule(self.learning_rate, 0.0, 1.0)
        return arguments

    def zoo(self) -> dict[str, Any]:
        """The same as rl_zoo3 writes it."""
        settings = asdict(self)
        settings["policy_kwargs"] = {"net_arch": list(settings.pop("net_arch"))}
        if settings.pop("linear"):
            settings["learning_rate"] = f"lin_{self.learning_rate:g}"
        return settings


TABLE_4 = PPOPreset(n_envs=64, n_steps=32, batch_size=512, n_epochs=10, learning_rate=3e-4, linear=False, ent_coef=0.02)
"""Table 4 of the paper: a buffer of 2048 steps, here of 64 agents."""
MAP = PPOPreset(n_envs=64, n_steps=128, batch_size=1024, n_epochs=6, learning_rate=5e-4, linear=True, ent_coef=0.01)
"""For the map: a larger buffer and fewer passes; chosen after a few trials on white_room (docs/training.md)."""
ONBOARD = PPOPreset(
    n_envs=128,
    n_steps=64,
    batch_size=2048,
    n_epochs=4,
    learning_rate=5e-4,
    linear=True,
    ent_coef=0.02,
    gamma=0.98,
    net_arch=(256, 128),
)
"""For what a robot knows; of many scenes, in which many agents of a scene share the cost of a call."""
PRESETS = {"numbers": TABLE_4, "map": MAP, "surface_map": MAP, "onboard": ONBOARD, "privileged": ONBOARD}
"""By kind of observation."""
