"""The rally car's expert: limits of the bicycle, the window of curvature, and driving around what is in the way."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from safeswitch.expert import bicycle
from safeswitch.expert.bicycle import CONTEXT, GRAVITY, KNOTS, PARAMETERS, STEERING_LIMIT, Car
from safeswitch.expert.rally_car_model import CurvatureWindow, RallyCarExpert, make_rally_car_expert
from safeswitch.protocols import Expert
from safeswitch.seeding import stream
from safeswitch.tasks.rally_car_config import HORIZON
from safeswitch.tasks.track import TRACKS, Track

Array = NDArray[np.float64]

L_F, L_R = 0.34, 0.23
WHEELBASE = L_F + L_R
EMPTY = np.array([23.9, 1.9, L_F, L_R, 1.0, 0.0, 0.0, 0.0, 0.0])
DT = 0.05
NOSE = 0.505  # of the car, ahead of its centre of mass [m]


@cache
def expert(track: str = "ridge", steering_only: bool = True) -> RallyCarExpert:
    return make_rally_car_expert(track, steering_only=steering_only)


@pytest.fixture
def fresh() -> RallyCarExpert:
    driver = expert()
    driver.reset()
    driver.mpc.fallbacks = driver.mpc.cold_starts = 0
    return driver


def solver_parameters(speed: float = 4.0, curvature: float = 0.0, **changes: float) -> Array:
    """Parameters of the solver on a bend of constant curvature; the obstacle is far away."""
    p = dict.fromkeys(PARAMETERS + CONTEXT, 0.0) | dict(zip(PARAMETERS, EMPTY.tolist(), strict=True))
    p |= {"speed": speed, "spacing": 1.0, "first_curvature": curvature, "obstacle_s": -1e4} | changes
    return np.array(list(p.values()))


def obstacle(s: float, e: float = 0.0, radius: float = 0.3, **changes: float) -> Array:
    p = EMPTY.copy()
    p[6:] = s, e, radius
    for name, value in changes.items():
        p[PARAMETERS.index(name)] = value
    return p


def on_line(track: Track, s: float, speed: float = 4.0, e_y: float = 0.0) -> Array:
    """State (7,) of a car that follows the centre line in steady cornering."""
    kappa = float(track.curvature(s))
    return np.array([s, e_y, -L_R * kappa, speed, L_R * kappa * speed, kappa * speed, np.arctan(WHEELBASE * kappa)])


class Plant:
    """The bicycle with its servo and speed controller, in ten steps to a control step."""

    def __init__(self, track: str = "ridge", speed: float = 4.0) -> None:
        self.track, self.speed = TRACKS[track], speed
        self.window = CurvatureWindow(self.track)
        self._f = bicycle.dynamics(DT / 10, False, Car()).expand().mapaccum(10)
        self._context = np.zeros(len(CONTEXT))

    def step(self, state: Array, parameters: Array, action: Array) -> Array:
        x = state[[0, 1, 2, 4, 5, 6, 3]]
        self.window.write(x[0], self._context[1:])
        throttle = action[1] if len(action) > 1 else np.clip(self.speed - state[3], -1, 1)
        u = np.array([STEERING_LIMIT * action[0], throttle])
        x = self._f(x, u, np.concatenate([parameters, self._context])).full()[:, -1]
        return np.array([x[0] % self.track.length, x[1], x[2], x[6], x[3], x[4], x[5]])

    def touches(self, state: Array, parameters: Array) -> bool:
        """Whether the car, a rectangle, touches the round obstacle."""
        s, e, radius = parameters[6:]
        centre, there = self.track.point(state[0], state[1]), self.track.point(s, e)
        heading = float(self.track.heading(state[0])) + state[2]
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        beyond = np.maximum(np.abs(turn @ (there - centre) - [0.055, 0.0]) - [0.45, 0.252], 0.0)
        return bool(radius > 0 and np.hypot(*beyond) < radius)

    def leaves(self, state: Array) -> bool:
        sin, cos = np.sin(state[2]), np.cos(state[2])
        corners = [state[1] + a * sin + b * cos for a in (NOSE, -0.395) for b in (0.252, -0.252)]
        return bool(np.max(np.abs(corners)) > self.track.half_width)

    def drive(self, driver: RallyCarExpert, state: Array, parameters: Array, steps: int) -> tuple[bool, Array, Array]:
        """Whether all went well, the states and the actions; the expert starts cold."""
        driver.reset()
        states, actions, good = [state], [], True
        for _ in range(steps):
            actions.append(driver.action(state, parameters))
            state = self.step(state, parameters, actions[-1])
            states.append(state)
            good &= not (self.touches(state, parameters) or self.leaves(state))
        return good, np.array(states), np.array(actions)


# --- the bicycle


@pytest.mark.parametrize("steering_only", [True, False])
def test_derivatives_are_those_of_finite_differences(steering_only: bool) -> None:
    f = bicycle.dynamics(DT, steering_only, Car())
    x, u, p = f.mx_in()
    jacobian = ca.Function("J", [x, u, p], [ca.jacobian(f(x, u, p), ca.vertcat(x, u))])
    rng, nx = stream(0, "bicycle"), f.size1_in(0)
    parameters = solver_parameters(curvature=0.2, bend_0=0.03, bend_2=-0.05)
    for _ in range(5):
        point = rng.uniform(-1, 1, nx + f.size1_in(1)) * 0.3
        point[0] = 2.7
        if not steering_only:
            point[6] += 4.0
        exact = jacobian(point[:nx], point[nx:], parameters).full()
        for i, step in enumerate(1e-6 * np.eye(len(point))):
            ends = [f(z[:nx], z[nx:], parameters).full().ravel() for z in (point + step, point - step)]
            np.testing.assert_allclose(exact[:, i], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("speed", [0.05, 0.5])
def test_slow_cornering_is_that_of_the_kinematic_bicycle(speed: float) -> None:
    """Without slip the rear axle does not move sideways, and v_x tan(delta) / (l_f + l_r) is the yaw rate."""
    f, delta, x = bicycle.dynamics(DT, True, Car()), 0.2, np.zeros(5)
    for _ in range(40):
        x = f(x, [delta], solver_parameters(speed)).full().ravel()
    assert x[4] == pytest.approx(speed * np.tan(delta) / WHEELBASE, rel=0.02)
    assert x[3] == pytest.approx(L_R * x[4], rel=0.05)


def test_lateral_acceleration_is_limited_by_friction() -> None:
    f = bicycle.dynamics(0.005, True, Car())
    for friction in (1.0, 0.3):
        x = np.zeros(5)
        for _ in range(400):
            x = f(x, [0.35], solver_parameters(6.0, friction=friction)).full().ravel()
        acceleration = 6.0 * x[4]
        assert 0.85 * friction * GRAVITY < acceleration <= 1.001 * friction * GRAVITY


def test_linear_cornering_agrees_with_theory() -> None:
    """Small angles: r / delta = v / (l + K v^2) with the understeer gradient of linear tyres, C = N / w_0 per slip."""
    car = Car(slip_front=0.3, slip_rear=0.1)
    f, speed, delta, x = bicycle.dynamics(DT, True, car), 4.0, 1e-3, np.zeros(5)
    for _ in range(200):
        x = f(x, [delta], solver_parameters(speed)).full().ravel()
    gradient = (car.slip_front - car.slip_rear) / (GRAVITY * speed)  # slip angle = w / v
    assert x[4] == pytest.approx(speed * delta / (WHEELBASE + gradient * speed**2), rel=1e-3)


def test_one_step_per_control_period_is_accurate_enough() -> None:
    """A second of slalom in steps of 0.05 s, as the expert plans, against steps of 0.5 ms."""
    coarse, fine = bicycle.dynamics(DT, False, Car()), bicycle.dynamics(DT / 100, False, Car()).expand().mapaccum(100)
    x = y = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0])
    p = solver_parameters(curvature=0.1)
    for i in range(20):
        u = np.array([0.2 * np.sin(2 * np.pi * i / 20), 0.05])
        x, y = coarse(x, u, p).full().ravel(), fine(y, u, p).full()[:, -1]
    assert np.abs(x - y)[:2].max() < 0.1


def test_bias_is_a_shift_of_the_target() -> None:
    for steering_only in (True, False):
        f = bicycle.dynamics(DT, steering_only, Car())
        x, u = np.full(f.size1_in(0), 0.1), np.full(f.size1_in(1), 0.2)
        moved = u - np.eye(len(u))[0] * 0.05
        with_bias = f(x, moved, solver_parameters(steering_bias=0.05)).full()
        np.testing.assert_allclose(with_bias, f(x, u, solver_parameters()).full(), rtol=1e-12)


def test_obstacle_and_borders_cost_nothing_at_a_distance() -> None:
    stage, _ = bicycle.residuals(DT, True, 1.5, Car())
    x = np.array([0.0, 0.3, 0.1, 0.0, 0.0])
    free = float(ca.sumsqr(stage(x, [0.1], solver_parameters())))
    course = bicycle.WEIGHT_OFFSET * 0.09 + bicycle.WEIGHT_COURSE * 0.01 + bicycle.WEIGHT_STEERING * 0.01
    assert free == pytest.approx(course)
    for s, e, near in ((2.0, 0.0, False), (0.9, 0.3, True), (0.0, 1.5, False), (0.3, -0.4, True)):
        p = solver_parameters(obstacle_s=s, obstacle_e=e, obstacle_radius=0.3)
        assert (float(ca.sumsqr(stage(x, [0.1], p))) > free + 1e-9) == near
    border = 1.5 - Car().circle_radius - bicycle.BORDER_MARGIN
    for e_y, near in ((border - 0.05, False), (border + 0.05, True), (-border - 0.05, True)):
        over = float(ca.sumsqr(stage([0.0, e_y, 0.0, 0.0, 0.0], [0.0], solver_parameters()))) - e_y**2
        assert (over > 1e-6) == near


def test_circles_cover_the_car() -> None:
    car = Car()
    for x in np.linspace(-0.395, NOSE, 50):
        assert min(np.hypot(x - centre, 0.252) for centre in car.circles) <= car.circle_radius + 1e-9


# --- the window of curvature


@pytest.mark.parametrize("name", TRACKS)
def test_window_shows_the_curvature_ahead(name: str) -> None:
    track, window = TRACKS[name], CurvatureWindow(TRACKS[name])
    out = np.zeros(3 + KNOTS)
    p = ca.MX.sym("p", len(CONTEXT))
    s = ca.MX.sym("s")
    shown = ca.Function("kappa", [s, p], [bicycle.curvature(s, dict(zip(CONTEXT, ca.vertsplit(p), strict=True)))])
    reach = (KNOTS - 2) * window.spacing
    for start in np.linspace(-5.0, 3.0 * track.length, 23):  # laps are counted on
        window.write(start, out)
        ahead = start + np.linspace(0.0, reach, 200)
        values = np.array([float(shown(at, np.concatenate([[4.0], out]))) for at in ahead])
        np.testing.assert_allclose(values, window.curvature(ahead), atol=1e-9)
        np.testing.assert_allclose(values, track.curvature(ahead), atol=0.03)
        beyond = [float(shown(start + reach + more, np.concatenate([[4.0], out]))) for more in (2.0, 20.0)]
        assert beyond[0] == pytest.approx(beyond[1], abs=1e-9)


def test_the_curvature_of_a_place_does_not_depend_on_the_window() -> None:
    window, reach = CurvatureWindow(TRACKS["ridge"]), 40 * DT * 5.0
    assert reach < (KNOTS - 2) * window.spacing  # a plan at 5 m/s does not see the end of the window
    first, second = np.zeros(3 + KNOTS), np.zeros(3 + KNOTS)
    window.write(10.0, first)
    window.write(10.0 + window.spacing, second)
    assert second[1] == first[1] + window.spacing and first[1] <= 10.0 < first[1] + window.spacing


# --- the expert


def test_parameters_are_those_of_the_task() -> None:
    from safeswitch.tasks.rally_car import RallyCarEnv

    assert RallyCarEnv.parameter_names == PARAMETERS


def test_satisfies_the_protocol() -> None:
    assert isinstance(expert(), Expert)


def test_small_deviations_are_answered_with_the_lqr_gain(fresh: RallyCarExpert) -> None:
    """On a straight and empty track the solution is the LQR's, up to the end of the horizon."""
    from scipy.linalg import solve_discrete_are

    problem, p = fresh.mpc.solver.problem, solver_parameters()
    x, u = ca.MX.sym("x", 5), ca.MX.sym("u")
    f, r = problem.dynamics(x, u, p), problem.residual(x, u, p)
    jacobians = ca.Function("J", [x, u], [ca.jacobian(f, x), ca.jacobian(f, u), ca.jacobian(r, x), ca.jacobian(r, u)])
    A, B, rx, ru = (np.array(j)[..., 1:] if j.shape[1] == 5 else np.array(j) for j in jacobians(np.zeros(5), 0.0))
    A, B = A[1:], B[1:]  # the place along the track is free
    P = solve_discrete_are(A, B, rx.T @ rx, ru.T @ ru)
    K = -np.linalg.solve(ru.T @ ru + B.T @ P @ B, B.T @ P @ A).ravel()
    plan = fresh.mpc.solver.solve(np.zeros(5), p)
    np.testing.assert_allclose(plan.K[0, 0, 1:], K, rtol=0.02, atol=1e-3)
    assert np.abs(np.linalg.eigvals(A + B @ K[None])).max() < 1.0
    small = np.array([0.0, 0.01, -0.01, 0.005, 0.02])
    moved = fresh.mpc.solver.solve(small, p)
    np.testing.assert_allclose(moved.u[0, 0], K @ small[1:], rtol=0.03, atol=1e-4)


