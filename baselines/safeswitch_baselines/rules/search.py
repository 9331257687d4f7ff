"""Searches with exactly CEM's budget of episodes: a logarithmic grid, and random search (Bergstra & Bengio 2012)."""

from __future__ import annotations

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.protocols import Array, Calibrated
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule, expert_steps
from safeswitch_baselines.rules.cem import CEM

CANDIDATES = 32
"""Thresholds that share the budget; each is scored on the same budget / CANDIDATES episodes."""

SPREAD = 2.5
"""The grid spans CEM's initial median times exp(+-SPREAD sigma)."""


class Search(SignalMethod):
    """Scores candidate thresholds on common episodes at CEM's budget and keeps the best mean return."""

    needs = frozenset({"failures", "rollouts"})

    def candidates(self, mu: float, sigma: float, rng: np.random.Generator) -> Array:
        """(CANDIDATES,) thresholds, given the log-normal distribution that CEM starts from."""
        raise NotImplementedError

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Best of the candidates; ties go to the middle of the best run of the sorted candidates."""
        panel, cem = calibration.panel, CEM(self.signal)
        budget = cem.calibrate(calibration).tuning_episodes
        settings = cem.settings(panel.arming)
        rng = stream(calibration.seed, self.family, self.signal, panel.arming)
        thresholds = np.sort(self.candidates(settings.mu, settings.sigma, rng))
        sample = _common_episodes(panel, budget // len(thresholds), rng)
        handover = sample.handover_at(self.signal, thresholds)
        returns = sample.returns(handover, calibration.phi).mean(axis=1)
        best = np.flatnonzero(returns == returns.max())
        threshold = float(thresholds[best[len(best) // 2]])
        log = {"samples": thresholds, "sample_return": returns}
        rule = ThresholdRule(self.signal, threshold)
        return Calibrated(rule, threshold, budget, expert_steps(sample, handover), log)


class GridSearch(Search):
    """`grid@signal`: equally spaced logarithms."""

    family = "grid"

    def candidates(self, mu: float, sigma: float, rng: np.random.Generator) -> Array:
        """Equally spaced in log space."""
        return mu * np.exp(np.linspace(-SPREAD * sigma, SPREAD * sigma, CANDIDATES))


class RandomSearch(Search):
    """`random-search@signal`: draws from the distribution that CEM starts from."""

    family = "random-search"

    def candidates(self, mu: float, sigma: float, rng: np.random.Generator) -> Array:
        """Log-normal draws."""
        return mu * np.exp(rng.normal(0.0, sigma, CANDIDATES))


def _common_episodes(panel: Panel, count: int, rng: np.random.Generator) -> Panel:
    """`count` episodes, each used equally often: whole passes first, then a draw without replacement.

    Under `start` the draw keeps disturbed and undisturbed episodes in balance.
    """
    whole, rest = divmod(count, len(panel))
    index = [np.arange(len(panel))] * whole
    groups = [np.flatnonzero(mask) for mask in (panel.table.disturbed, ~panel.table.disturbed) if mask.any()]
    index += [rng.permutation(group)[: rest // len(groups)] for group in groups]
    return panel.take(np.concatenate(index))
