import pytest
import torch
from corridor import Corridor
from stable_baselines3 import PPO

from avp_habitat.task.settings import STOP, TaskSettings
from avp_sb3 import AVPVecEnv, StopCallback


@pytest.mark.parametrize(("logit", "raised"), [(-30.0, 3 * 0.5), (30.0, 0.0)])
def test_stops_logit_rises_only_while_too_few_episodes_end_by_it(logit, raised):
    settings = TaskSettings(reward="surface", budget=4, width=16, height=12)
    env = AVPVecEnv(agents=4, simulator=Corridor(), settings=settings, seed=0)
    # Without learning, so that nothing else moves the logit.
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=32, n_epochs=1, learning_rate=0.0, device="cpu", seed=0)
    bias = model.policy.action_net.bias
    with torch.no_grad():
        bias[STOP] = logit
    others = bias.detach().clone()
    model.learn(3 * 32, callback=StopCallback(rate=0.5))
    others[STOP] += raised
    torch.testing.assert_close(bias.detach(), others)