@pytest.mark.parametrize("friction", [1.0, 0.4])
@pytest.mark.parametrize("obstacle_e", [0.3, -0.1, None])
def test_a_mirrored_world_gives_the_mirrored_plan(friction: float, obstacle_e: float | None) -> None:
    solver = expert().mpc.solver
    state = np.array([0.0, 0.2, -0.1, 0.1, 0.5])
    p = solver_parameters(curvature=0.1, bend_1=0.02, bend_3=-0.04, friction=friction, steering_bias=0.03)
    if obstacle_e is not None:
        p[6:9] = 3.0, obstacle_e, 0.3
    mirrored = p.copy()
    mirrored[[PARAMETERS.index("steering_bias"), PARAMETERS.index("obstacle_e")]] *= -1
    mirrored[len(PARAMETERS) + CONTEXT.index("first_curvature") :] *= -1
    flip = np.array([1.0, -1.0, -1.0, -1.0, -1.0])
    plan = solver.solve(state, p, np.full((40, 1), 0.1), iterations=30)
    other = solver.solve(flip * state, mirrored, np.full((40, 1), -0.1), iterations=30)
    np.testing.assert_allclose(other.u, -plan.u, atol=1e-6)
    np.testing.assert_allclose(other.x, flip * plan.x, atol=1e-6)


