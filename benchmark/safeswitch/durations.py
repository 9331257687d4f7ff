"""Roughly how long a run takes, from what earlier runs took: what `bench` says at its start and the bars show.

The manifest that a run leaves beside its results says how long its jobs took. Where there is none of the same profile,
`durations.json` is used: rounded figures of the same kind for two idle cores, split up over the stages from measured
totals. Nothing but what is shown depends on them.
"""

from __future__ import annotations

from collections.abc import Sequence
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


SIDE_BY_SIDE = ("training", "signal fits")
"""Stages that a run of several tasks goes through for all of them at once (`safeswitch.pipeline.prepare`)."""


def together(each: Sequence[dict[str, Stage]], workers: int) -> float:
    """Wall time of several tasks in one run, from scratch [s]; those of which nothing is known count as nothing."""
    seconds = 0.0
    for found in each:
        seconds += total({name: stage for name, stage in found.items() if name not in SIDE_BY_SIDE}, workers) or 0.0
    for name in SIDE_BY_SIDE:
        alone = [{name: found[name]} for found in each if name in found]
        at_once = of_stage([(found, found[name].jobs or 1) for found in alone], name, workers)
        seconds += at_once or sum(total(found, workers) or 0.0 for found in alone)
    return seconds


def of_stage(parts: Sequence[tuple[dict[str, Stage], int]], name: str, workers: int) -> float | None:
    """Wall time of the pending jobs of a stage [s], of one task or of several at once; None if one's is not known.

    Args:
        parts: stages of an earlier run of a task, and how many jobs of it are pending now.
        name: the stage.
        workers: processes at a time.
    """
    each = []
    for found, pending in parts:
        if pending:
            stage = found.get(name)
            if stage is None or not stage.jobs:
                return None
            each += [stage.work / stage.jobs] * pending
    if not each:
        return None
    if len(set(each)) == 1:
        return each[0] * -(-len(each) // min(workers, len(each)))
    return max(max(each), sum(each) / workers)
