"""Runs the jobs of a stage that are not finished yet, over worker processes, with a progress bar."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from joblib import Parallel, delayed, parallel_config

from safeswitch import durations
from safeswitch.console import Progress, StageError
from safeswitch.store import Store

if TYPE_CHECKING:
    from safeswitch.pipeline import Run
    from safeswitch.stages import Job


def finish(stage: str, jobs: Mapping[Run, Sequence[Job]]) -> None:
    """Run the jobs of one stage of one or more runs that share a store, with one progress bar for all.

    Jobs that the store holds are not run again; if nothing is left to do, only a stage that is new to a run is shown.
    """
    started = time.perf_counter()
    pending = {run: [job for job in each if not run.store.has(job.key)] for run, each in jobs.items()}
    due = [job for each in pending.values() for job in each]
    involved = [run for run, each in jobs.items() if each and (due or stage not in run.seconds)]
    if involved:
        total = sum(len(jobs[run]) for run in involved)
        expected = durations.of_stage(
            [(run.typical, len(pending[run])) for run in involved], stage, involved[0].workers
        )
        with Progress(_label(involved, stage), total, total - len(due), expected) as progress:
            try:
                for label in _run(involved[0], due):
                    progress.advance(label)
            except ValueError:
                raise  # a setting that is refused
            except Exception as error:
                names = ", ".join(run.task.name for run in involved)
                raise StageError(f"{names}: {stage} failed: {type(error).__name__}: {error}") from error
    seconds = time.perf_counter() - started
    for run, each in jobs.items():
        if each:
            run.record(stage, each, seconds)


def _run(run: Run, pending: list[Job]) -> Iterator[str]:
    """Labels of the jobs, each as soon as it is finished."""
    # One job alone runs in this process, from where it may use processes of its own, as demonstrations do.
    with processes(min(run.workers, max(len(pending), 1))):
        yield from Parallel(return_as="generator_unordered")(
            delayed(run_job)(str(run.store.root), job) for job in pending
        )


@contextmanager
def processes(count: int) -> Iterator[None]:
    """Let joblib use `count` processes of one thread each in this block, OpenGL's included."""
    single = parallel_config("loky", n_jobs=count, inner_max_num_threads=1)
    with single, _born_with("LP_NUM_THREADS", "1"), warnings.catch_warnings():
        # loky replaces a worker whose memory has grown, and warns of it
        warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
        yield


@contextmanager
def _born_with(name: str, value: str) -> Iterator[None]:
    """Give processes that start in this block an environment variable; one that the user has set stays."""
    if name in os.environ:
        yield
        return
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]


def _label(runs: Sequence[Run], stage: str) -> str:
    """What is being done, for whom, and which stage of how many it is."""
    plan = runs[0].plan
    number = f"{plan.index(stage) + 1}/{len(plan)} " if stage in plan else ""
    names = ", ".join(run.title or run.task.name for run in runs)
    return f"{names} {number}{stage:<{max(map(len, plan)) if number else 0}}"


def run_job(root: str, job: Job) -> str:
    """Run one job in this process and move its results into the store."""
    with Store(root).writing(job.key) as folder:
        job.run(folder, *job.arguments)
    return job.label
