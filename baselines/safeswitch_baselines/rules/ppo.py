"""`ppo@signals`: a learned policy against a learned threshold. PPO (Schulman et al. 2017, https://arxiv.org/abs/1707.06347)
from stable-baselines3, the extra `rl`, trained on the calibrate episodes through the handover environment.

The policy sees the last steps of the signals (`ppo@signals`: all that are recorded; `ppo@total`: one), in standardised
logarithms, and its more likely action decides; the handover is final. A fresh policy that hands over in half of the
steps would never see a late handover: the bias of its output is set so that it hands over about once in an episode.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from safeswitch.handover.env import HISTORY, Decisions, HandoverVectorEnv
from safeswitch.handover.panel import Calibration
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import Array, Calibrated, Driver
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import SignalMethod

ALL = "signals"
"""Stands for every recorded signal in the method's id."""
STEPS = 131_072
"""Steps of training."""
SMALLEST, LARGEST = 1e-6, 5.0
"""Signals below the first are cut before the logarithm; standardised logarithms are cut at the second."""


@dataclass(frozen=True)
class Scale:
    """Standardised logarithms of signals: mean and standard deviation (S,) over undisturbed calibrate steps."""

    mean: Array
    std: Array

    @staticmethod
    def fit(nominal: HandoverTable, signals: Sequence[str]) -> Scale:
        """From the undisturbed calibrate episodes."""
        steps = np.stack([nominal.signals[name][~np.isnan(nominal.signals[name])] for name in signals], axis=-1)
        logs = np.log(np.maximum(steps, SMALLEST))
        return Scale(logs.mean(axis=0), np.maximum(logs.std(axis=0), 1e-3))

    def __call__(self, observation: Array) -> Array:
        """(..., S) standardised."""
        logs = np.log(np.maximum(observation, SMALLEST))
        return np.clip((logs - self.mean) / self.std, -LARGEST, LARGEST)


class PolicyRule:
    """Latched: hands over once the policy prefers the expert. The network is a few matrices, in double precision.

    Args:
        signals: what it looks at, in order.
        scale: of the signals.
        layers: weight (out, in) and bias (out,) of each layer; tanh between them, two outputs: learner, expert.
        history: steps of each signal.
    """

    def __init__(
        self, signals: Sequence[str], scale: Scale, layers: Sequence[tuple[Array, Array]], history: int = HISTORY
    ) -> None:
        self.reads, self.scale, self.layers = tuple(signals), scale, list(layers)
        self._seen: deque[Array] = deque(maxlen=history)
        self._driver = Driver.LEARNER

    def reset(self, seed: int) -> None:
        """Give the learner control and forget the signals."""
        self._seen.clear()
        self._driver = Driver.LEARNER

    def arm(self, step: int) -> Driver:
        """Nothing was seen yet: the learner drives."""
        return self._driver

    def update(self, step: int, signals: Mapping[str, float]) -> Driver:
        """The more likely action, LEARNER in a tie; EXPERT for good."""
        if self._driver is Driver.LEARNER:
            self._seen.append(self.scale(np.array([signals[name] for name in self.reads])))
            missing = (self._seen.maxlen or 0) - len(self._seen)
            value = np.concatenate([self._seen[0]] * missing + list(self._seen))
            for weight, bias in self.layers[:-1]:
                value = np.tanh(np.einsum("ij,j->i", weight, value) + bias)
            learner, expert = np.einsum("ij,j->i", self.layers[-1][0], value) + self.layers[-1][1]
            self._driver = Driver.EXPERT if expert > learner else Driver.LEARNER
        return self._driver


class PPORule(SignalMethod):
    """`ppo@signals`: PPO on the calibrate episodes, with a fixed number of steps.

    Left out where no calibrate episode lasts until the rule is armed: there is nothing to learn from.
    """

    family = "ppo"
    needs = frozenset({"failures", "rollouts"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Train a policy; the draws of episodes and of torch come from streams of the calibration's seed."""
        panel = calibration.panel
        if (panel.arming_step >= panel.table.length).all():
            return Calibrated(None)
        names = tuple(panel.table.signals) if self.signal == ALL else (self.signal,)
        games = HandoverVectorEnv(Decisions(panel, names, HISTORY, calibration.phi), num_envs=64)
        scale = Scale.fit(calibration.nominal, names)
        rng = stream(calibration.seed, "ppo", self.signal, panel.arming)
        with _alone():
            layers, episodes, queries = _train(games, scale, [int(seed) for seed in rng.integers(2**31, size=2)])
        return Calibrated(PolicyRule(names, scale, layers), float("nan"), episodes, queries)


def _train(games: HandoverVectorEnv, scale: Scale, seeds: list[int]) -> tuple[list[tuple[Array, Array]], int, int]:
    """Layers of the trained policy, and the episodes and expert-driven steps that it took."""
    try:
        import torch
        from stable_baselines3 import PPO
    except ImportError as error:
        raise ValueError("method 'ppo' needs stable-baselines3: pip install 'safeswitch[rl]'") from error
    from safeswitch_baselines.rules.ppo_env import TrainingEnv

    env = TrainingEnv(games, scale, seeds[0])
    model = PPO(
        "MlpPolicy", env, learning_rate=1e-3, n_steps=64, batch_size=1024, n_epochs=6, gamma=1.0, gae_lambda=0.98,
        ent_coef=0.0, policy_kwargs={"net_arch": [32, 32]}, seed=seeds[1], device="cpu",
    )  # fmt: skip
    policy: Any = model.policy
    with torch.no_grad():
        chance = min(1.5 / games.decisions.horizon, 0.5)
        policy.action_net.bias.copy_(torch.tensor([0.0, np.log(chance / (1 - chance))]))
    model.learn(STEPS)
    linear = [layer for layer in policy.mlp_extractor.policy_net if isinstance(layer, torch.nn.Linear)]
    layers = [
        (layer.weight.detach().numpy().astype(np.float64), layer.bias.detach().numpy().astype(np.float64))
        for layer in (*linear, policy.action_net)
    ]
    return layers, env.episodes, env.expert_steps


@contextmanager
def _alone() -> Iterator[None]:
    """One thread, so that sums are taken in one order; global generators, which the library seeds, stay as before."""
    import torch

    threads, numpy_state, python_state = torch.get_num_threads(), np.random.get_state(), random.getstate()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)
        np.random.set_state(numpy_state)
        random.setstate(python_state)
