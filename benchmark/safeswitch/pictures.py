"""Figures and film of a task: CEM's learning (the paper's Figure 1), thresholds, signals, an episode, disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from safeswitch import registry, scoring_stages, stages
from safeswitch.files import load_arrays, load_frame, save_json
from safeswitch.handover.episode import Episode, NeverSwitch, run_episode
from safeswitch.handover.panel import PHI, Calibration, Panel
from safeswitch.handover.table import HandoverTable
from safeswitch.protocols import Arming, Expert
from safeswitch.scoring import episode_figures, figures
from safeswitch.scoring.leaderboard import read_csv
from safeswitch.scoring.metrics import OTHERS
from safeswitch.scoring.style import Marks
from safeswitch.scoring.video import HEIGHT, Trace, observations, replay, replay_frames, sees_images, write_side_by_side
from safeswitch.store import Store
from safeswitch.suite import episode_seeds
from safeswitch.tasks.disturbances import DISTURBANCES

if TYPE_CHECKING:
    from safeswitch.stages import CellTables
    from safeswitch.suite import Cell, Task
    from safeswitch.tasks.base import TaskEnv
    from safeswitch.trained import Trained

SIGNAL = "total"
"""The paper's signal, of which the film and the episode's figure are."""

RULE = f"cem@{SIGNAL}"

STORY = "story.json"
"""Beside the films of one episode under several drivers: what the report draws next to them."""

LEARNING_SIGNALS = (SIGNAL, "epistemic")
"""Signals for which CEM's learning is always drawn: the paper's, and the one that is its cause."""

SWEEP_POINTS = 300
"""Thresholds at which the mean return of a constant threshold is drawn."""

SHEET_SEVERITIES = (1, 3, 5)
"""Severities of the paper's disturbance on the sheet of disturbances; the others are shown as they are run."""
SHEET_STEPS = (-1, 0, 8, 16, 24)
"""Steps of the sheet, from the onset on."""


PART = "figures"
"""Folder in which each of the two jobs leaves its files; together they are a task's folder of figures."""


def draw(folder: Path, root: str, task: Task, episodes: str, tables: CellTables, scores: str) -> None:
    """Draw the figures that need no driving learner into `folder`/figures: first learner, paper's cell."""
    store, cell = Store(Path(root)), task.paper_cell
    target, loaded, rows = _begin(folder, store, task, episodes, tables)
    logs = load_arrays(store.folder(episodes) / "logs.npz")
    table = _own(read_csv(store.folder(scores) / "leaderboard.csv"))
    for protocol in scoring_stages.protocols_of(cell):
        calibration = scoring_stages.calibration_of(loaded, task, cell, protocol, seed=0)
        for signal in drawn_signals(task):
            _draw_cem(calibration.panel, rows, logs, protocol, cell, signal, target)
        _draw_sweep(scoring_stages.test_panel(loaded, cell, protocol), rows, protocol, task, target)
        place = (cell.disturbance, cell.severity)
        figures.figure_plane(table, task.name, place, protocol, target / f"plane-{protocol}.png")
    _draw_signals(read_csv(store.folder(scores) / "signals.csv"), task, target)
    _draw_disturbances(task, target)


def film(folder: Path, root: str, task: Task, trained: Trained, episodes: str, tables: CellTables) -> None:
    """Drive an episode of the paper's cell under several drivers; its figure and films go into `folder`/figures."""
    target, loaded, rows = _begin(folder, Store(Path(root)), task, episodes, tables)
    calibration = scoring_stages.calibration_of(loaded, task, task.paper_cell, "onset", seed=0)
    story = _drive_story(task, trained, loaded["test"], calibration, rows)
    _draw_episode(story, rows, target)
    _draw_film(story, target)


def _begin(
    folder: Path, store: Store, task: Task, episodes: str, tables: CellTables
) -> tuple[Path, dict[str, HandoverTable], pd.DataFrame]:
    """Where a job leaves its files, and the paper's cell: its tables by name, and its scored episodes."""
    target = folder / PART
    target.mkdir(parents=True)
    rows = _own(load_frame(store.folder(episodes) / "episodes.npz"))
    return target, tables.load(store, task, task.paper_cell), rows


