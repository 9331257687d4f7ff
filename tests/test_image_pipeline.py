"""The image task through the whole pipeline: fitted signals, ensemble, a costly task's cells, the paper's learner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from micro import MICRO
from safeswitch import stages, suite
from safeswitch.handover.episode import NeverSwitch, run_episode
from safeswitch.pipeline import Run
from safeswitch.publish import publish
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.rendering]

PROFILE = replace(
    MICRO,
    learners=2,
    cells=3,
    learner_options={"epochs": 2, "hidden": (16, 8)},
    signal_severities=(1,),
    signal_episodes=2,
    literal_learners=1,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The image task under a profile of a minute."""
    return Run(suite.task("cart-pole-image"), PROFILE, Store(tmp_path_factory.mktemp("image")), workers=2)


def test_recorded_signals_are_those_of_plain_episodes(run: Run) -> None:
    cell = run.task.paper_cell
    assert {"ensemble", "mahalanobis", "rnd"} < set(run.task.signals)
    for trained in run.trained:
        table = run.tables_of(trained.seed, cell).load(run.store, run.task, cell)["test"]
        env = stages.make_env(run.task, cell)
        learner, signals = trained.learner(run.task), trained.signals(run.task)
        for row, seed in enumerate(table.seeds):
            episode = run_episode(env, learner, signals, NeverSwitch(), None, int(seed))
            for name, trace in episode.signals.items():
                np.testing.assert_array_equal(trace, table.signals[name][row], err_msg=name)
        env.close()


def test_everything_is_published(run: Run, tmp_path: Path) -> None:
    folder = publish(run, tmp_path)
    signals = read_csv(folder / "signals.csv")
    cells = set(zip(signals["disturbance"], signals["severity"], strict=True))
    assert cells == {("object", 3), ("object-far", 3)}, "of a costly task at no further severities"
    seen = signals[(signals["disturbance"] == "object-far") & (signals["signal"] == "mahalanobis")]
    assert 0 <= float(seen["frame_auroc"].iloc[0]) <= 1
    literal = read_csv(folder / "paper_literal_leaderboard.csv")
    assert "cem-literal@total" in set(literal["method"]) and set(literal["disturbance"]) == {"object", "none"}
    board = read_csv(folder / "leaderboard.csv")
    assert set(board["disturbance"]) == {"object", "none", "object-far"}
    assert {"cem@ensemble", "cem@mahalanobis", "best@rnd"} < set(board["method"])
    pictures = {path.name for path in (folder / "figures" / "cart-pole-image").iterdir()}
    assert {"episode.png", "episode.mp4", "disturbances.png", "cem-total-onset.png"} < pictures