def test_first_plans_go_around_an_obstacle_on_both_sides(fresh: RallyCarExpert) -> None:
    """A ball in the middle of a straight: the side is a matter of where the car is, and mirrored with it."""
    track = TRACKS["ridge"]
    s = min(track.samples(0.1), key=lambda at: np.abs(track.curvature(at + np.linspace(0, 8, 30))).max())
    sides = []
    for e_y in (0.3, -0.3):
        fresh.reset()
        fresh.action(on_line(track, s, e_y=e_y), obstacle((s + 4.0) % track.length))
        plan = fresh.mpc.plan_x
        sides.append(np.sign(plan[np.abs(plan[:, 0] - s - 4.0).argmin(), 1]))
    assert sides == [1.0, -1.0]


@pytest.mark.parametrize("name", TRACKS)
@pytest.mark.parametrize("speed", [3.0, 4.0, 5.0])
def test_keeps_to_the_middle_of_the_lane(name: str, speed: float) -> None:
    plant = Plant(name, speed)
    steps = round(plant.track.length / speed / DT)
    good, states, actions = plant.drive(expert(name), on_line(plant.track, 5.0, speed), EMPTY, steps)
    assert good and np.abs(states[:, 1]).max() < 0.05
    assert np.abs(np.diff(actions[:, 0])).max() < 0.15  # no jumps: the track bends smoothly
    assert np.abs(np.diff(states[:, 0]) % plant.track.length).sum() > 0.95 * plant.track.length


