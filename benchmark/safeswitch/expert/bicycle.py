r"""A rally car for the expert: bicycle with saturating tyres in curvilinear coordinates, and its cost, in CasADi.

State ``[s, e_y, e_psi, v_y, r, delta, v_x]``: arc length along the track's centre line [m], offset to its left [m],
heading relative to it [rad], lateral velocity [m/s], yaw rate [rad/s], steering angle [rad] and forward velocity [m/s]
of the centre of mass. Controls: the steering target [rad] and the throttle in [-1, 1]. With axle distances l_f, l_r,
loads N_f, N_r and the lateral slip velocity w of a tyre,

.. math::
    m (\dot v_y + v_x r) &= F_f \cos\delta + F_r, \qquad m (\dot v_x - v_y r) = F_x - F_f \sin\delta, \\
    I \dot r &= l_f F_f \cos\delta - l_r F_r, \qquad \tau \dot\delta = u + b - \delta, \\
    F &= -\mu N w / \sqrt{(\mu w_0)^2 + w^2}, \quad
    w_f = (v_y + l_f r) \cos\delta - v_x \sin\delta, \quad w_r = v_y - l_r r, \\
    \dot s &= (v_x \cos e_\psi - v_y \sin e_\psi) / (1 - \kappa e_y), \quad
    \dot e_y = v_x \sin e_\psi + v_y \cos e_\psi, \quad \dot e_\psi = r - \kappa \dot s.

A tyre is linear in its slip, N / w_0, up to its limit mu N. Tyres are stiff (a time constant of hundredths of a second,
shorter at low speed), so v_y and r are stepped implicitly with the tyres' secant stiffness: stable at any speed, exact
in steady cornering, which becomes the kinematic bicycle as v_x -> 0. The expert plans in steps of a control period.

Where the speed is held by a controller of the car's own, the expert plans with the first five states
(`steering_only`): v_x is a parameter, and the wheels follow their target at once. That costs nothing in closed loop,
and the best target is then exactly independent of where the wheels stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

PARAMETERS: tuple[str, ...] = (
    "mass",  # [kg]
    "yaw_inertia",  # [kg m^2]
    "l_f",  # centre of mass to front axle [m]
    "l_r",  # centre of mass to rear axle [m]
    "friction",  # of the tyres on the ground
    "steering_bias",  # added to the steering target [rad]
    "obstacle_s",  # [m]
    "obstacle_e",  # [m], positive left
    "obstacle_radius",  # [m]; 0: no obstacle
)
"""Of the environment."""

KNOTS = 18
"""Number of curvature samples ahead; the curvature is constant beyond the last."""
KNOT_SPACING = 0.75
"""About this far apart [m]: a whole number fits into the lap."""
CONTEXT: tuple[str, ...] = ("speed", "spacing", "first_s", "first_curvature", *(f"bend_{i}" for i in range(KNOTS)))
"""What the expert adds: speed (measured, or wished when it is a control) [m/s], spacing of the curvature's knots [m], s
[m] and curvature [1/m] of the first one, and the change of the curvature's slope [1/m^2] at each."""

GRAVITY = 9.81  # [m/s^2]
STEERING_LIMIT = 0.40  # [rad]

WEIGHT_OFFSET, WEIGHT_COURSE = 1.0, 0.5  # e_y [m], course of the centre of mass along the track [rad]
WEIGHT_STEERING = 4.0  # what the target adds to the bend's own steering [rad]
WEIGHT_SPEED, WEIGHT_THROTTLE = 0.5, 0.5  # [m/s], [-1, 1]; only where the throttle is a control
WEIGHT_BORDER, WEIGHT_OBSTACLE = 1000.0, 3000.0  # squared hinges [m]
BORDER_MARGIN, OBSTACLE_MARGIN = 0.10, 0.12  # [m] beyond touching
TERMINAL = 5.0  # weight of the state's cost at the end of the horizon


@dataclass(frozen=True)
class Car:
    """What no disturbance changes, identified against the MuJoCo car (`safeswitch.expert.identification`).

    Attributes:
        slip_front: w_0 of the front tyres, the slip velocity at which linear tyres would carry their load [m/s].
        slip_rear: of the rear tyres [m/s].
        steering_lag: time constant tau of the steering servo [s].
        drive: acceleration at full throttle [m/s^2].
        circles: where two circles that cover the car have their centres, ahead of the centre of mass [m].
        circle_radius: [m].
    """

    slip_front: float = 0.045
    slip_rear: float = 0.076
    steering_lag: float = 0.05
    drive: float = 3.98
    circles: tuple[float, float] = (0.28, -0.17)
    circle_radius: float = 0.34


