"""The handover environment as stable-baselines3 wants it: its own vector interface, observations flat and scaled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from safeswitch.handover.env import HandoverVectorEnv
from safeswitch.protocols import Array


class TrainingEnv(VecEnv):
    """Counts the episodes and the steps that the expert would drive.

    Args:
        games: the environment.
        scale: observation (..., history, S) to what the policy sees.
        seed: of the draws of episodes.
    """

    def __init__(self, games: HandoverVectorEnv, scale: Callable[[Array], Array], seed: int) -> None:
        self.games, self.scale = games, scale
        self.episodes = self.expert_steps = 0
        self._first, self._actions = seed, np.zeros(games.num_envs, np.int64)
        size = int(np.prod(games.decisions.observation_space.shape))
        space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        super().__init__(games.num_envs, space, games.decisions.action_space)

    def reset(self) -> NDArray[np.float32]:  # type: ignore[override]
        """Draw the first episodes; all draws follow from the seed."""
        return self._seen(self.games.reset(seed=self._first)[0])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:  # type: ignore[override]
        """Take the step."""
        observation, reward, done, _, info = self.games.step(self._actions)
        if done.any():
            self.episodes += int(done.sum())
            horizon = self.games.decisions.horizon
            self.expert_steps += int((horizon - info["final_info"]["handover"][done]).sum())
        return self._seen(observation), reward.astype(np.float32), done, [{} for _ in range(self.num_envs)]

    def _seen(self, observation: Array) -> NDArray[np.float32]:
        return self.scale(observation).reshape(self.num_envs, -1).astype(np.float32)

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for all."""
        return [getattr(self.games, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: nothing to set."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not supported: nothing to call."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Never."""
        return [False] * self.num_envs
