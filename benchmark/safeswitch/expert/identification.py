"""The constants of the bicycle (`safeswitch.expert.bicycle.Car`), identified against the MuJoCo car.

The car is driven along the track with noise in steering and throttle; from many states on the way the bicycle predicts
a second ahead under the same actions, and least squares fits its constants to where the car really was. Run
``python -m safeswitch.expert.identification`` for the fit and its errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from safeswitch.expert import bicycle
from safeswitch.expert.bicycle import CONTEXT, STEERING_LIMIT, Car
from safeswitch.expert.rally_car_model import CurvatureWindow
from safeswitch.seeding import stream

if TYPE_CHECKING:
    from safeswitch.tasks.rally_car import RallyCarEnv
    from safeswitch.tasks.track import Track

Array = NDArray[np.float64]

SECONDS = 1.0
SUBSTEPS = 5  # per control step: the constants are those of the equations, not of a coarse integration
EVERY = 5  # steps between the states from which a second is predicted
COLUMNS = [0, 1, 2, 4, 5, 6, 3]  # the model's state from the environment's
FITTED = ("slip_front", "slip_rear", "steering_lag", "drive")
NOISE = (0.25, 0.2)  # standard deviation in steering and throttle, action units; neighbouring steps correlate by 0.9


@dataclass(frozen=True)
class Drives:
    """Pieces of `steps` control steps of the real car.

    Attributes:
        track: it was driven on.
        states: (n, steps + 1, 7), the environment's.
        actions: (n, steps, 2), executed.
        parameters: (n, 9), the environment's.
    """

    track: Track
    states: Array
    actions: Array
    parameters: Array


def record(env: RallyCarEnv, seeds: Sequence[int], seconds: float = SECONDS) -> Drives:
    """Drive the episodes `seeds` of the car with throttle, with noise in the expert's actions."""
    expert, steps = env.make_expert(), round(seconds / env.control_dt)
    pieces: list[tuple[Array, Array, Array]] = []
    for seed in seeds:
        env.reset(seed=seed)
        expert.reset()
        rng, noise = stream(seed, "identification"), np.zeros(2)
        states, actions = [env.state], []
        while not env.done:
            noise = 0.9 * noise + np.sqrt(1 - 0.9**2) * rng.normal(size=2) * NOISE
            actions.append(np.clip(expert.action(env.state, env.parameters) + noise, -1.0, 1.0))
            env.advance(actions[-1])
            states.append(env.state)
        for start in range(0, len(actions) - steps, EVERY):  # without the last step: it may have left the track
            piece = np.array(states[start : start + steps + 1]), np.array(actions[start : start + steps])
            pieces.append((*piece, env.parameters))
    return Drives(env.track, *(np.stack(each) for each in zip(*pieces, strict=True)))


def predict(drives: Drives, control_dt: float, car: Car, substeps: int = SUBSTEPS) -> Array:
    """States (n, steps + 1, 7) that the bicycle predicts from the first ones; s is not wrapped."""
    steps = drives.actions.shape[1]
    window = CurvatureWindow(drives.track)
    context = np.zeros((len(drives.states), len(CONTEXT)))
    for row, s in zip(context, drives.states[:, 0, 0], strict=True):
        window.write(s, row[1:])
    p = np.hstack([drives.parameters, context])
    f = bicycle.dynamics(control_dt, False, car, substeps).expand()
    x, u = drives.states[:, 0, COLUMNS], drives.actions * [STEERING_LIMIT, 1.0]
    rows = [x]
    every = f.map(len(x))
    for i in range(steps):
        rows.append(every(rows[-1].T, u[:, i].T, p.T).full().T)
    back = np.argsort(COLUMNS)
    return np.stack(rows, axis=1)[:, :, back]


def position_errors(drives: Drives, control_dt: float, car: Car, substeps: int = SUBSTEPS) -> Array:
    """(n, steps + 1, 2), predicted minus real position [m], along and across the track."""
    real, predicted = drives.states, predict(drives, control_dt, car, substeps)
    length = drives.track.length
    along = np.remainder(predicted[..., 0] - real[..., 0] + 0.5 * length, length) - 0.5 * length
    stretch = 1.0 - drives.track.curvature(real[..., 0]) * real[..., 1]
    return np.stack([along * stretch, predicted[..., 1] - real[..., 1]], axis=-1)


def fit(drives: Drives, control_dt: float, start: Car | None = None) -> Car:
    """Constants `FITTED` that minimise the position errors along the whole second (soft absolute value)."""
    from scipy.optimize import least_squares

    first = start or Car()

    def car(logarithms: Array) -> Car:
        return replace(first, **dict(zip(FITTED, np.exp(logarithms).tolist(), strict=True)))

    def residual(logarithms: Array) -> Array:
        errors = position_errors(drives, control_dt, car(logarithms))
        return np.nan_to_num(errors, nan=10.0).ravel()

    guess = np.log([getattr(first, name) for name in FITTED])
    answer = least_squares(residual, guess, loss="soft_l1", f_scale=0.03, diff_step=1e-3)
    return car(answer.x)


def errors_at_end(drives: Drives, control_dt: float, car: Car, substeps: int = SUBSTEPS) -> tuple[float, float]:
    """Median and 95 % quantile of the distance between predicted and real end of the pieces [m]."""
    error = np.linalg.norm(position_errors(drives, control_dt, car, substeps)[:, -1], axis=-1)
    median, high = np.quantile(error, [0.5, 0.95]).tolist()
    return median, high


def main() -> None:
    """Print the fitted constants and, on other episodes, the errors of theirs and of the defaults."""
    from safeswitch.suite import episode_seeds
    from safeswitch.tasks.rally_car import RallyCarEnv

    env = RallyCarEnv()
    fitted = fit(record(env, episode_seeds("design", 40)), env.control_dt)
    print({name: round(getattr(fitted, name), 4) for name in FITTED})
    for speed in (3.0, 4.0, 5.0):
        env = RallyCarEnv(speed=speed)
        others = record(env, episode_seeds("design", 20, 100))
        for name, car in (("fitted", fitted), ("default", Car())):
            median, high = errors_at_end(others, env.control_dt, car)
            print(f"{speed:g} m/s, {name}: off after {SECONDS:g} s by {median:.3f} m (median), {high:.3f} m (95 %)")


if __name__ == "__main__":
    main()