@dataclass(frozen=True)
class Symbols:
    """State, control and parameters of the model, and its parts by name."""

    x: ca.MX
    u: ca.MX
    p: ca.MX

    @classmethod
    def make(cls, steering_only: bool) -> Symbols:
        """Five states and one control, or seven and two."""
        nx, nu = (5, 1) if steering_only else (7, 2)
        return cls(ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("p", len(PARAMETERS) + len(CONTEXT)))

    @property
    def steering_only(self) -> bool:
        """Whether the speed is a parameter and the wheels follow at once."""
        return bool(self.x.shape[0] == 5)

    @property
    def parameters(self) -> dict[str, ca.MX]:
        """Parameters by name."""
        return dict(zip(PARAMETERS + CONTEXT, ca.vertsplit(self.p), strict=True))

    @property
    def v_x(self) -> ca.MX:
        """Forward velocity [m/s]."""
        return self.parameters["speed"] if self.steering_only else self.x[6]


def curvature(s: ca.MX, parameters: dict[str, ca.MX]) -> ca.MX:
    """Piecewise linear curvature [1/m] at s [m]: a sum of hinges."""
    ahead, value = s - parameters["first_s"], parameters["first_curvature"]
    for i in range(KNOTS):
        value += parameters[f"bend_{i}"] * ca.fmax(ahead - i * parameters["spacing"], 0)
    return value


def middle_curvature(symbols: Symbols, control_dt: float) -> ca.MX:
    """Curvature half a control step ahead [1/m]; cost and dynamics share it."""
    return curvature(symbols.x[0] + 0.5 * control_dt * symbols.v_x, symbols.parameters)


def dynamics(control_dt: float, steering_only: bool, car: Car, substeps: int = 1) -> ca.Function:
    """(x, u, p) -> x after `control_dt` [s] of constant controls, in `substeps` steps."""
    symbols = Symbols.make(steering_only)
    x, u, p = symbols.x, symbols.u, symbols.p
    step, end = _step(control_dt / substeps, steering_only, car), x
    for _ in range(substeps):
        end = step(end, u, p)
    return ca.Function("rally_car_dynamics", [x, u, p], [end], ["x", "u", "p"], ["x_next"])


def _step(h: float, steering_only: bool, car: Car) -> ca.Function:
    """(x, u, p) -> x after `h` [s]: implicit in v_y and r, midpoint for the pose."""
    symbols = Symbols.make(steering_only)
    p, v_x = symbols.parameters, symbols.v_x
    s, e_y, e_psi, v_y, r = ca.vertsplit(symbols.x)[:5]
    target = symbols.u[0] + p["steering_bias"]
    if steering_only:
        new_v_y, new_r, _ = _lateral(p, v_x, v_y, r, target, h, car)
        rest = []
    else:
        delta = symbols.x[5]
        new_delta = delta + (1 - np.exp(-h / car.steering_lag)) * (target - delta)
        new_v_y, new_r, brake = _lateral(p, v_x, v_y, r, new_delta, h, car)
        new_v_x = v_x + h * (car.drive * symbols.u[1] - brake + 0.5 * (v_y + new_v_y) * 0.5 * (r + new_r))
        rest = [new_delta, new_v_x]
        v_x = 0.5 * (v_x + new_v_x)

    kappa, v, w = middle_curvature(symbols, h), 0.5 * (v_y + new_v_y), 0.5 * (r + new_r)
    s_dot = (v_x * ca.cos(e_psi) - v * ca.sin(e_psi)) / _stretch(kappa, e_y)
    psi, e = e_psi + h / 2 * (w - kappa * s_dot), e_y + h / 2 * (v_x * ca.sin(e_psi) + v * ca.cos(e_psi))
    s_dot = (v_x * ca.cos(psi) - v * ca.sin(psi)) / _stretch(kappa, e)
    e_dot = v_x * ca.sin(psi) + v * ca.cos(psi)
    pose = [s + h * s_dot, e_y + h * e_dot, e_psi + h * (w - kappa * s_dot)]
    return ca.Function("rally_car_step", [symbols.x, symbols.u, symbols.p], [ca.vertcat(*pose, new_v_y, new_r, *rest)])


def _stretch(kappa: ca.MX, e_y: ca.MX) -> ca.MX:
    """Length of a step at the offset e_y per length along the centre line; kept away from 0, the centre of a bend."""
    return ca.fmax(1 - kappa * e_y, 0.3)


