"""Cart-pole: swing a pole up from hanging and balance it, on a rail with two ends.

The source paper's first task (Lee, Saigol, Theodorou, https://arxiv.org/abs/1803.10231): the cart's mass drops from
1.0 kg to 0.2 kg at a random step (`disturbance="cart-mass"`, severity 3). Time step, force and rail were chosen on the
design split, such that the drop defeats a learner and not the expert, and were then frozen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.names import unknown
from safeswitch.protocols import Expert
from safeswitch.tasks import models
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.disturbances import Disturbance

Array = NDArray[np.float64]

CONTROL_DT = 0.06
"""Control period [s]. At 0.04 s and below, the gains of a good learner stay stable on the lighter cart."""
TIMESTEP = 0.02
"""Time step of the simulation [s], RK4."""
HORIZON = 80
"""T, control steps of an episode. With onsets on 10-60 % of it, half of the disturbances meet the swing-up."""
RAIL = 1.5
"""Half the length of the rail [m]; leaving it ends the episode."""
FORCE_LIMIT = 6.0
"""Force on the cart at action 1 [N]: the swing-up needs two swings and takes 2.3 s."""
CART_MASS = 1.0
"""[kg], of the paper."""
POLE_MASS = 0.1
"""[kg], a small ball on a massless rod."""
POLE_LENGTH = 0.5
"""From the hinge to the centre of mass [m]."""
BOB_RADIUS = 0.05
"""[m]"""
POLE_INERTIA = 0.4 * POLE_MASS * BOB_RADIUS**2
"""About the centre of mass [kg m^2]: a solid ball, 2/5 m r^2."""
CART_DAMPING = 0.05
"""Viscous friction of the rail [N s/m]."""
POLE_DAMPING = 0.001
"""Viscous friction of the hinge [N m s/rad]."""
INITIAL_X = 0.5
"""Starts are about here [m], beside the middle: from the middle, left and right are equally good ways to swing up, and
the demonstrations would say two things about one state."""
INITIAL_SPREAD = (0.2, 0.1, 0.1, 0.1)
"""Starts are uniform within +- this of (INITIAL_X, 0 m/s, pi rad, 0 rad/s)."""
ONSET_RANGE = (0.1, 0.6)
"""The onset of a disturbance is uniform between these shares of the episode."""

SUCCESS_ANGLE = math.radians(12.0)
"""The pole counts as upright within this angle [rad]."""
SUCCESS_SECONDS = 1.0
"""For how long it has to be upright, on the rail, at the end [s]."""

VELOCITY_BOUND = 30.0
"""Of the observation [m/s]: twice the speed of the lightest cart pushed along the whole rail."""
SPIN_BOUND = 60.0
"""Of the observation [rad/s]."""


@dataclass(frozen=True)
class CartPoleConfig:
    """Every number of the task. ``gym.make(id, force_limit=8.0)`` overrides one; plain numbers, so specs stay JSON.

    Attributes:
        control_dt: control period [s], a multiple of `timestep`.
        timestep: time step of the simulation [s].
        horizon: T, control steps of an episode.
        rail: half the length of the rail [m].
        force_limit: force on the cart at action 1 [N].
        cart_mass: [kg].
        pole_mass: [kg].
        pole_length: from the hinge to the pole's centre of mass [m].
        pole_inertia: of the pole about its centre of mass [kg m^2].
        cart_damping: viscous friction of the rail [N s/m].
        pole_damping: viscous friction of the hinge [N m s/rad].
        initial_x: starts are about here [m].
        spread_x: starts are uniform in initial_x +- this [m].
        spread_x_dot: starts are uniform in 0 +- this [m/s].
        spread_theta: starts are uniform in pi +- this [rad].
        spread_theta_dot: starts are uniform in 0 +- this [rad/s].
        onset_low: earliest onset as a share of the episode.
        onset_high: latest onset as a share of the episode.
    """

    control_dt: float = CONTROL_DT
    timestep: float = TIMESTEP
    horizon: int = HORIZON
    rail: float = RAIL
    force_limit: float = FORCE_LIMIT
    cart_mass: float = CART_MASS
    pole_mass: float = POLE_MASS
    pole_length: float = POLE_LENGTH
    pole_inertia: float = POLE_INERTIA
    cart_damping: float = CART_DAMPING
    pole_damping: float = POLE_DAMPING
    initial_x: float = INITIAL_X
    spread_x: float = INITIAL_SPREAD[0]
    spread_x_dot: float = INITIAL_SPREAD[1]
    spread_theta: float = INITIAL_SPREAD[2]
    spread_theta_dot: float = INITIAL_SPREAD[3]
    onset_low: float = ONSET_RANGE[0]
    onset_high: float = ONSET_RANGE[1]

    def __post_init__(self) -> None:
        """Refuse numbers that make no cart-pole."""
        may_be_zero = ("cart_damping", "pole_damping", "onset_low", "onset_high")
        for name, value in asdict(self).items():
            if name == "initial_x":
                continue
            lowest = 0.0 if name in may_be_zero or name.startswith("spread") else np.nextafter(0.0, 1.0)
            if not (math.isfinite(value) and value >= lowest):
                raise ValueError(f"{name} must be finite and {'>= 0' if lowest == 0.0 else '> 0'}, got {value!r}")
        if not self.onset_low <= self.onset_high < 1.0:
            raise ValueError(f"need onset_low <= onset_high < 1, got {self.onset_low} and {self.onset_high}")
        if not abs(self.initial_x) + self.spread_x < self.rail:
            raise ValueError(f"starts must lie on the rail of +-{self.rail} m, got {self.initial_x} +- {self.spread_x}")
        if self.horizon != int(self.horizon):
            raise ValueError(f"horizon must be a number of steps, got {self.horizon!r}")

    @classmethod
    def of(cls, **design: float) -> CartPoleConfig:
        """The configuration with some numbers replaced; an unknown name lists the valid ones."""
        valid = [field.name for field in fields(cls)]
        for name in design:
            if name not in valid:
                raise unknown("argument of CartPoleEnv", name, valid)
        return cls(**design)  # type: ignore[arg-type]


class CartPoleEnv(TaskEnv):
    """Swing the pole up from hanging, and keep it upright without leaving the rail.

    `theta` is the angle of the pole from upright, positive when it leans to +x: the bob is at
    `x + l sin(theta)`, `l cos(theta)`. With cart mass M, pole mass m, length l, inertia I about the centre of mass,
    damping b and c, and force u:

        (M + m) x'' + m l cos(theta) theta'' - m l sin(theta) theta'^2 = u - b x'
        m l cos(theta) x'' + (I + m l^2) theta'' - m g l sin(theta)    = -c theta'

    ## Observation: `Box(4,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | x, position of the cart | m | +-1.5 rail (the episode ends at +-rail) |
    | 1 | x_dot, its velocity | m/s | +-30 |
    | 2 | theta, angle of the pole, 0 upright | rad | +-pi, wrapped |
    | 3 | theta_dot, its velocity | rad/s | +-60 |

    Values beyond the bounds are clipped.

    ## Action: `Box(1,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | force on the cart | force limit (6 N) | +-1, clipped |

    An action of the wrong shape, or not finite, raises ValueError.

    ## Reward

    `(1 + cos(theta)) / 2 * (1 - (x / rail)^2)`, clipped to [0, 1]: 1 for an upright pole in the middle of the rail.
    The benchmark scores success and autonomy, not this reward.

    ## Start, end, success

    The pole hangs (theta = pi +- 0.1 rad) beside the middle (x = 0.5 +- 0.2 m) almost at rest. The episode
    *terminates* when the cart leaves the rail, which is a failure, and is *truncated* after T = 80 steps of 0.06 s. It
    is a success if |theta| < 12 deg in every control step of the last second, on the rail.

    ## Info (the same keys at reset and at every step)

    | key | type | meaning |
    |---|---|---|
    | `state` | float64 (4,) | [x, x_dot, theta, theta_dot], undisturbed, theta not wrapped |
    | `parameters` | float64 (7,) | `parameter_names`, as the physics uses them now: see below |
    | `is_success` | bool | the success criterion, evaluated now |
    | `disturbed` | bool | whether the onset has passed |
    | `step` | int | control steps executed |
    | `onset` | int | t0, -1 in an undisturbed episode |

    Parameters: cart_mass M [kg], pole_mass m [kg], pole_length l [m], pole_inertia I [kg m^2], cart_damping b [N s/m],
    pole_damping c [N m s/rad], force_limit [N].

    ## Arguments

    * `disturbance`: None or one of cart-mass, pole-length, joint-friction, push, motor-gain, sensor-bias,
      sensor-noise, repaint (benign). It sets in before the observation of step t0, uniform on 10-60 % of the episode.
    * `severity`: 1 .. 5.
    * `render_mode`: None or `"rgb_array"`; `width`, `height`: of the picture [pixel].
    * any number of `CartPoleConfig` by its name, for example `force_limit=8.0`.
    """

    task = "cart-pole"
    parameter_names = (
        "cart_mass",
        "pole_mass",
        "pole_length",
        "pole_inertia",
        "cart_damping",
        "pole_damping",
        "force_limit",
    )
    camera = "side"
    defaults: ClassVar[Mapping[str, float]] = MappingProxyType({})
    """Numbers of `CartPoleConfig` in which a task differs from it."""
    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / CONTROL_DT)}  # noqa: RUF012

    def __init__(
        self,
        disturbance: str | None = None,
        severity: int = 3,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 320,
        **design: float,
    ) -> None:
        """See the class docstring."""
        self.config = CartPoleConfig.of(**{**self.defaults, **design})
        super().__init__(
            self._compiled(),
            arguments={
                "disturbance": disturbance,
                "severity": severity,
                "render_mode": render_mode,
                "width": width,
                "height": height,
                **design,
            },
            control_dt=self.config.control_dt,
            horizon=int(self.config.horizon),
            # A second begins and ends with a control step; rounding absorbs the float error of a ratio like 1 / 0.05.
            success_steps=math.ceil(round(SUCCESS_SECONDS / self.config.control_dt, 9)),
            onset_range=(self.config.onset_low, self.config.onset_high),
        )
        self._qpos, self._qvel = self.simulator.data.qpos, self.simulator.data.qvel
        high = np.array([1.5 * self.config.rail, VELOCITY_BOUND, math.pi, SPIN_BOUND], np.float32)
        self._high = high.astype(np.float64)
        self.observation_space = gym.spaces.Box(-high, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _compiled(self) -> mujoco.MjModel:
        """The model that is simulated and drawn."""
        return models.cart_pole(self.config)

    def make_expert(self) -> Expert:
        """Model-predictive expert that knows the full state and the current parameters."""
        from safeswitch.expert.cart_pole_model import make_cart_pole_expert

        return make_cart_pole_expert(control_dt=self.config.control_dt, rail=self.config.rail)

    def _draw_initial_state(self, rng: np.random.Generator) -> Array:
        c = self.config
        spread = np.array([c.spread_x, c.spread_x_dot, c.spread_theta, c.spread_theta_dot])
        return np.array([c.initial_x, 0.0, math.pi, 0.0]) + rng.uniform(-1.0, 1.0, 4) * spread

    def _write_state(self, state: Array) -> None:
        self._qpos[:] = state[[0, 2]]
        self._qvel[:] = state[[1, 3]]

    def _read_state(self) -> Array:
        (x, theta), (x_dot, theta_dot) = self._qpos.tolist(), self._qvel.tolist()
        return np.array([x, x_dot, theta, theta_dot])

    def _read_parameters(self, model: mujoco.MjModel) -> Array:
        cart, pole = model.body("cart").id, model.body("pole").id
        slide, hinge = (int(model.joint(name).dofadr[0]) for name in ("slide", "hinge"))
        motor = model.actuator("force").id
        return np.array(
            [
                model.body_mass[cart],
                model.body_mass[pole],
                model.body_ipos[pole, 2],
                model.body_inertia[pole, 1],
                model.dof_damping[slide],
                model.dof_damping[hinge],
                model.actuator_gear[motor, 0] * model.actuator_gainprm[motor, 0],
            ]
        )

    def _judge(self) -> tuple[bool, bool]:
        x, theta = self._qpos.tolist()
        failed = not abs(x) <= self.config.rail  # NaN fails too
        return not failed and abs(wrap(theta)) < SUCCESS_ANGLE, failed

    def _reward(self) -> float:
        x, theta = self._qpos.tolist()
        reward = 0.5 * (1.0 + math.cos(theta)) * (1.0 - (x / self.config.rail) ** 2)
        return min(max(reward, 0.0), 1.0)

    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        observation = self._read_state()
        if disturbance is not None:
            observation = disturbance.sense(observation, self._step_index)
        observation[2] = wrap(observation[2])
        np.clip(observation, -self._high, self._high, out=observation)
        return observation.astype(np.float32)


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi] [rad]."""
    return math.remainder(angle, math.tau)
