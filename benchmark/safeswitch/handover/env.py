"""The switching problem as a Gymnasium environment, served from handover tables: no simulator, no network.

At every step the monitor sees the signals and decides who drives from the next step on, LEARNER (0) or EXPERT (1). The
expert is final: after EXPERT the episode is over at once, and its outcome is the table's o(s).

    observation   (history, S), the S signals of the last armed steps, the newest last, in the signals' own units,
                  clipped to +-LIMIT; before there are as many armed steps the oldest is repeated
    reward        1/T for each learner-driven step from the arming step on, and at the end phi on success
    return        exactly that of the same rule on the table (`Panel.returns`)

As in the paper an alarm at step t hands over from t + 1: the first observation is that of the arming step, which the
learner drives. Episodes that end before they are armed ask for no decision and are not drawn. A policy may use the
observation and nothing else: `info` tells what no monitor knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from safeswitch.handover.panel import PHI, Panel
from safeswitch.handover.table import Ints
from safeswitch.protocols import Array, Driver

LIMIT = 1e6
"""Observations are finite: larger signals are cut. The largest of the committed tables is about 3,000."""

HISTORY = 4
"""Steps of every signal in an observation."""


class Decisions:
    """Armed episodes of a panel as arrays: what both environments are served from.

    Args:
        panel: episodes under an arming.
        signals: ids of the signals that are observed, in this order.
        history: steps of each in an observation.
        phi: reward of success.
    """

    def __init__(self, panel: Panel, signals: Sequence[str], history: int = HISTORY, phi: float = PHI) -> None:
        if history < 1:
            raise ValueError(f"history must be at least 1 step, got {history}")
        if not signals:
            raise ValueError("an observation needs at least one signal")
        self.panel, self.signals, self.history, self.phi = panel, tuple(signals), history, float(phi)
        stacked = np.stack([panel.signal(name) for name in self.signals], axis=-1)
        traces: Array = np.clip(stacked, -LIMIT, LIMIT)  # (E, T, S)
        self.horizon = panel.table.horizon
        self.length: Ints = panel.table.length
        self.armed: Ints = panel.arming_step
        self.playable = np.flatnonzero(self.armed < self.length)
        if not self.playable.size:
            raise ValueError("none of the episodes lasts until its arming step: there is nothing to decide")
        shape = (history, len(self.signals))
        back = np.arange(self.horizon)[:, None] + np.arange(1 - history, 1)  # (T, history)
        steps = np.clip(back, np.minimum(self.armed, self.horizon - 1)[:, None, None], None)
        self._windows: Array = traces[np.arange(len(panel))[:, None, None], np.minimum(steps, self.horizon - 1)]
        self.observation_space = spaces.Box(-LIMIT, LIMIT, shape, np.float64)
        self.action_space = spaces.Discrete(2)

    def observe(self, episode: Any, step: Any) -> Array:
        """Observations (..., history, S) of `episode` (...,) at `step` (...,)."""
        return self._windows[episode, step].copy()

    def outcome(self, episode: Ints, handover: Ints) -> NDArray[np.bool_]:
        """o(handover) (n,); a handover at or after the episode's end does not take place."""
        return self.panel.table.outcome(episode, handover)

    def facts(self, episode: Any, step: Any) -> dict[str, Any]:
        """What `info` says of each episode at its step."""
        table = self.panel.table
        return {
            "episode": episode,
            "episode_seed": table.seeds[episode],
            "step": step,
            "onset": table.onset[episode],
            "disturbed": table.disturbed[episode],
        }


