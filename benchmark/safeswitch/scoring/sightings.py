"""How far ahead a signal sees what stands in the way, one row per kind of it (docs/scores.md).

The states are those of undisturbed episodes, with the object in view and without it (`safeswitch.handover.shown`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safeswitch.handover.shown import Shown
from safeswitch.protocols import Array
from safeswitch.scoring.signal_quality import auroc

WINDOW = 3
"""Steps over which a signal is averaged before it may raise the alarm."""
LEVEL = 0.99
"""Quantile of undisturbed steps that it has to pass."""
SIGHTING_KEY = ["task", "disturbance", "severity", "kind", "signal"]


def trailing_mean(trace: Array, window: int = WINDOW) -> Array:
    """Mean (E, T) of the last `window` steps up to each one, of fewer at the start of an episode."""
    columns = pd.DataFrame(trace.T).rolling(window, min_periods=1).mean()
    return columns.to_numpy().T


def sightings(shown: Shown, clean: dict[str, Array], signals: Sequence[str]) -> pd.DataFrame:
    """One row per (kind, signal) of one learner in one cell.

    Args:
        shown: E episodes with the object in view.
        clean: signal id -> (E, T) on the same states without it.
        signals: ids of the signals.

    Returns:
        Columns kind, signal, episodes, `frame_auroc` over the frames that are judged, `seen` (share of the episodes in
        which the trailing mean passes the 99 % quantile of undisturbed steps while the object is in view and ahead),
        and `lead`, the median distance at which it does so first [m], NaN if never.
    """
    kinds = np.array(shown.kinds)
    rows = []
    for signal in signals:
        means = trailing_mean(shown.traces[signal])
        limit = float(np.nanquantile(trailing_mean(clean[signal]), LEVEL))
        alarms = (means > limit) & shown.visible & (shown.distance > 0)
        first = np.where(alarms.any(axis=1), alarms.argmax(axis=1), -1)
        at = np.where(first >= 0, shown.distance[np.arange(len(first)), first], np.nan)
        for kind in sorted(set(shown.kinds)):
            chosen = kinds == kind
            frames = shown.judged[chosen]
            rows.append(
                {
                    "kind": kind,
                    "signal": signal,
                    "episodes": int(chosen.sum()),
                    "frame_auroc": auroc(shown.traces[signal][chosen][frames], clean[signal][chosen][frames]),
                    "seen": float(np.mean(first[chosen] >= 0)),
                    "lead": float(np.nanmedian(at[chosen])) if (first[chosen] >= 0).any() else np.nan,
                }
            )
    return pd.DataFrame(rows)


def sighting_table(per_learner: pd.DataFrame) -> pd.DataFrame:
    """One row per `SIGHTING_KEY`: the medians over learner seeds, and how many there are."""
    groups = per_learner.groupby(SIGHTING_KEY, sort=True)
    table = groups[["episodes", "frame_auroc", "seen", "lead"]].median()
    table["learner_seeds"] = groups["learner"].nunique()
    return table.reset_index()