@pytest.mark.parametrize("changes", [{"friction": 0.5}, {"steering_bias": 0.08}, {"mass": 30.0}])
def test_knows_the_car_it_drives(changes: dict[str, float]) -> None:
    plant, p = Plant(), obstacle(0.0, radius=0.0, **changes)
    good, states, _ = plant.drive(expert(), on_line(plant.track, 0.0), p, 150)
    assert good and np.abs(states[20:, 1]).max() < 0.05


@pytest.mark.parametrize("name", TRACKS)
def test_drives_around_obstacles(name: str) -> None:
    """Two metres before it at 4 m/s, anywhere on the track, at any offset that leaves room; then back to the middle."""
    plant, driver = Plant(name), expert(name)
    for seed in range(12):
        rng = stream(seed, "obstacle")
        s = rng.uniform(0, plant.track.length)
        p = obstacle((s + NOSE + 2.0) % plant.track.length, rng.uniform(-1.0, 1.0))
        good, states, _ = plant.drive(driver, on_line(plant.track, s), p, 60)
        assert good, (seed, s, p)
        assert abs(states[-1, 1]) < 0.1


@pytest.mark.parametrize("obstacle_e", [0.6, -0.6])
def test_passes_where_there_is_room(obstacle_e: float) -> None:
    """On one side of the obstacle there is less than the width of the car, and the car is on that side."""
    plant = Plant()
    p = obstacle(14.0, obstacle_e)
    good, states, _ = plant.drive(expert(), on_line(plant.track, 10.0, e_y=0.5 * obstacle_e), p, 40)
    beside = states[np.abs(states[:, 0] - 14.0).argmin(), 1]
    assert good and np.sign(beside) == -np.sign(obstacle_e)


