"""Cross-Entropy Method for the switching threshold: Lee, Saigol, Theodorou, arXiv 1803.10231, Algorithm 1.

Each iteration resets, draws thresholds from N(mu, sigma^2), scores every candidate on the same episodes and refits
mu and sigma on the best of them. If fewer than b candidates succeed, mu and sigma of before the iteration are kept
and the iteration is repeated. Thresholds are drawn in log space; the literal linear version is kept beside it.
The scores come from the handover table, so a candidate costs a look-up; `tuning_episodes` counts what it would cost
on a plant: candidates x episodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.protocols import Arming, Array, Calibrated
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule


@dataclass(frozen=True)
class CEMSettings:
    """Free parameters of Algorithm 1. Frozen after the design split.

    Attributes:
        mu: initial median threshold, in the signal's units.
        sigma: initial standard deviation: of the log threshold, or with `linear` as a multiple of `mu`.
        candidates: thresholds drawn per iteration (the paper's n_ro).
        elites: how many of the best refit mu and sigma (b-bar).
        successes: fewer successful candidates than this (b) and the iteration is repeated.
        iterations: accepted iterations.
        repeats: at most this many repetitions in a whole run; afterwards iterations are accepted as they come.
        smoothing: weight of the refit against the value of before (de Boer et al. 2005, section 4).
        floor: smallest standard deviation, same units as `sigma`.
        average: mu* is the mean of mu over this many last iterations.
        linear: draw thresholds themselves and not their logarithms, as the paper does.
    """

    mu: float = 0.1
    sigma: float = 1.0
    candidates: int = 32
    elites: int = 8
    successes: int = 8
    iterations: int = 40
    repeats: int = 40
    smoothing: float = 0.3
    floor: float = 0.1
    average: int = 10
    linear: bool = False


EPISODES = {"onset": 1, "start": 8}
"""Episodes shared by the candidates of an iteration (m): one under `onset`, as in the paper."""

SUCCESS_SHARE = 0.75
"""A candidate counts as successful when at least this share of its m episodes succeed."""


def learn_threshold(panel: Panel, signal: str, settings: CEMSettings, seed: int, phi: float) -> Calibrated:
    """Run Algorithm 1 on the calibrate episodes.

    Args:
        panel: calibrate episodes under an arming.
        signal: id of the signal.
        settings: free parameters.
        seed: of the draws of thresholds and episodes.
        phi: reward of success.

    Returns:
        The learned rule with mu*, and in `log` every sample: `samples`, `sample_success`, `sample_return`
        (iterations, candidates), and `mu`, `sigma` (log units unless `linear`), `reward_sum`, `accepted` per iteration.
    """
    rng = stream(seed, "cem", signal, panel.arming)
    episodes = _EpisodeSampler(panel, rng)
    mu = settings.mu if settings.linear else float(np.log(settings.mu))
    sigma = settings.sigma * (settings.mu if settings.linear else 1.0)
    floor = settings.floor * (settings.mu if settings.linear else 1.0)
    rows: list[tuple[Array, Array, Array, float, float, bool]] = []
    accepted = repeats = 0
    while accepted < settings.iterations:
        draws = rng.normal(mu, sigma, settings.candidates)
        thresholds = draws if settings.linear else np.exp(draws)
        returns, success = _score(episodes.draw(), signal, thresholds, phi)
        enough = int(np.sum(success >= SUCCESS_SHARE)) >= settings.successes
        if enough or repeats >= settings.repeats:
            elite = draws[np.argsort(-returns, kind="stable")[: settings.elites]]
            mu += settings.smoothing * (float(elite.mean()) - mu)
            sigma = max(sigma + settings.smoothing * (float(elite.std()) - sigma), floor)
            accepted += 1
        else:
            repeats += 1
        rows.append((thresholds, success, returns, mu, sigma, enough))
    log = _as_arrays(rows)
    last = log["mu"][-settings.average :].mean()
    threshold = float(last if settings.linear else np.exp(last))
    return Calibrated(
        ThresholdRule(signal, threshold), threshold, len(rows) * settings.candidates * EPISODES[panel.arming], log=log
    )


class _EpisodeSampler:
    """Draws the episodes of an iteration without replacement until all were used; under `start` half are disturbed."""

    def __init__(self, panel: Panel, rng: np.random.Generator):
        self.panel, self.rng = panel, rng
        disturbed = panel.table.disturbed
        groups = [np.flatnonzero(disturbed), np.flatnonzero(~disturbed)]
        self.groups = [group for group in groups if group.size]
        self.queues = [np.empty(0, np.int64) for _ in self.groups]

    def draw(self) -> Panel:
        share = EPISODES[self.panel.arming] // len(self.groups)
        return self.panel.take(np.concatenate([self._next(group, share) for group in range(len(self.groups))]))

    def _next(self, group: int, count: int) -> np.ndarray:
        while self.queues[group].size < count:
            fresh = self.rng.permutation(self.groups[group])
            self.queues[group] = np.concatenate([self.queues[group], fresh])
        chosen, self.queues[group] = np.split(self.queues[group], [count])
        return chosen


def _score(panel: Panel, signal: str, thresholds: Array, phi: float) -> tuple[Array, Array]:
    handover = panel.handover_at(signal, thresholds)
    return panel.returns(handover, phi).mean(axis=1), panel.success(handover).mean(axis=1)


def _as_arrays(rows: list[tuple[Array, Array, Array, float, float, bool]]) -> dict[str, np.ndarray]:
    samples, success, returns, mu, sigma, accepted = zip(*rows, strict=True)
    returned = np.stack(returns)
    return {
        "samples": np.stack(samples),
        "sample_success": np.stack(success),
        "sample_return": returned,
        "mu": np.array(mu),
        "sigma": np.array(sigma),
        "reward_sum": returned.sum(axis=1),
        "accepted": np.array(accepted, bool),
    }


class CEM(SignalMethod):
    """`cem@signal`: the learned threshold."""

    family = "cem"
    needs = frozenset({"failures", "rollouts"})

    def settings(self, arming: Arming) -> CEMSettings:
        """Free parameters under an arming."""
        if arming == "start":
            return CEMSettings(iterations=20, smoothing=0.7, average=5)
        return CEMSettings()

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Algorithm 1 on the calibrate episodes."""
        panel = calibration.panel
        return learn_threshold(panel, self.signal, self.settings(panel.arming), calibration.seed, calibration.phi)


class CEMHigh(CEM):
    """`cem-high@signal`: the initial median ten times too high; it should learn the same threshold."""

    family = "cem-high"

    def settings(self, arming: Arming) -> CEMSettings:
        """Ten times the initial median."""
        settings = super().settings(arming)
        return replace(settings, mu=10 * settings.mu)


class CEMLow(CEM):
    """`cem-low@signal`: the initial median ten times too low; it should learn the same threshold."""

    family = "cem-low"

    def settings(self, arming: Arming) -> CEMSettings:
        """A tenth of the initial median."""
        settings = super().settings(arming)
        return replace(settings, mu=settings.mu / 10)


class CEMLiteral(CEM):
    """`cem-literal@signal`: thresholds drawn from a normal distribution as such, no smoothing, mu* the last mu."""

    family = "cem-literal"

    def settings(self, arming: Arming) -> CEMSettings:
        """The paper's algorithm, linear."""
        return CEMSettings(smoothing=1.0, average=1, linear=True)
