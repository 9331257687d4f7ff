"""TensorBoard: curves of training and of every search for a threshold, such as CEM.

They are written afterwards, from what learners and methods record anyway: a run computes the same bits with TensorBoard
and without, and results that the store already holds are shown too.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safeswitch.files import load_arrays

if TYPE_CHECKING:
    from safeswitch.pipeline import Run


def check_installed() -> None:
    """Refuse before anything is computed where TensorBoard is missing."""
    if importlib.util.find_spec("tensorboard") is None or importlib.util.find_spec("torch") is None:
        raise ValueError("--tensorboard needs TensorBoard: pip install 'safeswitch[tensorboard]'")


def write_training(run: Run, folder: Path) -> Path:
    """Write the history of every learner, a number per epoch and curve; returns the task's folder of event files.

    A learner without a `history` (curve -> one number per epoch) has nothing to show.
    """
    for seed, job in enumerate(run.learners):
        learner = _load(run, job.key)
        curves = {f"training/{name}": values for name, values in getattr(learner, "history", {}).items()}
        _write(folder / run.task.name / f"learner-{seed}", curves)
    return folder / run.task.name


def write_searches(run: Run, folder: Path) -> Path:
    """Write what searches recorded: for CEM `mu`, `sigma`, `reward_sum` and `accepted` of every iteration.

    There is one folder a cell and learner, with a curve per protocol, method and quantity.
    """
    for job in run.episodes:
        cell, trained = job.arguments[2], job.arguments[3]
        logs = load_arrays(run.store.folder(job.key) / "logs.npz")
        curves = {name.replace("|", "/"): values for name, values in logs.items() if values.ndim == 1}
        _write(folder / str(cell) / f"learner-{trained.seed}", curves)
    return folder / run.task.name


def _load(run: Run, key: str) -> Any:
    from safeswitch.trained import load_learner

    return load_learner(run.task, str(run.store.folder(key)))


def _write(folder: Path, curves: Mapping[str, Any]) -> None:
    """Event files of one group of curves, in place of older ones."""
    from torch.utils.tensorboard import SummaryWriter

    for old in folder.glob("events.out.tfevents.*"):
        old.unlink()
    with SummaryWriter(str(folder)) as writer:
        for name, values in sorted(curves.items()):
            for step, value in enumerate(np.asarray(values, float)):
                writer.add_scalar(name, value, step)
