"""A policy of dense layers that acts by NumPy alone: no torch, no pickle."""

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.policies.weights import PRETRAINED, weights_file
from avp_habitat.policies.weights.format import PolicyWeights, outputs, read_weights


class PretrainedPolicy:
    """Acts as the Stable-Baselines3 model from which its weights were exported."""

    def __init__(self, weights: PolicyWeights, seed: int = 0) -> None:
        """Act by weights; the seed is of actions that are sampled."""
        self.weights = weights
        self.avp_mlflow_run_id: str | None = weights.training.get("mlflow_run_id")
        self.set_random_seed(seed)

    @classmethod
    def load(cls, policy: str, seed: int = 0) -> Self:
        """By `pretrained`, `pretrained:NAME`, the folder of a policy or its `.json`; without an environment.

        Raises:
            UsageError: there is none.
            PolicyError: its files cannot be used.
        """
        path = weights_file(policy)
        if path is None:
            raise UsageError(
                f"policy {policy!r}: expected {PRETRAINED}, {PRETRAINED}:NAME, or a policy's folder or .json"
            )
        return cls(read_weights(path), seed)

    @classmethod
    def for_env(cls, env: Any, seed: int) -> Self:
        """The package's default weights."""
        return cls.load(PRETRAINED, seed)

    def set_random_seed(self, seed: int) -> None:
        """Seed the draws of actions."""
        self._rng = np.random.default_rng(seed)

    def logits(self, observation: NDArray) -> NDArray[np.float32]:
        """`(n, actions)` logits for `(n, *shape)` observations."""
        seen = self.weights.statistics
        known = observation if seen is None else seen.normalise(observation)
        return outputs(self.weights.actor, known.reshape(len(known), -1))

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.int64], Any]:
        """The likeliest actions or sampled ones, `(n,)` for n observations, `()` for one; the state is given back.

        Raises:
            PolicyError: the observations are not of the shape that the policy was made for.
        """
        observation, shape = np.asarray(observation), self.weights.shape
        single = observation.shape == shape
        batch = observation[None] if single else observation
        if batch.shape[1:] != shape or batch.ndim != 1 + len(shape):
            name = self.weights.name
            raise PolicyError(
                f"policy {name}: made for observations of shape {shape}, got an array {observation.shape}"
            )
        scores = self.logits(batch)
        if not deterministic:
            # The greatest of logits with Gumbel noise is distributed as the softmax says.
            scores = scores + self._rng.gumbel(size=scores.shape)
        actions = scores.argmax(axis=1)
        return (np.asarray(actions[0]) if single else actions), state

    def get_vec_normalize_env(self) -> None:
        """None: as Stable-Baselines3's models say that observations come as they are."""