def _own(rows: pd.DataFrame) -> pd.DataFrame:
    """Without the rows that leave a disturbance out: figures are of one cell and its own calibration."""
    return rows[rows["calibrated_on"] != OTHERS]


def drawn_signals(task: Task) -> tuple[str, ...]:
    """Signals that figures show strongly: the paper's, the epistemic one, and the task's showcase."""
    return tuple(name for name in dict.fromkeys([*LEARNING_SIGNALS, *task.showcase]) if name in task.signals)


def _threshold(rows: pd.DataFrame, protocol: str, method: str = RULE) -> float:
    chosen = rows[(rows["protocol"] == protocol) & (rows["method"] == method)]
    return float(chosen["threshold"].iloc[0])


def _draw_cem(
    panel: Panel, rows: pd.DataFrame, logs: dict[str, Any], protocol: Arming, cell: Cell, signal: str, target: Path
) -> None:
    rule = f"cem@{signal}"
    prefix = f"{protocol}|{rule}|"
    log = {name.removeprefix(prefix): value for name, value in logs.items() if name.startswith(prefix)}
    figures.figure_cem(
        log,
        panel.margins(signal),
        _threshold(rows, protocol, rule),
        target / f"cem-{signal}-{protocol}.png",
        f"{rule} in {cell}, armed at {protocol}",
    )


def _draw_sweep(panel: Panel, rows: pd.DataFrame, protocol: Arming, task: Task, target: Path) -> None:
    strong = drawn_signals(task)
    thresholds = {name: _sweep_thresholds(panel, name) for name in panel.table.signals}
    returns = {name: panel.returns(panel.handover_at(name, grid)).mean(axis=1) for name, grid in thresholds.items()}
    marks = {
        f"{rule}@{signal}": _threshold(rows, protocol, f"{rule}@{signal}")
        for signal in strong
        for rule in ("cem", "grid", "fixed-epmax95")
    }
    never = np.full(len(panel), panel.table.horizon)
    levels = {
        "learner": float(panel.returns(never).mean()),
        "expert": float(panel.returns(panel.executed(panel.arming_step)).mean()),
    }
    figures.figure_threshold_sweep(
        thresholds,
        returns,
        marks,
        target / f"thresholds-{protocol}.png",
        levels,
        f"{task.paper_cell}, armed at {protocol}",
        strong,
    )


def _sweep_thresholds(panel: Panel, signal: str) -> NDArray[np.float64]:
    """(n,) increasing thresholds over all values at which a rule on this signal could alarm."""
    values = panel.candidate_thresholds(signal)[1:]
    low, high = float(values[0]), float(values[-1])
    if low > 0:
        return np.geomspace(low, 1.15 * high, SWEEP_POINTS)
    return np.linspace(low, high + max(0.05 * (high - low), 1e-9), SWEEP_POINTS)


def _draw_signals(table: pd.DataFrame, task: Task, target: Path) -> None:
    """Frame AUROC of every signal under every disturbance, at the severity of the paper's cell."""
    severity = task.paper_cell.severity
    titles = {
        cell.disturbance: cell.disturbance + {"paper": " (the paper's)", "benign": " (benign)"}.get(cell.tag, "")
        for cell in task.cells
        if cell.tag != "none" and cell.severity == severity
    }
    path = target / "signals.png"
    figures.figure_signals(table, task.name, titles, path, severity, drawn_signals(task))


@dataclass(frozen=True)
class Story:
    """One test episode under several drivers.

    Attributes:
        task: of the episode; the cell is the paper's.
        runs: driver -> its episode, recorded with snapshots: the learner alone, a fixed threshold, CEM, the expert.
        thresholds: driver -> threshold on `SIGNAL`, for those that have one.
        t_first: `t*_first` [steps].
        t_last: `t*_last` [steps].
    """

    task: Task
    runs: dict[str, Episode]
    thresholds: dict[str, float]
    t_first: float
    t_last: float

    @property
    def title(self) -> str:
        """Cell and seed."""
        return f"{self.task.paper_cell}, seed {self.runs[RULE].seed}"

    def marks(self, driver: str) -> Marks:
        """What happens when under a driver; `t*_first` is of the learner's trajectory, which the expert's is not."""
        episode = self.runs[driver]
        return Marks(episode.onset, episode.handover, None if driver == "expert" else self.t_first)


