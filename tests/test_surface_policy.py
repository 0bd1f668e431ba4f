import pytest
from corridor import Corridor
from stable_baselines3 import PPO

from avp_habitat.policies.registry import make_policy_env
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import OBSERVATIONS, TaskSettings


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_a_model_gets_the_observation_that_it_was_trained_on(kind, tmp_path):
    settings = TaskSettings(reward="surface", width=16, height=12, budget=4)
    simulator = Corridor()
    trained = AVPEnv(simulator=simulator, settings=settings, observation=kind)
    PPO("MlpPolicy", trained, n_steps=8, batch_size=8, device="cpu").save(tmp_path / "model.zip")
    env, policy = make_policy_env(str(tmp_path / "model.zip"), simulator, settings)
    assert env.settings.observation == kind
    observation, _ = env.reset(seed=0)
    assert policy.predict(observation)[0] in range(6)