def test_an_obstacle_behind_or_off_the_track_is_ignored(fresh: RallyCarExpert) -> None:
    track = TRACKS["ridge"]
    state = on_line(track, 20.0)
    free = fresh.action(state, EMPTY)
    for s, e in ((18.0, 0.0), (19.1, 0.0), (20.0 - track.length / 2 + 1, 0.0), (24.0, 2.5)):
        fresh.reset()
        np.testing.assert_allclose(fresh.action(state, obstacle(s, e)), free, atol=1e-3)


def test_throttle_and_steering_hold_the_speed() -> None:
    plant = Plant()
    good, states, actions = plant.drive(expert(steering_only=False), on_line(plant.track, 0.0, 1.0), EMPTY, 200)
    assert good and actions.shape == (200, 2)
    assert np.abs(states[60:, 3] - 4.0).max() < 0.1 and np.abs(states[:, 1]).max() < 0.05
    p = obstacle(8.0, 0.1)
    good, _, _ = plant.drive(expert(steering_only=False), on_line(plant.track, 5.0), p, 60)
    assert good


def test_the_label_does_not_depend_on_where_the_wheels_stand(fresh: RallyCarExpert) -> None:
    """No image shows them. Nor does one show the yaw rate that goes with them: it moves the label little."""
    spread, labels, rng = [], [], stream(0, "poses")
    for _ in range(20):
        state = on_line(TRACKS["ridge"], rng.uniform(0, 68), e_y=rng.uniform(-0.5, 0.5))
        state[2] += rng.uniform(-0.15, 0.15)
        answers = []
        for turn in (-0.1, 0.0, 0.1):
            fresh.reset()
            other = state + np.array([0, 0, 0, 0, 0, 0, turn])
            answers.append(fresh.action(other, EMPTY)[0])
        assert np.ptp(answers) < 1e-9
        labels.append(answers[1])
        for turn in (-0.1, 0.1):
            fresh.reset()
            yaw = 4.0 * turn / WHEELBASE
            answers.append(fresh.action(state + np.array([0, 0, 0, 0, L_R * yaw, yaw, turn]), EMPTY)[0])
        spread.append(np.ptp(answers))
    assert np.median(spread) < 0.1 * np.ptp(labels)


