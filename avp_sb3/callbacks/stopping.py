"""Keep the action stop worth trying while it is learned."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from avp_habitat.task.settings import STOP
from avp_sb3.callbacks.base import finished_episodes


class StopCallback(BaseCallback):
    """Raise the bias of stop's logit while too few episodes end by it.

    Where stop ends an episode at any time, most stops come too early at first: PPO learns never to stop, tries it no
    more, and does not find out that a late stop pays. The bias is the same for all observations: with it rising,
    what is left to the network is to tell when.
    """

    def __init__(self, share: float = 0.95, rate: float = 0.1) -> None:
        """Aim at this share of episodes that end by stop, raising the logit by `rate` in each update below it."""
        super().__init__()
        self._share, self._rate = share, rate
        self._stopped: list[bool] = []

    def _on_step(self) -> bool:
        self._stopped += [bool(info["avp_episode"]["stopped"]) for _, info in finished_episodes(self.locals)]
        return True

    def _on_rollout_end(self) -> None:
        policy: Any = self.model.policy
        if self._stopped and sum(self._stopped) < self._share * len(self._stopped):
            policy.action_net.bias.data[STOP] += self._rate
        self._stopped.clear()
