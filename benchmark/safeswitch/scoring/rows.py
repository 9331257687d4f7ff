"""One row per tested episode: what every score is computed from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from safeswitch.handover.episode import Episode
from safeswitch.handover.panel import Panel
from safeswitch.protocols import Calibrated


def latched_rows(panel: Panel, calibrated: Calibrated) -> pd.DataFrame:
    """Rows of a latched rule, exactly, from the handover table."""
    handover = panel.handover_of(calibrated.rule)
    return _rows(
        panel,
        handover=handover,
        learner_steps=panel.learner_steps(handover),
        armed_learner_steps=panel.armed_learner_steps(handover),
        success=panel.success(handover),
        handovers=(handover < panel.table.horizon).astype(int),
    )


def episode_rows(panel: Panel, episodes: Sequence[Episode]) -> pd.DataFrame:
    """Rows of a rule that was driven as plain episodes, in the order of the panel."""
    if [episode.seed for episode in episodes] != panel.table.seeds.tolist():
        raise ValueError("the episodes are not those of the panel, in its order")
    return _rows(
        panel,
        handover=np.array([episode.handover for episode in episodes]),
        learner_steps=np.array([episode.learner_steps for episode in episodes]),
        armed_learner_steps=np.array([episode.armed_learner_steps for episode in episodes]),
        success=np.array([episode.success for episode in episodes]),
        handovers=np.array([episode.handovers for episode in episodes]),
    )


def _rows(panel: Panel, **columns: NDArray[np.generic]) -> pd.DataFrame:
    table = panel.table
    return pd.DataFrame(
        {
            "seed": table.seeds,
            "disturbed": table.disturbed,
            "onset": table.onset,
            "arming_step": panel.arming_step,
            **columns,
            "learner_success": table.learner_success,
            "t_first": table.t_first,
            "t_last": table.t_last,
        }
    )
