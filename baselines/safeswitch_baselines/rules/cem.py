"""Cross-Entropy Method for the switching threshold: Lee, Saigol, Theodorou, arXiv 1803.10231, Algorithm 1.

Each iteration resets, draws thresholds from N(mu, sigma^2), scores every candidate on the same episodes and refits
mu and sigma on the best of them. If fewer than b candidates succeed, mu and sigma of before the iteration are kept
and the iteration is repeated. Thresholds are drawn in log space; the literal linear version is kept beside it.
Two settings differ from the paper, both chosen on the design split. Candidates share eight episodes and not one, and
half of them are elites under a wide distribution: CEM then settles in the middle of the thresholds that work instead
of at the edge where the next unseen episode fails. `cem-single@` and `cem-literal@` keep the paper's choices.
The scores come from the handover table, so a candidate costs a look-up; `tuning_episodes` counts what it would cost
on a plant: candidates x episodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.protocols import Arming, Array, Calibrated
from safeswitch.seeding import stream
from safeswitch_baselines.rules.base import SignalMethod, ThresholdRule, expert_steps


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
        episodes: shared by the candidates of an iteration (m); the paper has one. One episode ranks candidates but
            does not weigh a failure against a little more autonomy, and CEM then learns the median of the episodes'
            last good thresholds; `cem-single@` shows it.
    """

    mu: float = 0.1
    sigma: float = 1.5
    candidates: int = 32
    elites: int = 16
    successes: int = 2
    iterations: int = 40
    repeats: int = 40
    smoothing: float = 0.3
    floor: float = 0.75
    average: int = 15
    linear: bool = False
    episodes: int = 8


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
    episodes = EpisodeSampler(panel, settings.episodes, rng)
    mu = settings.mu if settings.linear else float(np.log(settings.mu))
    sigma = settings.sigma * (settings.mu if settings.linear else 1.0)
    floor = settings.floor * (settings.mu if settings.linear else 1.0)
    rows: list[tuple[Array, Array, Array, float, float, bool]] = []
    accepted = repeats = queries = 0
    while accepted < settings.iterations:
        draws = rng.normal(mu, sigma, settings.candidates)
        thresholds = draws if settings.linear else np.exp(draws)
        sample = episodes.draw()
        handover = sample.handover_at(signal, thresholds)
        returns, success = sample.returns(handover, phi).mean(axis=1), sample.success(handover).mean(axis=1)
        queries += expert_steps(sample, handover)
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
    cost = len(rows) * settings.candidates * settings.episodes
    return Calibrated(ThresholdRule(signal, threshold), threshold, cost, queries, log)


class EpisodeSampler:
    """Draws the episodes of an iteration without replacement until all were used; under `start` half are disturbed."""

    def __init__(self, panel: Panel, count: int, rng: np.random.Generator):
        self.panel, self.rng = panel, rng
        disturbed = panel.table.disturbed
        groups = [np.flatnonzero(disturbed), np.flatnonzero(~disturbed)]
        self.groups = [group for group in groups if group.size]
        self.queues = [np.empty(0, np.int64) for _ in self.groups]
        self.share = max(count // len(self.groups), 1)

    def draw(self) -> Panel:
        """The episodes of the next iteration."""
        return self.panel.take(np.concatenate([self._next(group, self.share) for group in range(len(self.groups))]))

    def _next(self, group: int, count: int) -> np.ndarray:
        while self.queues[group].size < count:
            fresh = self.rng.permutation(self.groups[group])
            self.queues[group] = np.concatenate([self.queues[group], fresh])
        chosen, self.queues[group] = np.split(self.queues[group], [count])
        return chosen


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
    """`cem@signal`: the learned threshold.

    Args:
        signal: id of the signal.
        changes: fields of `CEMSettings` that are not to be as in `settings`, to see what they matter.
    """

    family = "cem"
    needs = frozenset({"failures", "rollouts"})

    def __init__(self, signal: str | None, **changes: Any):
        super().__init__(signal)
        self.changes = changes

    def settings(self, arming: Arming) -> CEMSettings:
        """Free parameters under an arming: under `start`, half of the episodes of an iteration are undisturbed."""
        return CEMSettings(episodes=8 if arming == "onset" else 16)

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Algorithm 1 on the calibrate episodes."""
        panel = calibration.panel
        settings = replace(self.settings(panel.arming), **self.changes)
        return learn_threshold(panel, self.signal, settings, calibration.seed, calibration.phi)


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


class CEMSingle(CEM):
    """`cem-single@signal`: one episode an iteration under `onset`, as in the paper, and otherwise as `cem@`."""

    family = "cem-single"

    def settings(self, arming: Arming) -> CEMSettings:
        """One episode an iteration."""
        return replace(super().settings(arming), episodes=1 if arming == "onset" else 16)


class CEMLiteral(CEM):
    """`cem-literal@signal`: the paper's algorithm as printed: linear, one episode under `onset`, no smoothing.

    A quarter of the candidates are elites, the standard deviation may fall to a tenth of the initial threshold, and
    mu* is the last mu.
    """

    family = "cem-literal"

    def settings(self, arming: Arming) -> CEMSettings:
        """The paper's algorithm."""
        return CEMSettings(
            sigma=1.0,
            elites=8,
            successes=8,
            smoothing=1.0,
            floor=0.1,
            average=1,
            linear=True,
            episodes=1 if arming == "onset" else 16,
        )
