"""What the rally car's expert can do: laps, the point of no return before an obstacle, milliseconds, and its model.

`report` drives the MuJoCo car and writes, into one folder, ``laps.csv``, ``avoidance.csv``, ``timing.csv`` and
``model.csv``, and the figure ``avoidance.png``: the share of obstacles that the expert still avoids against the
distance at which it takes over from a lane keeper that is blind to them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from safeswitch.datasets import make_task
from safeswitch.expert.bicycle import PARAMETERS, Car
from safeswitch.expert.identification import SECONDS, SUBSTEPS, errors_at_end, record
from safeswitch.handover.episode import continue_with_expert
from safeswitch.names import unknown
from safeswitch.protocols import Expert
from safeswitch.scoring.stats import wilson
from safeswitch.scoring.style import CYCLE, DASHES, sheet
from safeswitch.suite import episode_seeds
from safeswitch.tasks.car_geometry import FOOTPRINT
from safeswitch.tasks.track import TRACKS

if TYPE_CHECKING:
    from safeswitch.tasks.rally_car import RallyCarEnv

Array = NDArray[np.float64]

ENV_IDS = {"rally-car-image": "SafeSwitch/RallyCarImage-v0", "rally-car": "SafeSwitch/RallyCar-v0"}
SPEEDS = (3.0, 4.0, 5.0)  # [m/s]
DISTANCES = (1.0, 1.25, 1.5, 2.0, 3.0, 4.0)  # from the front bumper to the obstacle's centre [m]
SEVERITY = 3
BUMPER = FOOTPRINT[1]  # ahead of the centre of mass [m]
MARKERS = ("o", "s", "^", "D", "v")


@dataclass
class Timed:
    """An expert whose calls are timed.

    Attributes:
        expert: the one that answers.
        cold: CPU milliseconds of each first action after a reset; other processes do not count.
        warm: of the others.
    """

    expert: Expert
    cold: list[float] = field(default_factory=list)
    warm: list[float] = field(default_factory=list)
    _fresh: bool = True

    def reset(self) -> None:
        """Forget the plan."""
        self.expert.reset()
        self._fresh = True

    def action(self, state: Array, parameters: Array) -> Array:
        """The expert's action."""
        begin = time.thread_time()
        action = self.expert.action(state, parameters)
        (self.cold if self._fresh else self.warm).append(1e3 * (time.thread_time() - begin))
        self._fresh = False
        return action


def make_car(task: str, **settings: Any) -> RallyCarEnv:
    """The environment of a task of the rally car."""
    if task not in ENV_IDS:
        raise unknown("task with a rally car", task, ENV_IDS)
    env: Any = make_task(ENV_IDS[task], settings)
    return env  # type: ignore[no-any-return]


def laps(task: str, track: str, speed: float, count: int, experts: list[Timed]) -> dict[str, Any]:
    """Drive `count` laps in one go: how many were driven without leaving the track, and how far off the middle."""
    steps = round(1.1 * count * TRACKS[track].length / (speed * 0.05)) + 40
    env = make_car(task, track=track, speed=speed, horizon=steps, spread_e_y=0.0, spread_e_psi=0.0)
    expert = Timed(env.make_expert())
    experts.append(expert)
    env.reset(seed=episode_seeds("design", 1)[0])
    driven, offsets, s = 0.0, [], float(env.state[0])
    while not env.done and driven < count * env.track.length:
        env.advance(expert.action(env.state, env.parameters))
        state = env.state
        driven += (state[0] - s + 0.5 * env.track.length) % env.track.length - 0.5 * env.track.length
        s = float(state[0])
        offsets.append(abs(float(state[1])))
    env.close()
    row = {"track": track, "speed": speed, "laps": int(driven / env.track.length + 1e-9), "asked": count}
    return {**row, "largest_offset": max(offsets), "mean_offset": float(np.mean(offsets))}


def avoidance(
    task: str, track: str, speed: float, distances: Sequence[float], seeds: Sequence[int], experts: list[Timed]
) -> list[dict[str, Any]]:
    """Share of obstacles avoided when the expert takes over at a distance, among those that lane keeping hits.

    Args:
        task: of the rally car.
        track: name.
        speed: [m/s].
        distances: from the front bumper to the obstacle's centre, along the track [m].
        seeds: episodes with the obstacle of severity 3.
        experts: the timed expert is appended.

    Returns:
        One row per distance, with a Wilson interval; the handover is at the control step nearest to the distance.
    """
    env = make_car(task, track=track, speed=speed, disturbance="obstacle", severity=SEVERITY)
    blind, expert = env.make_expert(), Timed(env.make_expert())
    experts.append(expert)
    outcomes: list[list[bool]] = []
    for seed in seeds:
        approach = _approach(env, blind, seed)
        if approach is None:
            continue
        snapshots, gaps = approach
        row = []
        for distance in distances:
            env.restore(snapshots[int(np.abs(gaps - distance).argmin())])
            row.append(continue_with_expert(env, expert))
        outcomes.append(row)
    env.close()
    good, trials = np.sum(outcomes, axis=0, dtype=int), len(outcomes)
    low, high = wilson(good, np.full(len(distances), trials))
    columns = zip(distances, good.tolist(), low.tolist(), high.tolist(), strict=True)
    return [
        {"track": track, "speed": speed, "distance": distance, "trials": trials, "avoided": count,
         "share": count / trials, "lo": lo, "hi": hi}
        for distance, count, lo, hi in columns
    ]  # fmt: skip