def _drive_story(
    task: Task, trained: Trained, table: HandoverTable, calibration: Calibration, rows: pd.DataFrame
) -> Story:
    """The first test episode that the learner fails and the rule saves, under each driver."""
    chosen = rows[(rows["protocol"] == "onset") & (rows["method"] == RULE)]
    saved = chosen[chosen["success"] & ~chosen["learner_success"]]
    seed = int((saved if len(saved) else chosen).iloc[0]["seed"])
    index = int(np.flatnonzero(table.seeds == seed)[0])
    fixed = _typical_fixed(rows[rows["protocol"] == "onset"], table.horizon)
    drivers: dict[str, tuple[Any, Arming]] = {
        "learner": (NeverSwitch(), "start"),
        **{name: (registry.make_method(name).calibrate(calibration).rule, "onset") for name in (fixed, RULE)},
        "expert": (registry.make_method("expert").calibrate(calibration).rule, "start"),
    }
    env = stages.make_env(task, task.paper_cell)
    runs = {name: _drive(task, env, trained, rule, seed, arming) for name, (rule, arming) in drivers.items()}
    env.close()
    thresholds = {name: _threshold(rows, "onset", name) for name in (fixed, RULE)}
    return Story(task, runs, thresholds, float(table.t_first[index]), float(table.t_last[index]))