class HandoverEnv(gym.Env[Array, np.int64]):
    """One episode at a time; `reset(options={"episode": i})` starts the i-th episode instead of a drawn one.

    `info` says which episode it is at reset and at the end, and there `handover` (T: never) and `is_success`.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, decisions: Decisions) -> None:
        self.decisions = decisions
        self.observation_space, self.action_space = decisions.observation_space, decisions.action_space  # type: ignore
        self._episode, self._step, self._length, self._done = -1, 0, 0, True
        self._per_step = 1.0 / decisions.horizon

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Draw an episode; the first observation is that of its arming step."""
        super().reset(seed=seed)
        game = self.decisions
        wanted = (options or {}).get("episode")
        if wanted is None:
            self._episode = int(game.playable[self.np_random.integers(len(game.playable))])
        elif wanted in game.playable:
            self._episode = int(wanted)
        else:
            raise ValueError(f"episode {wanted!r} is none of the {len(game.playable)} that are armed: 0 .. "
                             f"{len(game.panel) - 1}, those left out that end before their arming step")  # fmt: skip
        self._step, self._length = int(game.armed[self._episode]), int(game.length[self._episode])
        self._done = False
        return game.observe(self._episode, self._step), self._info()

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """The reward of the step just observed, and the driver of the next one."""
        if self._done:
            raise RuntimeError("the episode is over: call reset()")
        if action not in (0, 1):
            raise ValueError(f"action must be 0 (learner) or 1 (expert), got {action!r}")
        game, reward, following = self.decisions, self._per_step, self._step + 1
        ended = following >= self._length
        self._done = ended or action == 1
        if not self._done:
            self._step = following
            return game.observe(self._episode, following), reward, False, False, {"step": following}
        success = bool(game.outcome(np.array([self._episode]), np.array([following]))[0])
        info = self._info() | {"handover": game.horizon if ended else following, "is_success": success}
        return game.observe(self._episode, self._step), reward + game.phi * success, True, False, info

    def _info(self) -> dict[str, Any]:
        facts = self.decisions.facts(self._episode, self._step)
        return {name: value.item() if isinstance(value, np.generic) else value for name, value in facts.items()}


class HandoverVectorEnv(VectorEnv[Array, Any, Any]):
    """n independent episodes at a time in a few NumPy operations; a finished one is replaced in the same step.

    The last observation and facts of a finished episode are in `info["final_obs"]` and `info["final_info"]`, where
    `info["_final_info"]` is true.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, decisions: Decisions, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.decisions, self.num_envs = decisions, num_envs
        self.single_observation_space = decisions.observation_space
        self.single_action_space = decisions.action_space
        self.observation_space = batch_space(decisions.observation_space, num_envs)
        self.action_space = batch_space(decisions.action_space, num_envs)
        self._episode = np.zeros(num_envs, np.int64)
        self._step = np.zeros(num_envs, np.int64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:  # type: ignore[override]
        """Draw n episodes."""
        super().reset(seed=seed)
        self._draw(np.ones(self.num_envs, bool))
        return self.decisions.observe(self._episode, self._step), self.decisions.facts(self._episode, self._step)

    def step(self, actions: Any) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """As `HandoverEnv.step`, for each episode."""
        game, actions = self.decisions, np.asarray(actions)
        following, length = self._step + 1, game.length[self._episode]
        done = (actions == Driver.EXPERT) | (following >= length)
        reward = np.full(self.num_envs, 1.0 / game.horizon)
        info: dict[str, Any] = {}
        if done.any():
            over, at = self._episode[done], following[done]
            success = np.zeros(self.num_envs, bool)
            success[done] = game.outcome(over, at)
            reward += game.phi * success
            handover = np.where(following >= length, game.horizon, following)
            final = game.facts(self._episode, self._step) | {"handover": handover, "is_success": success}
            info |= {"final_obs": game.observe(self._episode, self._step), "_final_obs": done.copy()}
            info |= {"final_info": final, "_final_info": done.copy()}
        self._step = following
        self._draw(done)
        info |= game.facts(self._episode, self._step)
        never = np.zeros(self.num_envs, bool)
        return game.observe(self._episode, self._step), reward, done, never, info

    def _draw(self, fresh: NDArray[np.bool_]) -> None:
        """New episodes, at their arming steps, where `fresh`."""
        game, count = self.decisions, int(fresh.sum())
        self._episode = self._episode.copy()
        self._episode[fresh] = game.playable[self.np_random.integers(len(game.playable), size=count)]
        self._step = np.where(fresh, game.armed[self._episode], self._step)
