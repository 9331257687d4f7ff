"""A profile that runs every stage of the benchmark in well under a minute, and one run of it for all tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from safeswitch import suite
from safeswitch.pipeline import Run
from safeswitch.store import Store
from safeswitch.suite import Profile

MICRO = Profile(
    "micro",
    learners=1,
    cells=2,
    calibrate=2,
    test=2,
    demonstrations={"episodes": 4},
    learner_options={"hidden": (16, 16), "epochs": 3},
)
TASK = replace(suite.task("cart-pole"), signals=("epistemic", "aleatoric", "total", "total-mean3"))
"""With signals that are fitted to nothing."""


def micro_run(root: Path, workers: int = 1, store: type[Store] = Store) -> Run:
    """The cart-pole under the micro profile; nothing is computed until a stage is asked for."""
    return Run(TASK, MICRO, store(root), workers)


def leaderboard_bytes(run: Run) -> bytes:
    """The table that the run's scores stage wrote, computing whatever is missing."""
    return (run.store.folder(run.scores.key) / "leaderboard.csv").read_bytes()