def test_cold_and_warm_plans_agree_on_an_empty_track(fresh: RallyCarExpert) -> None:
    """The label of a demonstration is the label of a handover: both plans are converged."""
    plant = Plant()
    _, states, actions = plant.drive(fresh, on_line(plant.track, 30.0, e_y=0.4), EMPTY, 60)
    for state, action in zip(states[::5], actions[::5], strict=False):
        fresh.reset()
        np.testing.assert_allclose(fresh.action(state, EMPTY), action, atol=5e-3)


def test_a_cold_plan_is_a_function_of_state_and_parameters(fresh: RallyCarExpert) -> None:
    state, p = on_line(TRACKS["ridge"], 66.0), obstacle(2.0, 0.2)
    first = fresh.action(state, p)
    for lap in range(3):  # a history of other places and laps
        for s in (10.0, 30.0, 50.0 + lap):
            fresh.action(on_line(TRACKS["ridge"], s), EMPTY)
    fresh.reset()
    np.testing.assert_array_equal(fresh.action(state, p), first)
    np.testing.assert_array_equal(make_rally_car_expert().action(state, p), first)


def test_following_the_track_starts_no_new_plan(fresh: RallyCarExpert) -> None:
    """Bends and laps go by without a cold start; an obstacle that comes in sight, or another friction, makes one."""
    plant = Plant()
    _, states, _ = plant.drive(fresh, on_line(plant.track, 60.0), EMPTY, 60)
    assert states[-1, 0] < states[0, 0] and fresh.mpc.cold_starts == 1
    fresh.action(states[-1], obstacle((states[-1, 0] + 3.0) % 68.0))
    assert fresh.mpc.cold_starts == 2
    fresh.action(states[-1], obstacle((states[-1, 0] + 3.0) % 68.0, friction=0.5))
    assert fresh.mpc.cold_starts == 3


def test_non_finite_input_is_answered_from_the_last_plan(fresh: RallyCarExpert) -> None:
    state = on_line(TRACKS["ridge"], 12.0)
    fresh.action(state, EMPTY)
    plan = fresh.mpc.plan_u
    np.testing.assert_array_equal(fresh.action(np.full(7, np.nan), EMPTY), plan[1] / STEERING_LIMIT)
    np.testing.assert_array_equal(fresh.action(state, np.full(9, np.nan)), plan[2] / STEERING_LIMIT)
    assert fresh.mpc.fallbacks == 2
    fresh.reset()
    np.testing.assert_array_equal(fresh.action(np.full(7, np.inf), EMPTY), [0.0])


@pytest.mark.parametrize("steering_only", [True, False])
def test_absurd_states_get_finite_actions_within_bounds(steering_only: bool) -> None:
    driver, rng = expert(steering_only=steering_only), stream(0, "absurd")
    driver.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(80):
            state = rng.normal(size=7) * 10.0 ** rng.uniform(-2, 12, 7)
            p = obstacle(*rng.normal(size=2) * 10.0 ** rng.uniform(-2, 8, 2)) * 10.0 ** rng.uniform(-3, 3, 9)
            p[5] = rng.normal()
            if i % 3 == 0:
                driver.reset()
            action = driver.action(state, p)
            assert action.shape == (1 if steering_only else 2,)
            assert np.isfinite(action).all() and np.abs(action).max() <= 1.0


