"""How well a signal tells disturbed from undisturbed frames and episodes: AUROC and FPR@95TPR (docs/scores.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

from safeswitch.protocols import Array

SIGNAL_KEY = ["task", "disturbance", "severity", "signal"]
SIGNAL_SCORES = ["frame_auroc", "episode_auroc", "fpr95"]


@dataclass(frozen=True)
class SignalQuality:
    """Quality of one signal for one learner in one cell; NaN where there is nothing to compare.

    Attributes:
        frame_auroc: chance that a frame with the disturbance scores higher than one without, ties counting half.
        episode_auroc: the same for the maximum over the window [t0, `t*_first`] of an episode.
        fpr95: share of undisturbed frames that alarm at the threshold catching 95 % of the disturbed ones.
    """

    frame_auroc: float
    episode_auroc: float
    fpr95: float


def auroc(positive: ArrayLike, negative: ArrayLike) -> float:
    """Area under the ROC curve: P(positive > negative) + P(positive = negative) / 2; NaN if a side is empty."""
    up, down = _scores("positive", positive), _scores("negative", negative)
    if not len(up) or not len(down):
        return float("nan")
    ranks = rankdata(np.concatenate([up, down]))  # ties share the mean of their ranks (Mann-Whitney U)
    return float((ranks[: len(up)].sum() - len(up) * (len(up) + 1) / 2) / (len(up) * len(down)))


def fpr_at_tpr(positive: ArrayLike, negative: ArrayLike, tpr: float = 0.95) -> float:
    """False-positive rate of `score >= threshold` at the highest threshold with a true-positive rate >= `tpr`."""
    if not 0 < tpr <= 1:
        raise ValueError(f"tpr must lie in (0, 1], got {tpr}")
    up, down = np.sort(_scores("positive", positive)), _scores("negative", negative)
    if not len(up) or not len(down):
        return float("nan")
    needed = max(math.ceil(tpr * len(up) - 1e-9), 1)  # 0.95 * n may come out a hair above a whole number
    return float(np.mean(down >= up[len(up) - needed]))


def signal_quality(
    disturbed: Array,
    twin: Array,
    onset: NDArray[np.integer],
    t_first: Array,
    learner_success: NDArray[np.bool_],
) -> SignalQuality:
    """Quality of a signal from disturbed episodes and their undisturbed twins.

    Args:
        disturbed: (E, T) signal on the learner-only disturbed trajectories, NaN after an early end.
        twin: (E, T) signal on the undisturbed twins.
        onset: (E,) step t0.
        t_first: (E,) `t*_first`, NaN where there is none.
        learner_success: (E,) whether the learner alone succeeds in the disturbed episode.

    Steps at which either trajectory has already ended are left out on both sides.
    """
    disturbed, twin = _traces(disturbed, twin)
    onset = np.asarray(onset)
    if np.any(onset < 0):
        raise ValueError("signal quality is defined on disturbed episodes: every onset must be >= 0")
    steps = np.arange(disturbed.shape[1])
    both = ~np.isnan(disturbed) & ~np.isnan(twin)
    after = steps[None, :] >= onset[:, None]
    frames = both & after
    judged = ~np.asarray(learner_success, bool) & np.isfinite(t_first)
    last = np.where(judged, t_first, -1.0)
    window = frames & (steps[None, :] <= last[:, None])
    episodes = window.any(axis=1)
    peak = [np.where(window, trace, -np.inf).max(axis=1)[episodes] for trace in (disturbed, twin)]
    positive, negative = disturbed[frames], twin[frames]
    return SignalQuality(auroc(positive, negative), auroc(*peak), fpr_at_tpr(positive, negative))


def frame_quality(shown: Array, clean: Array, visible: NDArray[np.bool_]) -> SignalQuality:
    """Quality of a signal on the same states with and without the disturbance in view; no episodes are judged.

    Args:
        shown: (E, T) signal with the disturbance in view, NaN after an early end.
        clean: (E, T) signal without it.
        visible: (E, T) where the disturbance shows.
    """
    shown, clean = _traces(shown, clean)
    frames = ~np.isnan(shown) & ~np.isnan(clean) & np.asarray(visible, bool)
    return SignalQuality(auroc(shown[frames], clean[frames]), np.nan, fpr_at_tpr(shown[frames], clean[frames]))


def _traces(disturbed: Array, clean: Array) -> tuple[Array, Array]:
    disturbed, clean = np.asarray(disturbed, float), np.asarray(clean, float)
    if disturbed.shape != clean.shape or disturbed.ndim != 2:
        raise ValueError(f"traces must be two arrays (E, T) of one shape, got {disturbed.shape} and {clean.shape}")
    return disturbed, clean


def signal_table(per_learner: pd.DataFrame) -> pd.DataFrame:
    """One row per (task, disturbance, severity, signal): the median over learner seeds and the spread.

    Args:
        per_learner: columns task, disturbance, severity, signal, learner, frame_auroc, episode_auroc, fpr95.

    Returns:
        The key, the three medians, `learner_seeds`, and the smallest and largest of each score over learners.
    """
    missing = [name for name in [*SIGNAL_KEY, "learner", *SIGNAL_SCORES] if name not in per_learner]
    if missing:
        raise ValueError(f"the signal table needs the columns {missing}; it has {sorted(per_learner.columns)}")
    if per_learner.duplicated([*SIGNAL_KEY, "learner"]).any():
        raise ValueError("the signal table has several rows for one (task, disturbance, severity, signal, learner)")
    groups = per_learner.sort_values([*SIGNAL_KEY, "learner"]).groupby(SIGNAL_KEY, sort=True)
    table = groups[SIGNAL_SCORES].median()
    table["learner_seeds"] = groups["learner"].nunique()
    for score in SIGNAL_SCORES:
        table[f"{score}_min"] = groups[score].min()
        table[f"{score}_max"] = groups[score].max()
    return table.reset_index()


def _scores(side: str, values: ArrayLike) -> Array:
    scores = np.asarray(values, float).ravel()
    if np.isnan(scores).any():
        raise ValueError(f"{int(np.isnan(scores).sum())} of {len(scores)} {side} scores are NaN; leave them out first")
    return scores
