"""What must hold of the episodes of latched rules: a table that was made up, or edited, soon breaks one of these laws.

o(s), the outcome of handing over at step s, is one function for all latched rules on an episode: two rules that hand
over at the same step end alike, all handovers up to `t*_first` succeed, and none after `t*_last` does.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import pandas as pd

from safeswitch.scoring.metrics import EPISODE, TaskInfo, prepare

TRAJECTORY = ["onset", "arming_step", "learner_success", "t_first", "t_last"]
"""Of the learner-only trajectory: the same for every rule."""


def check_laws(episodes: pd.DataFrame, info: TaskInfo, give_back: Collection[str] = ()) -> None:
    """Check the episodes of one task, cell and protocol.

    Args:
        episodes: with the columns of `metrics.COLUMNS`.
        info: of the task.
        give_back: methods that may return control, of which less is known.

    Raises:
        ValueError: the law that is broken, how often, and the first episode that breaks it.
    """
    frame = prepare(episodes, {task: info for task in episodes["task"].unique()})
    for name in TRAJECTORY:
        values = frame.groupby(EPISODE)[name].transform("nunique", dropna=False)
        _hold(f"every method has the same {name}", frame, values == 1)
    for law, holds in {**_trajectory(frame, info), **_references(frame, info)}.items():
        _hold(law, frame, holds)
    latched = frame[~frame["method"].isin(list(give_back))]
    for law, holds in _latched(latched, info).items():
        _hold(law, latched, holds)


def _trajectory(frame: pd.DataFrame, info: TaskInfo) -> dict[str, Any]:
    first, last, disturbed = frame["t_first"], frame["t_last"], frame["disturbed"]
    alone = disturbed & frame["learner_success"]
    failed = disturbed & ~frame["learner_success"]
    window = first.between(frame["onset"], last) & (last < info.horizon)
    armed = frame["onset"].where(frame["protocol"] == "onset", 0)
    return {
        "arming_step is the onset, or 0 under 'start'": frame["arming_step"] == armed,
        "t_first and t_last are blank without a disturbance": disturbed | (first.isna() & last.isna()),
        "t_first and t_last are T where the learner alone succeeds": ~alone
        | ((first == info.horizon) & (last == info.horizon)),
        "onset <= t_first <= t_last < T where it fails": ~failed | first.isna() | window,
        "t_last >= onset where it fails": ~failed | last.isna() | (last.between(frame["onset"], info.horizon - 1)),
    }


def _references(frame: pd.DataFrame, info: TaskInfo) -> dict[str, Any]:
    handed = frame["handover"] < info.horizon
    return {
        "the method 'learner' never hands over": (frame["method"] != "learner") | ~handed,
        "the method 'expert' hands over at the arming step": (frame["method"] != "expert")
        | (frame["handover"] == frame["arming_step"])
        | (~handed & (frame["learner_steps"] <= frame["arming_step"])),
    }


def _latched(frame: pd.DataFrame, info: TaskInfo) -> dict[str, Any]:
    handover, steps, success = frame["handover"], frame["learner_steps"], frame["success"]
    handed = handover < info.horizon
    judged = frame["disturbed"] & ~frame["learner_success"] & handed & (handover >= frame["onset"])
    same = frame.groupby([*EPISODE, "handover"])
    return {
        "no handover before the arming step": ~handed | (handover >= frame["arming_step"]),
        "learner_steps is the handover step": ~handed | (steps == handover),
        "armed_learner_steps is learner_steps after the arming step": frame["armed_learner_steps"]
        == (steps - frame["arming_step"]).clip(lower=0),
        "handovers is 1 after a handover and 0 without": frame["handovers"] == handed.astype(int),
        "without a handover success is the learner's": handed | (success == frame["learner_success"]),
        "without a handover a success lasts T steps": handed | ~success | (steps == info.horizon),
        "handovers up to t_first succeed": ~judged | ~(handover <= frame["t_first"]) | success,
        "handovers after t_last fail": ~judged | ~(frame["t_last"].isna() | (handover > frame["t_last"])) | ~success,
        "equal handover steps have equal outcomes": same["success"].transform("nunique") == 1,
        "equal handover steps have equal learner_steps": same["learner_steps"].transform("nunique") == 1,
    }


def _hold(law: str, frame: pd.DataFrame, holds: Any) -> None:
    if not holds.all():
        shown = ["method", *EPISODE, *TRAJECTORY, "handover", "learner_steps", "success"]
        row = frame.loc[~holds, shown].iloc[0]
        first = ", ".join(f"{name} {value}" for name, value in row.items())
        raise ValueError(f"{int((~holds).sum())} of {len(frame)} rows break the law {law!r}, the first: {first}")