def _typical_fixed(rows: pd.DataFrame, horizon: int) -> str:
    """The fixed threshold on `SIGNAL` of median mean return: neither the luckiest nor the worst choice by hand."""
    fixed = rows[rows["method"].str.startswith("fixed-") & rows["method"].str.endswith(f"@{SIGNAL}")]
    returns = (fixed["armed_learner_steps"] / horizon + PHI * fixed["success"]).groupby(fixed["method"]).mean()
    ranked = sorted(returns.index, key=lambda name: (returns[name], name))
    return str(ranked[(len(ranked) - 1) // 2])


def _drive(task: Task, env: Any, trained: Trained, rule: Any, seed: int, arming: Arming) -> Episode:
    driver, signals = trained.learner(task), trained.signals(task)
    return run_episode(env, driver, signals, rule, env.make_expert(), seed, arming, record_snapshots=True)


def _draw_episode(story: Story, rows: pd.DataFrame, target: Path) -> None:
    """Signals of the learner alone, and beneath them what it saw, alone and with the rule."""
    task, alone = story.task, story.runs["learner"]
    own = {name: _threshold(rows, "onset", f"cem@{name}") for name in drawn_signals(task) if name != "epistemic"}
    shown = [name for name in dict.fromkeys([*own, "epistemic", "aleatoric"]) if name in alone.signals]
    env = stages.make_env(task, task.paper_cell)
    strips = [_strip(env, name, story.runs[name]) for name in ("learner", RULE)] if sees_images(env) else []
    episode_figures.figure_episode(
        {name: alone.signals[name] for name in shown},
        own,
        env.control_dt,
        Marks(alone.onset, story.runs[RULE].handover, story.t_first),
        target / "episode.png",
        f"{story.title}: signals of the learner alone, threshold and handover of {RULE}",
        strips,
    )
    env.close()


def _strip(env: TaskEnv, name: str, episode: Episode) -> episode_figures.Strip:
    frames = observations(env, episode, episode_figures.strip_steps(episode.horizon))
    if episode.success:
        verdict = "success"
    else:
        verdict = (
            "failure" if episode.length == episode.horizon else f"failure\nat {episode.length * env.control_dt:.1f} s"
        )
    return episode_figures.Strip(name, frames, episode.driver, verdict)


def _draw_film(story: Story, target: Path) -> None:
    """Every driver's pictures beside the trace of its signal, two and two."""
    env = _film_env(story.task)
    values = [*(run.signals[SIGNAL] for run in story.runs.values()), np.array(list(story.thresholds.values()))]
    limits = (min(float(np.nanmin(each)) for each in values), max(float(np.nanmax(each)) for each in values))
    seen = {name: replay(env, run) for name, run in story.runs.items()}
    tiles = []
    for name, run in story.runs.items():
        threshold = story.thresholds.get(name)
        trace = Trace(SIGNAL, run.signals[SIGNAL], run.driver, env.control_dt, story.marks(name), threshold, limits)
        tiles.append(replay_frames(run, seen[name], name, trace))
    fps = round(1 / env.control_dt)
    write_side_by_side(tiles, target / "episode.mp4", fps, columns=2)
    for name, run in story.runs.items():
        write_side_by_side([replay_frames(run, seen[name], name)], target / _film_name(name), fps)
    save_json(target / STORY, _story_facts(story, fps))
    env.close()


def _film_name(driver: str) -> str:
    return f"film-{driver.replace('@', '-')}.mp4"


def _story_facts(story: Story, fps: int) -> dict[str, Any]:
    """What the report draws beside the films: when what happened, and the signal's trace under each driver [steps]."""
    alone = story.runs["learner"]
    return {
        "cell": str(story.task.paper_cell),
        "seed": alone.seed,
        "learner": 0,
        "signal": SIGNAL,
        "fps": fps,
        "horizon": alone.horizon,
        "t_first": story.t_first,
        "t_last": story.t_last,
        "runs": [
            {
                "driver": name,
                "file": _film_name(name),
                "threshold": story.thresholds.get(name),
                "onset": run.onset,
                "handover": run.handover,
                "length": run.length,
                "success": bool(run.success),
                "trace": [round(float(value), 6) for value in run.signals[SIGNAL]],
            }
            for name, run in story.runs.items()
        ],
    }


def _film_env(task: Task) -> TaskEnv:
    """Draws the paper's cell at the size of a tile, in the proportions of the task's own pictures."""
    plain = stages.make_env(task, task.paper_cell)
    width = 2 * round(HEIGHT * plain.width / plain.height / 2)
    plain.close()
    return stages.make_env(task, task.paper_cell, render_mode="rgb_array", width=width, height=HEIGHT)


def _draw_disturbances(task: Task, target: Path) -> None:
    """What the learner sees under each disturbance, in the first design episode, which the expert drives."""
    env = stages.make_env(task, task.none_cell)
    if not sees_images(env):
        return
    paper = [cell for cell in task.cells if cell.tag == "paper" and cell.severity in SHEET_SEVERITIES]
    others = [cell for cell in task.cells if cell.tag in ("other", "benign")]
    (seed,), expert = episode_seeds("design", 1), env.make_expert()
    rows = {}
    for cell in [*sorted(paper, key=lambda cell: cell.severity), *others]:
        disturbance = DISTURBANCES[cell.disturbance]
        sentence = disturbance.describe(cell.severity) + (" (benign)" if disturbance.benign else "")
        rows[f"{cell.disturbance}, severity {cell.severity}"] = (sentence, _sheet_frames(task, cell, expert, seed))
    after = [f"$t_0$ + {step * env.control_dt:.2g} s" for step in SHEET_STEPS[2:]]
    path = target / "disturbances.png"
    episode_figures.figure_disturbances(rows, ["the step before", "$t_0$", *after], path)
    env.close()


def _sheet_frames(task: Task, cell: Cell, expert: Expert, seed: int) -> list[NDArray[np.uint8] | None]:
    """Observations at `SHEET_STEPS` while the expert drives; None after an early end."""
    env = stages.make_env(task, cell)
    env.reset(seed=seed)
    expert.reset()
    seen: dict[int, NDArray[np.uint8]] = {}
    # The onset may be the first step at which something is in view, and is known only then.
    while not env.done and env.step_index <= (env.onset or 0) + SHEET_STEPS[-1]:
        seen[env.step_index] = env.observe()
        env.advance(expert.action(env.state, env.parameters))
    env.close()
    return [seen.get((env.onset or 0) + step) for step in SHEET_STEPS]
