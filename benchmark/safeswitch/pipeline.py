"""READ FIRST: expert -> demonstrations -> learner -> signals -> handover tables -> switch rules -> leaderboard.

A `Run` holds the stages of one task in this order; `stages.py` and `scoring_stages.py` say what each computes,
`suite.py` what is run, and `publish.py` writes the tables. Finished work is kept in a store by the hash of everything
it depends on, so that a second run computes nothing and an interrupted one continues where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path

from safeswitch import durations, factories, publish
from safeswitch.execution import finish
from safeswitch.scoring.metrics import TaskInfo
from safeswitch.scoring_stages import episodes_job, methods_in, signals_job
from safeswitch.sensitivity import SAMPLES, latency_job, samples_job, varied_job
from safeswitch.stages import (
    CHUNK,
    CellTables,
    Job,
    demonstrations_job,
    fits_job,
    learner_job,
    make_env,
    only_seen,
    table_jobs,
)
from safeswitch.store import Key, Store
from safeswitch.suite import Cell, Profile, Split, Task, others
from safeswitch.trained import Trained, fitted_signals, needs_members, with_signals_of

STAGES = (
    "demonstrations",
    "training",
    "signal fits",
    "handover tables",
    "switch rules",
    "further severities",
    "signal quality",
    "scores",
    "CEM seeds",
    "sensitivity",
    "figures",
    "published tables",
)
"""Every stage by the name under which it is shown, in order."""

PAPER = ("epistemic", "aleatoric", "total")
"""The signals of the paper."""


@dataclass(eq=False)
class Run:
    """One task under one profile: each property is a stage, computed when it is first asked for.

    Attributes:
        task: the task; its signals are those that the profile's learners allow.
        profile: how much is run.
        store: where finished work is kept.
        workers: processes at a time; the results do not depend on it.
        seconds: wall time spent in each stage by this run [s]; next to nothing where the work was done before.
        work: time that the jobs of each stage took when they were run, added up over workers [s].
        jobs: number of jobs of each stage.
        title: what the task is called while it runs; its name by default.
        plan: the stages that the command goes through, where it goes through all; they are then numbered.
        typical: what the stages took in an earlier run, from which the time left is guessed.
    """

    task: Task
    profile: Profile
    store: Store
    workers: int = 2
    seconds: dict[str, float] = field(default_factory=dict)
    work: dict[str, float] = field(default_factory=dict)
    jobs: dict[str, int] = field(default_factory=dict)
    title: str = ""
    plan: tuple[str, ...] = ()
    typical: dict[str, durations.Stage] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Leave out the signals that need more learners than the profile has."""
        self.task = with_signals_of(self.task, self.profile.learners)
        self._spent: dict[str, dict[str, float]] = {}  # stage -> job -> seconds

    @cached_property
    def demonstrations(self) -> Job:
        """The Minari dataset of the expert."""
        job = demonstrations_job(self.store, self.task, self.profile, self.workers)
        self.finish("demonstrations", [job])
        return job

    @cached_property
    def learners(self) -> list[Job]:
        """One trained learner per learner seed."""
        self.finish("training", self.learner_jobs)
        return self.learner_jobs

    @cached_property
    def learner_jobs(self) -> list[Job]:
        """The same, not trained yet."""
        demonstrations = self.demonstrations if factories.wants_demonstrations(self.task.learner) else None
        return [
            learner_job(self.store, self.task, self.profile, seed, demonstrations)
            for seed in range(self.profile.learners)
        ]

    @cached_property
    def fit_jobs(self) -> list[Job]:
        """What is fitted to the training steps of each learner, for signals; not fitted yet."""
        return [
            fits_job(self.store, self.task, seed, learner, self.demonstrations)
            for seed, learner in enumerate(self.learner_jobs)
            if fitted_signals(self.task)
        ]

    @cached_property
    def trained(self) -> list[Trained]:
        """Each learner with what its signals need: fits to its training steps, and the learners of the other seeds."""
        keys, fits = [job.key for job in self.learners], self.fit_jobs
        if fits:
            self.finish("signal fits", fits)
        members = any(needs_members(signal) for signal in self.task.signals)
        return [
            Trained(
                str(self.store.root),
                seed,
                key,
                fits[seed].key if fits else None,
                self._others(seed, keys) if members else (),
            )
            for seed, key in enumerate(keys)
        ]

    def _others(self, seed: int, keys: list[Key]) -> tuple[Key, ...]:
        """Keys of the learners that an ensemble asks beside this one: the next ones, if not all."""
        following = [*keys[seed + 1 :], *keys[:seed]][: self.task.others]
        return tuple(key for key in keys if key in following)

    @cached_property
    def tables(self) -> dict[tuple[int, str], CellTables]:
        """Handover tables of each (learner seed, cell), on the calibrate and the test split."""
        return self._tables(self.profile.cells_of(self.task))

    def tables_of(self, seed: int, cell: Cell) -> CellTables:
        """Handover tables of one (learner seed, cell), computing no other cell's."""
        task = self.task
        needed = (task.calibrated_on(cell), task.none_cell, task.undisturbed(cell), cell)
        return self._tables(tuple(dict.fromkeys(needed)))[seed, str(cell)]

    @cached_property
    def task_info(self) -> TaskInfo:
        """What scoring knows of the task."""
        env = make_env(self.task, self.task.none_cell)
        return TaskInfo(horizon=env.horizon, control_dt=env.control_dt)

    def _tables(self, cells: tuple[Cell, ...]) -> dict[tuple[int, str], CellTables]:
        task = self.task
        none = tuple(dict.fromkeys(task.undisturbed(cell) for cell in cells))
        calibrated_on = {task.none_cell, *(task.calibrated_on(cell) for cell in cells)}
        chunks: dict[tuple[int, Cell, Split], list[Job]] = {}
        for group in (none, tuple(cell for cell in cells if cell not in none)):  # the others share outcomes of `none`
            stage = []
            for trained, cell in product(self.trained, group):
                splits: tuple[Split, ...] = ("test", "calibrate") if cell in calibrated_on else ("test",)
                for split in splits:
                    twins = chunks.get((trained.seed, task.undisturbed(cell), split), ())
                    seeds = self.profile.seeds_of(task, cell, split)
                    jobs = table_jobs(self.store, task, cell, split, seeds, trained, twins)
                    chunks[trained.seed, cell, split] = jobs
                    stage += jobs
            self.finish("handover tables", stage)
        keys = {name: tuple(job.key for job in jobs) for name, jobs in chunks.items()}
        return {
            (seed, str(cell)): CellTables(
                keys[seed, task.calibrated_on(cell), "calibrate"],
                keys[seed, task.undisturbed(task.calibrated_on(cell)), "calibrate"],
                keys[seed, cell, "test"],
                keys[seed, task.undisturbed(cell), "test"],
                tuple((other, keys[seed, other, "calibrate"]) for other in others(cell, cells)),
            )
            for seed in range(len(self.learners))
            for cell in cells
        }

    @cached_property
    def episodes(self) -> list[Job]:
        """Every method calibrated and tested in each (learner, cell)."""
        tables = self.tables
        jobs = [
            episodes_job(
                self.store,
                self.task,
                cell,
                trained,
                tables[trained.seed, str(cell)],
                methods_in(self.task, cell),
                self._gives_back(cell),
            )
            for trained in self.trained
            for cell in self.profile.cells_of(self.task)
        ]
        self.finish("switch rules", jobs)
        return jobs

    @cached_property
    def signals(self) -> list[Job]:
        """Signal quality in each disturbed (learner, cell), and at the profile's further severities."""
        tables, further = self.tables, self._further_tables()
        test = {
            (trained.seed, cell): tables[trained.seed, str(cell)].test
            for trained in self.trained
            for cell in self.profile.cells_of(self.task)
            if cell.tag != "none"
        }
        chunks = -(-self.profile.signal_episodes // CHUNK)
        jobs = [
            signals_job(
                self.store,
                self.task,
                cell,
                self.trained[seed],
                keys,
                tables[seed, str(self.task.undisturbed(cell))].test[: len(keys) or chunks],
            )
            for (seed, cell), keys in {**test, **further}.items()
        ]
        self.finish("signal quality", jobs)
        return jobs

    def _further_tables(self) -> dict[tuple[int, Cell], tuple[str, ...]]:
        """Tables of the cells in which only signals are scored; none where only the picture is disturbed."""
        if self.task.costly:
            return {}
        profile = self.profile
        seeds = profile.seeds_of(self.task, self.task.none_cell, "test")[: profile.signal_episodes]
        chunks = {
            (trained.seed, cell): []
            if only_seen(cell)
            else table_jobs(self.store, self.task, cell, "test", seeds, trained)
            for trained in self.trained
            for cell in self.task.severities(*profile.signal_severities)
        }
        if chunks:
            self.finish("further severities", [job for jobs in chunks.values() for job in jobs])
        return {name: tuple(job.key for job in jobs) for name, jobs in chunks.items()}

    @cached_property
    def scores(self) -> Job:
        """Leaderboard, signal quality and comparisons."""
        job = publish.scores_job(self.store, self.task, self.task_info, self.episodes, self.signals)
        self.finish("scores", [job])
        return job

    @cached_property
    def spread(self) -> list[Job]:
        """Spread of CEM's threshold over its seeds and initial values, one job per learner."""
        cell = str(self.task.paper_cell)
        jobs = [
            publish.spread_job(self.store, self.task, seed, self.tables[seed, cell])
            for seed in range(len(self.learners))
        ]
        self.finish("CEM seeds", jobs)
        return jobs

    @cached_property
    def varied(self) -> list[Job]:
        """Thresholds learned with one thing changed, per learner, and for some learners with other K; none by default.

        The last one times decisions.
        """
        if not self.profile.sensitivity:
            return []
        tables = {trained.seed: self.tables[trained.seed, str(self.task.paper_cell)] for trained in self.trained}
        jobs = [varied_job(self.store, self.task, each, tables[each.seed]) for each in self.trained]
        jobs += [
            samples_job(self.store, self.task, self.profile, each, samples)
            for each in self.trained[: 1 if self.task.costly else self.profile.sensitivity]
            for samples in SAMPLES
        ]
        jobs.append(latency_job(self.store, self.task, self.trained[0], tables[0]))
        self.finish("sensitivity", jobs)
        return jobs

    @cached_property
    def figures(self) -> list[Job]:
        """Figures and film of the first learner in the paper's cell."""
        cell = str(self.task.paper_cell)
        episodes = next(job for job in self.episodes if job.label == f"{cell} learner 0")
        tables = self.tables[0, cell]
        jobs = [
            publish.film_job(self.store, self.task, self.trained[0], episodes, tables),
            publish.figures_job(self.store, self.task, episodes, tables, self.scores),
        ]
        self.finish("figures", jobs)
        return jobs

    @cached_property
    def literal(self) -> Run | None:
        """The same with the learner as the paper describes it, in two cells; None where the profile leaves it out."""
        if not self.task.literal or not self.profile.literal_learners:
            return None
        task = replace(
            self.task, learner=self.task.literal, learner_options=self.task.literal_options, signals=PAPER, literal=""
        )
        profile = replace(self.profile, learners=self.profile.literal_learners, cells=2, signal_severities=())
        plan = STAGES[: STAGES.index("scores") + 1]
        run = Run(task, profile, self.store, self.workers, title=f"{task.name}, paper's learner")
        run.plan = tuple(stage for stage in run.stages if stage in plan)
        return run

    def _gives_back(self, cell: object) -> bool:
        count = self.profile.give_back_cells
        return cell in self.task.cells[: min(count, 1) if self.task.costly else count]

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages that `publish` goes through, in order."""
        further = self.task.severities(*self.profile.signal_severities)
        left_out = {
            "signal fits": not fitted_signals(self.task),
            "further severities": all(only_seen(cell) for cell in further),
            "published tables": not self.profile.tables,
            "sensitivity": not self.profile.sensitivity,
        }
        return tuple(stage for stage in STAGES if not left_out.get(stage))

    def plan_for(self, folder: Path) -> None:
        """Number the stages that `publish` goes through, and look up in `folder` what they took before."""
        self.plan, self.typical = self.stages, durations.stages(self.task.name, self.profile.name, folder)

    def finish(self, stage: str, jobs: Iterable[Job]) -> None:
        """Run the jobs that the store does not hold yet, `workers` at a time, with a progress bar."""
        finish(stage, {self: list({job.key: job for job in jobs}.values())})

    def record(self, stage: str, jobs: Sequence[Job], seconds: float) -> None:
        """Add the wall time and the jobs of a stage to what this run knows of it."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
        spent = self._spent.setdefault(stage, {})
        spent.update({job.key: self.store.recipe(job.key)["seconds"] for job in jobs})
        self.work[stage], self.jobs[stage] = sum(spent.values()), len(spent)


def train(runs: Sequence[Run]) -> None:
    """Demonstrations and learners of several tasks.

    Training one learner keeps one core busy: those of different tasks are trained side by side.
    """
    for run in runs:
        if factories.wants_demonstrations(run.task.learner):
            _ = run.demonstrations
    finish("training", {run: run.learner_jobs for run in runs})


def prepare(runs: Sequence[Run]) -> None:
    """Learners of several tasks and what their signals are fitted to, before any of them is tested."""
    train(runs)
    finish("signal fits", {run: run.fit_jobs for run in runs})
