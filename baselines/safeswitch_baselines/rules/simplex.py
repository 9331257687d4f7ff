"""Explicit Simplex: the untrusted controller drives as long as the trusted one could still recover.

Sha 2001, Using simplicity to control complexity (IEEE Software 18(4)); Seto, Krogh, Sha, Chutinan 1998, The Simplex
architecture for safe online control system upgrades (ACC).
"""

from __future__ import annotations

import numpy as np

from safeswitch.handover.panel import Calibration, Panel
from safeswitch.handover.table import Ints
from safeswitch.protocols import Calibrated
from safeswitch_baselines.rules.base import PlainMethod


class _Recoverable:
    """Table rule: the last step s from which the expert still succeeds, before the first one from which it does not."""

    def handover_steps(self, panel: Panel) -> Ints:
        return np.array([self._last(panel, episode) for episode in range(len(panel))])

    def _last(self, panel: Panel, episode: int) -> int:
        table = panel.table
        start = max(int(panel.arming_step[episode]), int(table.onset[episode]))  # onset is -1 where undisturbed
        for step in range(start, int(table.length[episode])):
            if not table.outcome(np.array([episode]), np.array([step]))[0]:
                return max(step - 1, start)
        return table.horizon


class Simplex(PlainMethod):
    """`simplex`: hands over at the last step at which the expert would still succeed. Privileged.

    Decision: before the learner drives step s, the true model is asked whether the expert would succeed from step s + 1
    (o(s + 1) of the handover table). If not, the expert takes over at s. An episode that is lost already when it is
    first checked is handed over at once. Latched; nothing is calibrated.
    The model that is asked is the current one and knows of no disturbance to come, so that disturbed episodes are
    checked from t0 on; up to there the expert can recover nearly always (the first gate of every task).
    It is no upper bound: a learner that would have succeeded through a state from which the expert fails is stopped.
    """

    family = "simplex"
    needs = frozenset({"privileged"})

    def calibrate(self, calibration: Calibration) -> Calibrated:
        """Nothing to choose."""
        return Calibrated(_Recoverable())