def _approach(env: RallyCarEnv, blind: Expert, seed: int) -> tuple[list[Array], Array] | None:
    """Snapshots and gaps [m] of a lane keeper's episode, up to the contact; None if it passes."""
    env.reset(seed=seed)
    blind.reset()
    snapshots, gaps, length = [], [], env.track.length
    while not env.done:
        state, parameters = env.state, env.parameters
        obstacle_s, radius = parameters[PARAMETERS.index("obstacle_s")], parameters[-1]
        if radius > 0:
            snapshots.append(env.snapshot())
            gaps.append((obstacle_s - state[0] + 0.5 * length) % length - 0.5 * length - BUMPER)
        parameters[PARAMETERS.index("obstacle_s") :] = 0.0
        env.advance(blind.action(state, parameters))
    return (snapshots, np.array(gaps)) if env.terminated and gaps else None


def model_errors(speed: float, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Position error of the bicycle after a second against the MuJoCo car, driven with noise at about `speed` [m/s]."""
    env = make_car("rally-car", speed=speed)
    drives = record(env, seeds, SECONDS)
    env.close()
    rows = []
    for name, substeps in (("bicycle", SUBSTEPS), ("in the planner's steps", 1)):
        middle, high = errors_at_end(drives, env.control_dt, Car(), substeps)
        rows.append({"speed": speed, "model": name, "pieces": len(drives.states), "median_m": middle, "p95_m": high})
    return rows


def timing(experts: Sequence[Timed]) -> list[dict[str, Any]]:
    """CPU milliseconds of a step: cold starts, and warm steps."""
    rows = []
    for name in ("cold", "warm"):
        times = np.concatenate([getattr(expert, name) for expert in experts])
        middle, high, highest = np.quantile(times, [0.5, 0.95, 0.99]).tolist()
        row = {"step": name, "steps": len(times), "p50_ms": middle, "p95_ms": high, "p99_ms": highest}
        rows.append({**row, "longest_ms": float(times.max())})
    return rows


def report(
    task: str,
    folder: Path,
    lap_count: int = 50,
    episodes: int = 100,
    progress: Callable[[str], None] | None = None,
) -> dict[str, pd.DataFrame]:
    """Every check on every track at every speed, written to `folder`.

    Args:
        task: rally-car or rally-car-image.
        folder: of the tables and the figure.
        lap_count: laps in one go.
        episodes: episodes with an obstacle, from the design split.
        progress: told what is done next.

    Returns:
        The tables by name.
    """
    if lap_count < 1 or episodes < 1:
        raise ValueError(f"laps and episodes must be at least 1, got {lap_count} and {episodes}")
    experts: list[Timed] = []
    tell, seeds = progress or (lambda _: None), episode_seeds("design", episodes)
    rows: dict[str, list[dict[str, Any]]] = {"laps": [], "avoidance": [], "timing": [], "model": []}
    for track in TRACKS:
        for speed in SPEEDS:
            tell(f"{track} at {speed:g} m/s")
            rows["laps"].append(laps(task, track, speed, lap_count, experts))
            rows["avoidance"] += avoidance(task, track, speed, DISTANCES, seeds, experts)
    for speed in SPEEDS:
        rows["model"] += model_errors(speed, seeds[: max(episodes // 5, 1)])
    rows["timing"] = timing(experts)
    tables = {name: pd.DataFrame(each) for name, each in rows.items()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.to_csv(folder / f"{name}.csv", index=False, float_format="%.6g")
    draw(tables["avoidance"], folder / "avoidance.png")
    return tables


def draw(table: pd.DataFrame, path: Path) -> None:
    """The point of no return: share avoided against the distance at handover, one panel a track, one line a speed."""
    tracks = list(table["track"].unique())
    with sheet(path, 3.6 * len(tracks) + 0.6, 3.0) as figure:
        panels = figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
        for axes, track in zip(panels, tracks, strict=True):
            for i, (speed, rows) in enumerate(table[table["track"] == track].groupby("speed")):
                share, at = rows["share"], rows["distance"] + 0.02 * (i - 1)
                bars = np.array([share - rows["lo"], rows["hi"] - share])
                axes.errorbar(
                    at, share, np.maximum(bars, 0.0), color=CYCLE[i], ls=DASHES[i], marker=MARKERS[i], ms=4,
                    capsize=2, label=f"{speed:g} m/s",
                )  # fmt: skip
            axes.set(title=track, xlabel="front bumper to obstacle at handover [m]", ylim=(-0.03, 1.03))
        panels[0].set_ylabel("avoided")
        panels[-1].legend(loc="lower right")