def test_wrong_input_is_refused(fresh: RallyCarExpert) -> None:
    with pytest.raises(ValueError, match=r"state must have shape \(7,\), got \(6,\)"):
        fresh.action(np.zeros(6), EMPTY)
    with pytest.raises(ValueError, match=r"parameters must have shape \(9,\), got \(3,\)"):
        fresh.action(np.zeros(7), np.zeros(3))
    with pytest.raises(ValueError, match=r"ridg.*ridge"):
        make_rally_car_expert("ridg")


def test_virtual_machine_gives_the_same_actions(fresh: RallyCarExpert) -> None:
    interpreted = make_rally_car_expert(compiled=False)
    state = on_line(TRACKS["ridge"], 8.0, e_y=0.2)
    for p in (EMPTY, obstacle(11.0)):
        np.testing.assert_allclose(interpreted.action(state, p), fresh.action(state, p), atol=1e-7)


def test_a_lighter_slip_is_a_stiffer_tyre() -> None:
    """The limit of no slip is the kinematic bicycle at any speed below the limit of friction."""
    f = bicycle.dynamics(DT, True, replace(Car(), slip_front=1e-3, slip_rear=1e-3))
    x = np.zeros(5)
    for _ in range(40):
        x = f(x, [0.2], solver_parameters(4.0)).full().ravel()
    assert x[4] == pytest.approx(4.0 * np.tan(0.2) / WHEELBASE, rel=0.01)


# --- the MuJoCo car


def handovers(seeds: range, every: int) -> list[bool]:
    """Outcome of a cold handover at every few steps of undisturbed episodes, driven with noise in the steering."""
    from safeswitch.handover.episode import continue_with_expert
    from safeswitch.tasks.rally_car_image import RallyCarImageEnv

    env = RallyCarImageEnv()
    driver, other, outcomes = env.make_expert(), env.make_expert(), []
    for seed in seeds:
        env.reset(seed=seed)
        driver.reset()
        rng, noise, snapshots = stream(seed, "noise"), 0.0, []
        size = rng.uniform(0.05, 0.35)
        while not env.done:
            if env.step_index % every == 0:
                snapshots.append(env.snapshot())
            noise = 0.7 * noise + np.sqrt(1 - 0.7**2) * rng.normal(scale=size)
            env.advance(np.clip(driver.action(env.state, env.parameters) + noise, -1, 1))
        for snapshot in snapshots:
            env.restore(snapshot)
            outcomes.append(continue_with_expert(env, other))
    env.close()
    return outcomes


@pytest.mark.rendering
def test_handovers_succeed() -> None:
    assert all(handovers(range(2), 20))


@pytest.mark.slow
@pytest.mark.rendering
def test_first_gate_handover_at_every_fifth_step() -> None:
    outcomes = handovers(range(200), 5)
    assert len(outcomes) == 200 * HORIZON // 5
    assert np.mean(outcomes) >= 0.995


@pytest.mark.slow
@pytest.mark.rendering
@pytest.mark.parametrize("disturbance", ["obstacle", "obstacle-held-out", "mud", "steering-bias"])
def test_drives_through_every_disturbance_of_the_physics(disturbance: str) -> None:
    from safeswitch.handover.episode import continue_with_expert
    from safeswitch.tasks.rally_car_image import RallyCarImageEnv

    for severity in (3, 5):
        env = RallyCarImageEnv(disturbance=disturbance, severity=severity)
        driver, outcomes = env.make_expert(), []
        for seed in range(20):
            env.reset(seed=seed)
            outcomes.append(continue_with_expert(env, driver))
        env.close()
        assert np.mean(outcomes) >= 0.95
