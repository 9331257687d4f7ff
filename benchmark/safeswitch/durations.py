"""Roughly how long a run takes, from what earlier runs took: what `bench` says at its start and the bars show.

The manifest that a run leaves beside its results says how long its jobs took. Where there is none of the same profile,
`durations.json` is used: rounded figures of the same kind for two idle cores, split up over the stages from measured
totals. Nothing but what is shown depends on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from safeswitch.files import load_json

SHIPPED = Path(__file__).with_name("durations.json")
"""Task -> profile -> stage -> seconds of work and number of jobs."""


@dataclass(frozen=True)
class Stage:
    """What a stage took when it was computed: `work` [s], added up over `jobs` (None: not recorded)."""

    work: float
    jobs: int | None = None


def stages(task: str, profile: str, folder: Path) -> dict[str, Stage]:
    """Stages of an earlier run of this task and profile by name: of the one in `folder`, else of the shipped one."""
    manifest = folder / "manifest.json"
    entry = load_json(manifest).get(task, {}) if manifest.is_file() else {}
    if entry.get("profile") == profile:
        found = entry["stage_seconds"]
    else:
        found = load_json(SHIPPED).get(task, {}).get(profile, {})
    return {name: Stage(each["work, when computed"], each.get("jobs")) for name, each in found.items()}


def total(found: dict[str, Stage], workers: int) -> float | None:
    """Wall time of all stages from scratch [s]; None if nothing is known."""
    seconds = sum(stage.work / max(min(workers, stage.jobs or workers), 1) for stage in found.values())
    return seconds or None


def of_stage(found: dict[str, Stage], name: str, pending: int, workers: int) -> float | None:
    """Wall time of `pending` jobs of a stage [s]; None if it is not known how long one takes."""
    stage = found.get(name)
    if stage is None or not stage.jobs or not pending:
        return None
    return stage.work / stage.jobs * -(-pending // min(workers, pending))
