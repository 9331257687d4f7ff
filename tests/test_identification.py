"""The bicycle against the MuJoCo car: predictions of a second, and constants that a fit finds again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from safeswitch.expert import bicycle
from safeswitch.expert.bicycle import CONTEXT, STEERING_LIMIT, Car
from safeswitch.expert.identification import COLUMNS, FITTED, SUBSTEPS, Drives, errors_at_end, fit, predict, record
from safeswitch.expert.rally_car_model import CurvatureWindow
from safeswitch.tasks.rally_car import RallyCarEnv

DT = 0.05


@cache
def drives(count: int, speed: float = 4.0) -> Drives:
    return record(RallyCarEnv(speed=speed), range(1_000_000, 1_000_000 + count))


@pytest.mark.parametrize(("speed", "bound"), [(3.0, 0.04), (4.0, 0.06), (5.0, 0.10)])
def test_bicycle_predicts_a_second_of_the_mujoco_car(speed: float, bound: float) -> None:
    """Under noise in steering and throttle, at the limit of friction here and there at 5 m/s."""
    median, high = errors_at_end(drives(3, speed), DT, Car())
    assert median < bound and high < 4 * bound


def test_predictions_are_those_of_the_model_step_by_step() -> None:
    some = drives(3)
    predicted = predict(some, DT, Car())
    f, window = bicycle.dynamics(DT, False, Car(), SUBSTEPS), CurvatureWindow(some.track)
    context = np.zeros(len(CONTEXT))
    for i in (0, len(some.states) - 1):
        x = some.states[i, 0, COLUMNS]
        window.write(x[0], context[1:])
        for action in some.actions[i]:
            p = np.concatenate([some.parameters[i], context])
            x = f(x, action * [STEERING_LIMIT, 1.0], p).full().ravel()
        np.testing.assert_allclose(predicted[i, -1, COLUMNS], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(predicted[i, 0], some.states[i, 0])


def test_a_wrong_car_predicts_worse() -> None:
    right = errors_at_end(drives(3), DT, Car())[0]
    for wrong in (replace(Car(), steering_lag=0.15), replace(Car(), slip_front=0.4), replace(Car(), drive=6.0)):
        assert errors_at_end(drives(3), DT, wrong)[0] > 1.5 * right


@pytest.mark.slow
def test_the_fit_finds_known_constants_and_those_of_the_mujoco_car() -> None:
    some = drives(8)
    true = replace(Car(), slip_front=0.08, slip_rear=0.05, steering_lag=0.07, drive=3.0)
    found = fit(replace(some, states=predict(some, DT, true)), DT)
    for name in FITTED:
        assert getattr(found, name) == pytest.approx(getattr(true, name), rel=0.05)
    fitted = fit(some, DT, replace(Car(), slip_front=0.15, slip_rear=0.15))
    assert errors_at_end(drives(3, 4.0), DT, fitted)[0] < 0.06
    assert fitted.drive == pytest.approx(Car().drive, rel=0.05)
    assert fitted.steering_lag == pytest.approx(Car().steering_lag, rel=0.3)
