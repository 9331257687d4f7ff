"""The scores of one episode and their summary per (task, disturbance, severity, protocol, method).

Definitions are on one page, docs/scores.md. Episodes come as a long table, one row per (learner, episode, method), with
the columns of `COLUMNS`; steps are control steps of the task, 0 .. T, and T stands for "never".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from safeswitch.names import unknown
from safeswitch.protocols import ARMINGS

PHI = 5.0
"""Reward of success in the headline, in units of a whole episode driven by the learner (DESIGN section 2)."""
OTHER_PHIS = (2.0, 20.0, 100.0)
"""The headline is repeated for these rewards of success."""
OTHER_PREVALENCES = (0.1, 0.9)
"""Shares of disturbed episodes to which the half-and-half `start` returns are re-weighted."""
REFERENCES = ("learner", "expert", "timer")
"""The methods whose best return is the zero of skill, R0."""
OTHERS = "other disturbances"
"""`calibrated_on` of the rows whose threshold has not seen the disturbance that it is tested on."""
MIN_CONTEST = 0.1
"""Below this distance between R0 and the hindsight best a cell is no contest and has no skill."""

CELL = ["task", "disturbance", "severity", "protocol"]
EPISODE = ["learner", "seed", "disturbed"]
INTEGERS = [
    "severity", "learner", "seed", "onset", "arming_step", "handover", "learner_steps", "armed_learner_steps",
    "handovers", "tuning_episodes", "expert_queries",
]  # fmt: skip
BOOLEANS = ["disturbed", "success", "learner_success"]
COLUMNS = [
    *CELL, "method", *EPISODE, "onset", "arming_step", "handover", "learner_steps", "armed_learner_steps",
    "success", "learner_success", "t_first", "t_last", "handovers", "threshold", "tuning_episodes", "expert_queries",
]  # fmt: skip
"""Required columns of the episodes. `calibrated_on` (str) is optional and then tells rows of one method apart."""


@dataclass(frozen=True)
class TaskInfo:
    """What scoring knows of a task.

    Attributes:
        horizon: T, full length of an episode [control steps].
        control_dt: length of a control step [s].
    """

    horizon: int
    control_dt: float

    def __post_init__(self) -> None:
        if self.horizon < 1 or not self.control_dt > 0:
            raise ValueError(f"horizon must be >= 1 and control_dt > 0, got {self.horizon} and {self.control_dt}")


def signal_of(method: str) -> str | None:
    """The signal of a method id, what follows "@"; None where there is none."""
    return method.partition("@")[2] or None


def row_key(episodes: pd.DataFrame) -> list[str]:
    """Columns that identify a row of the leaderboard."""
    return [*CELL, "method", *(["calibrated_on"] if "calibrated_on" in episodes else [])]


def prepare(episodes: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> pd.DataFrame:
    """Check the episodes and put them in the one order that every score is computed in.

    Raises:
        ValueError: what is wrong, in which column, with the values that are allowed.
    """
    missing = [name for name in COLUMNS if name not in episodes]
    if missing:
        raise ValueError(f"the episodes lack the columns {missing}; they have {sorted(map(str, episodes.columns))}")
    if episodes.empty:
        raise ValueError("there are no episodes to score")
    frame = episodes.copy()
    for name in INTEGERS + BOOLEANS:
        frame[name] = _whole(frame[name], name)
    frame[BOOLEANS] = frame[BOOLEANS].astype(bool)
    for name in ("t_first", "t_last", "threshold"):
        frame[name] = frame[name].astype(float)
    if "calibrated_on" in frame:
        frame["calibrated_on"] = frame["calibrated_on"].fillna("")
    for task in frame["task"].unique():
        if task not in infos:
            raise unknown("task", task, infos)
    for protocol in frame["protocol"].unique():
        if protocol not in ARMINGS:
            raise unknown("protocol", protocol, ARMINGS)
    order = row_key(frame) + EPISODE
    codes = [pd.factorize(frame[name], sort=True)[0] for name in order]  # far quicker than sorting rows of strings
    frame = frame.iloc[np.lexsort(codes[::-1])].reset_index(drop=True)
    _check_ranges(frame, infos)
    _check_pairs(frame, order)
    return frame


def _whole(column: pd.Series, name: str) -> pd.Series:
    values = column.to_numpy(dtype=float)
    bad = ~np.isfinite(values) | (values != np.round(values))
    if name in BOOLEANS:
        bad |= (values != 0) & (values != 1)
    if bad.any():
        kind = "true or false" if name in BOOLEANS else "whole numbers"
        raise ValueError(f"column {name!r} must hold {kind}, got {column[bad].iloc[0]!r} in {int(bad.sum())} rows")
    return pd.Series(values.astype(np.int64), index=column.index)


def _check_ranges(frame: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> None:
    horizon = _of_task(frame, infos, "horizon")
    laws = {
        "0 <= handover <= T": frame["handover"].between(0, horizon),
        "0 <= learner_steps <= T": frame["learner_steps"].between(0, horizon),
        "0 <= armed_learner_steps <= learner_steps": frame["armed_learner_steps"].between(0, frame["learner_steps"]),
        "onset >= 0 where disturbed and -1 elsewhere": (frame["onset"] >= 0) == frame["disturbed"],
        "onset <= T": frame["onset"] <= horizon,
        "protocol 'onset' has disturbed episodes only": (frame["protocol"] != "onset") | frame["disturbed"],
    }
    for law, holds in laws.items():
        if not holds.all():
            row = frame.loc[~holds, [*CELL, "method", *EPISODE, "onset", "handover", "learner_steps"]].iloc[0]
            raise ValueError(f"{int((~holds).sum())} episodes break {law!r}, the first: {row.to_dict()}")


def _check_pairs(frame: pd.DataFrame, order: list[str]) -> None:
    repeated = frame.duplicated(order)
    if repeated.any():
        first = frame.loc[repeated, order].iloc[0].to_dict()
        raise ValueError(f"{int(repeated.sum())} episodes occur twice, the first: {first}")
    start = frame[(frame["protocol"] == "start") & ~frame["disturbance"].str.fullmatch("none(@.*)?")]
    if start.empty:
        return
    twins = start.groupby([*row_key(frame), "learner", "seed"], sort=False, dropna=False).size()
    if (twins != 2).any():
        alone = dict(zip(twins.index.names, twins.index[(twins != 2).to_numpy()][0], strict=True))
        raise ValueError(
            f"under 'start' every disturbed episode needs its undisturbed twin of the same learner and seed (and the "
            f"reverse): {int((twins != 2).sum())} pairs are incomplete, the first: {alone}"
        )


def _of_task(frame: pd.DataFrame, infos: Mapping[str, TaskInfo], name: str) -> pd.Series:
    return frame["task"].map({task: getattr(info, name) for task, info in infos.items()}).astype(float)


def returns(frame: pd.DataFrame, infos: Mapping[str, TaskInfo], phi: float = PHI) -> pd.Series:
    """Return of each episode: 1/T for each learner-driven step from the arming step on, and `phi` on success."""
    return frame["armed_learner_steps"] / _of_task(frame, infos, "horizon") + phi * frame["success"]


def episode_scores(frame: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> pd.DataFrame:
    """Scores of each episode of `prepare`, NaN where a score does not apply. Times in seconds."""
    horizon, dt = _of_task(frame, infos, "horizon"), _of_task(frame, infos, "control_dt")
    handover, onset = frame["handover"], frame["onset"]
    disturbed, success, alone = frame["disturbed"], frame["success"], frame["learner_success"]
    handed = handover < horizon
    doomed = disturbed & ~alone  # the episodes in which a handover is needed
    judged = doomed & frame["t_first"].notna()
    window = frame["t_first"] - onset
    scores = {
        "autonomy": frame["learner_steps"] / horizon,
        "recovery": success.where(doomed),
        "harm": (~success).where(alone),
        "harm_disturbed": (~success).where(alone & disturbed),
        "harm_undisturbed": (~success).where(alone & ~disturbed),
        "timely": (handed & (handover >= onset) & success).where(doomed & frame["t_last"].notna()),
        "missed": (~handed).where(judged),
        "margin_s": ((frame["t_first"] - handover) * dt).where(judged & handed),
        "delay_s": ((handover - onset) * dt).where(disturbed & handed & (handover >= onset)),
        "share_used": ((handover - onset) / window.where(window > 0)).clip(0, 1).where(judged),
        "false_alarms": frame["handovers"].where(~disturbed),
        "false_alarms_before_onset": (handover < onset).where(disturbed),
        "handovers": frame["handovers"],
    }
    return pd.DataFrame({name: score.astype(float) for name, score in scores.items()})


MEDIANS = ["margin_s", "delay_s"]


def summary(frame: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> pd.DataFrame:
    """Point estimates per leaderboard row (its key is the index) of everything that needs no interval."""
    key = row_key(frame)
    groups_of = [frame[name] for name in key]
    scores = episode_scores(frame, infos)
    groups = scores.groupby(groups_of, sort=True, dropna=False)
    table = groups.mean()
    table[MEDIANS] = groups[MEDIANS].median()
    for phi in OTHER_PHIS:
        table[f"return_phi{phi:g}"] = returns(frame, infos, phi).groupby(groups_of, sort=True, dropna=False).mean()
    table["needing_handover"] = scores["recovery"].notna().groupby(groups_of, sort=True, dropna=False).sum()
    table = table.join(_prevalence_returns(frame, infos)).join(_per_learner(frame, infos))
    return table


def _prevalence_returns(frame: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> pd.DataFrame:
    """Returns under `start` if a share p of the episodes were disturbed, at the threshold calibrated for one half."""
    key = row_key(frame)
    earned = returns(frame, infos).where(frame["protocol"] == "start")
    halves = [
        earned.where(side).groupby([frame[name] for name in key], sort=True, dropna=False).mean()
        for side in (frame["disturbed"], ~frame["disturbed"])
    ]
    columns = {f"return_prevalence{100 * p:g}": p * halves[0] + (1 - p) * halves[1] for p in OTHER_PREVALENCES}
    return pd.DataFrame(columns)


def _per_learner(frame: pd.DataFrame, infos: Mapping[str, TaskInfo]) -> pd.DataFrame:
    """Calibration, which is done once per learner, and the spread over learners."""
    key = row_key(frame)
    columns = frame.assign(earned=returns(frame, infos), success=frame["success"].astype(float))
    by_learner = columns.groupby([*key, "learner"], sort=True, dropna=False)
    table = by_learner[["threshold", "tuning_episodes", "expert_queries"]].first()
    table[["earned", "success"]] = by_learner[["earned", "success"]].mean()
    groups = table.groupby(level=list(range(len(key))), sort=True, dropna=False)
    spread = {
        "threshold": groups["threshold"].median(),
        "tuning_episodes": groups["tuning_episodes"].mean(),
        "expert_queries": groups["expert_queries"].mean(),
        "return_learner_min": groups["earned"].min(),
        "return_learner_max": groups["earned"].max(),
        "success_learner_min": groups["success"].min(),
        "success_learner_max": groups["success"].max(),
    }
    return pd.DataFrame(spread)