def _lateral(
    p: dict[str, ca.MX], v_x: ca.MX, v_y: ca.MX, r: ca.MX, delta: ca.MX, h: float, car: Car
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """(v_y, r, deceleration by the steered wheels) after h [s]: implicit Euler with the tyres' secant stiffness."""
    mass, inertia, l_f, l_r, mu = (p[name] for name in PARAMETERS[:5])
    cos, sin = ca.cos(delta), ca.sin(delta)
    load = mu * mass * GRAVITY / (l_f + l_r)
    w_f, w_r = (v_y + l_f * r) * cos - v_x * sin, v_y - l_r * r
    stiff_f = l_r * load / ca.sqrt((mu * car.slip_front) ** 2 + w_f**2)
    c_r = l_f * load / ca.sqrt((mu * car.slip_rear) ** 2 + w_r**2)
    push, c_f = stiff_f * cos * sin * v_x, stiff_f * cos**2
    a11, a12 = mass / h + c_f + c_r, l_f * c_f - l_r * c_r + mass * v_x
    a21, a22 = l_f * c_f - l_r * c_r, inertia / h + l_f**2 * c_f + l_r**2 * c_r
    b1, b2 = mass / h * v_y + push, inertia / h * r + l_f * push
    inverse = 1 / (a11 * a22 - a12 * a21)
    new_v_y, new_r = (a22 * b1 - a12 * b2) * inverse, (a11 * b2 - a21 * b1) * inverse
    force = stiff_f * (v_x * sin - (new_v_y + l_f * new_r) * cos)
    return new_v_y, new_r, force * sin / mass


def _state_residual(symbols: Symbols, kappa: ca.MX, half_width: float, car: Car) -> list[ca.MX]:
    """Offset, course, and hinges of two circles on the car to borders and obstacle; 0.5 |.|^2 is the cost."""
    p = symbols.parameters
    s, e_y, e_psi, v_y = ca.vertsplit(symbols.x)[:4]
    course = e_psi + v_y / ca.fmax(symbols.v_x, 1)  # of the centre of mass; a car in a bend points elsewhere
    rows = [np.sqrt(WEIGHT_OFFSET) * e_y, np.sqrt(WEIGHT_COURSE) * course]
    cos, sin = ca.cos(e_psi), ca.sin(e_psi)
    border = half_width - car.circle_radius - BORDER_MARGIN
    clear = p["obstacle_radius"] + car.circle_radius + OBSTACLE_MARGIN
    for ahead in car.circles:
        e = e_y + ahead * sin
        rows.append(np.sqrt(WEIGHT_BORDER) * ca.fmax(ca.fabs(e) - border, 0))
        along = (s + ahead * cos - p["obstacle_s"]) * _stretch(kappa, p["obstacle_e"])
        distance = ca.sqrt(along**2 + (e - p["obstacle_e"]) ** 2 + 1e-6)
        rows.append(np.sqrt(WEIGHT_OBSTACLE) * ca.fmax(clear - distance, 0))
    if not symbols.steering_only:
        rows.append(np.sqrt(WEIGHT_SPEED) * (symbols.x[6] - p["speed"]))
    return rows


def residuals(control_dt: float, steering_only: bool, half_width: float, car: Car) -> tuple[ca.Function, ca.Function]:
    """Stage residual (x, u, p) -> r and terminal residual (x, p) -> r_N.

    Steering is charged for what it adds to the bend's own, atan((l_f + l_r) kappa), not for its rate: the best target
    is then a function of the pose, which an image shows, and not of the last target.
    """
    symbols = Symbols.make(steering_only)
    x, u, p = symbols.x, symbols.u, symbols.parameters
    kappa = middle_curvature(symbols, control_dt)
    state = _state_residual(symbols, kappa, half_width, car)
    preview = kappa
    if not steering_only:  # where the car is when the wheels have followed
        preview = curvature(x[0] + (0.5 * control_dt + car.steering_lag) * symbols.v_x, p)
    bend = ca.atan((p["l_f"] + p["l_r"]) * preview)
    effort = [np.sqrt(WEIGHT_STEERING) * (u[0] + p["steering_bias"] - bend)]
    if not steering_only:
        effort.append(np.sqrt(WEIGHT_THROTTLE) * (u[1]))
    return (
        ca.Function("rally_car_residual", [x, u, symbols.p], [ca.vertcat(*state, *effort)]),
        ca.Function("rally_car_terminal", [x, symbols.p], [np.sqrt(TERMINAL) * ca.vertcat(*state)]),
    )
