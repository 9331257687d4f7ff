"""One film, and the first gate: what the command line offers besides the whole benchmark and `evaluation`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from joblib import Parallel, delayed

from safeswitch import registry, scoring_stages, stages, suite
from safeswitch.console import Progress
from safeswitch.execution import processes
from safeswitch.handover.episode import Episode, NeverSwitch, continue_with_expert, run_episode
from safeswitch.names import unknown
from safeswitch.protocols import ARMINGS, Arming
from safeswitch.scoring.stats import wilson
from safeswitch.scoring.video import replay, replay_frames, write_side_by_side

if TYPE_CHECKING:
    from safeswitch.pipeline import Run
    from safeswitch.suite import Cell, Task

GATE = 0.995
"""Share of undisturbed handovers that must succeed before any result of a task means anything."""


def find_cell(task: Task, disturbance: str | None, severity: int) -> Cell:
    """The task's cell, by default its paper's; an unknown one lists the valid ones, nearest first."""
    return task.find(disturbance, severity, task.cells)


def checked_arming(protocol: str) -> Arming:
    """The arming `protocol`; an unknown one lists the valid ones."""
    for arming in ARMINGS:
        if arming == protocol:
            return arming
    raise unknown("protocol", protocol, ARMINGS)


def play(
    run: Run, driver: str, disturbance: str | None, severity: int, protocol: str, seed: int, path: Path
) -> Episode:
    """Drive one episode and write its film.

    Args:
        run: task and profile whose first learner drives.
        driver: learner, expert or a method id.
        disturbance: of the cell, or none; None for the paper's.
        severity: 1 to 5.
        protocol: onset or start.
        seed: episode seed.
        path: .mp4 or .gif file to write.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"--out {path}: the file must end in .mp4 or .gif")
    arming = checked_arming(protocol)
    cell = find_cell(run.task, disturbance, severity)
    rule: Any = NeverSwitch()
    queries = False
    if driver != "learner":
        on = run.task.calibrated_on(cell) if driver != "expert" else run.task.paper_cell
        loaded = run.tables_of(0, on).load(run.store, run.task, on)
        calibration = scoring_stages.calibration_of(loaded, run.task, on, arming, 0)
        rule = registry.make_method(driver).calibrate(calibration).rule
        if not hasattr(rule, "update"):
            raise ValueError(f"{driver} needs hindsight, or is out of reach here, and cannot drive an episode")
        queries = "expert-queries" in registry.make_method(driver).needs
    env = stages.make_env(run.task, cell, render_mode="rgb_array")
    learner, signals = run.trained[0].learner(run.task), run.trained[0].signals(run.task)
    adviser = env.make_expert() if queries else None
    expert = env.make_expert()
    episode = run_episode(env, learner, signals, rule, expert, seed, arming, record_snapshots=True, adviser=adviser)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_side_by_side([replay_frames(episode, replay(env, episode), driver)], path, round(1 / env.control_dt))
    env.close()
    return episode


def gate(run: Run, episodes: int = 200, every: int = 5, split: suite.Split = "design") -> list[dict[str, Any]]:
    """The first gate of a task: does the expert take over an undisturbed episode at any step, and does it drive alone?

    Args:
        run: task and profile.
        episodes: episode seeds per check.
        every: steps between the handovers that are tried.
        split: episode seeds are the first ones of this split.

    Returns:
        One row per check: how many trials, how many succeeded, share and Wilson interval.
    """
    seeds = suite.episode_seeds(split, episodes)
    learner = str(run.store.folder(run.learners[0].key))
    chunks = [seeds[start : start + 10] for start in range(0, len(seeds), 10)]
    task, none, paper = run.task, run.task.none_cell, run.task.paper_cell
    checks = {
        f"handover at every {every}th step, {none}": [
            delayed(_handed_over)(task, none, learner, chunk, every) for chunk in chunks
        ],
        f"expert alone, {none}": [delayed(_expert_alone)(task, none, chunk) for chunk in chunks],
        f"expert alone, {paper}": [delayed(_expert_alone)(task, paper, chunk) for chunk in chunks],
    }
    pending = [(check, job) for check, jobs in checks.items() for job in jobs]
    outcomes: dict[str, list[bool]] = {check: [] for check in checks}
    with Progress(f"{task.name} gate", len(pending)) as progress, processes(run.workers):
        done = Parallel(return_as="generator")(job for _, job in pending)
        for (check, _), found in zip(pending, done, strict=True):
            outcomes[check] += found
            progress.advance()
    return [_gate_row(check, found) for check, found in outcomes.items()]


def _expert_alone(task: Task, cell: Cell, seeds: list[int]) -> list[bool]:
    env = stages.make_env(task, cell)
    expert = env.make_expert()
    outcomes = []
    for seed in seeds:
        env.reset(seed=seed)
        outcomes.append(continue_with_expert(env, expert))
    return outcomes


def _handed_over(task: Task, cell: Cell, learner: str, seeds: list[int], every: int) -> list[bool]:
    env = stages.make_env(task, cell)
    table = stages.record_table(env, stages.load_learner(task, learner), [], env.make_expert(), seeds)
    steps = np.arange(0, table.horizon, every)
    open_ = steps[None, :] < table.length[:, None]
    episode, step = np.nonzero(open_)
    return table.outcome(episode, steps[step]).tolist()


def _gate_row(name: str, outcomes: list[bool]) -> dict[str, Any]:
    low, high = wilson(sum(outcomes), len(outcomes))
    return {
        "check": name,
        "trials": len(outcomes),
        "successes": sum(outcomes),
        "success": sum(outcomes) / len(outcomes),
        "lo": float(low),
        "hi": float(high),
    }
