"""Signals: one number per step that should rise when the learner should not drive.

`uncertainty` holds those in action units (the paper's among them), `features`, `dynamics` and `discrepancy` those that
are fitted to the trunk features of a learner's training steps, and `smoothing` makes any of them by its id.
"""

from safeswitch_baselines.signals.discrepancy import Discrepancy
from safeswitch_baselines.signals.dynamics import DynamicsResidual
from safeswitch_baselines.signals.features import KNN, RND, Mahalanobis
from safeswitch_baselines.signals.smoothing import REDUCTIONS, SIGNALS, Smoothed, make_signal, split_id
from safeswitch_baselines.signals.uncertainty import Aleatoric, Ensemble, Epistemic, Total

__all__ = [
    "KNN",
    "REDUCTIONS",
    "RND",
    "SIGNALS",
    "Aleatoric",
    "Discrepancy",
    "DynamicsResidual",
    "Ensemble",
    "Epistemic",
    "Mahalanobis",
    "Smoothed",
    "Total",
    "make_signal",
    "split_id",
]
