"""Rally car: a 1/5-scale car on a closed dirt track, driven by steering and throttle from its curvilinear state.

The source paper's second system (Lee, Saigol, Theodorou, https://arxiv.org/abs/1803.10231) is AutoRally, whose
dimensions and masses the car has (assets/README.md). The disturbance is an obstacle on the track that training never
showed. The car with images is in `safeswitch.tasks.rally_car_image`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.protocols import Expert
from safeswitch.tasks import course
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.car_geometry import (
    FOOTPRINT,
    FRONT,
    GAUGE,
    REACH,
    REAR,
    TYRE_RADIUS,
    WHEELS,
    bicycle_angle,
    corners,
    front_angles,
    settle,
    whole_car,
    yaw_of,
)
from safeswitch.tasks.disturbances import Disturbance
from safeswitch.tasks.placing import Placing
from safeswitch.tasks.rally_car_config import CONTROL_DT, RallyCarConfig
from safeswitch.tasks.rally_disturbances import Placed, RallyDisturbance
from safeswitch.tasks.sight import Sight
from safeswitch.tasks.track import Track
from safeswitch.tasks.track import track as find_track

Array = NDArray[np.float64]

STEERING_LIMIT = 0.40
"""Steering angle at action 1 [rad], of the bicycle that turns like the car."""
NEAR = 1.5
"""Within this distance of an obstacle [m], contacts are looked for at every simulator step."""
LOWEST_UPRIGHT = 0.5
"""The car has turned over when its vertical axis is tilted by more than 60 degrees."""
PREVIEW = (0.0, 1.0, 2.0, 3.5, 5.0)
"""Distances ahead at which the curvature is observed [m]."""


class RallyCarEnv(TaskEnv):
    """Keep the whole car on the track, touch nothing, and make progress.

    ## Observation: `Box(12,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | s, arc length of the centre of mass along the centreline | m | 0, length of the track |
    | 1 | e_y, its lateral offset, positive to the left | m | +-3 |
    | 2 | e_psi, heading relative to the track | rad | +-pi, wrapped |
    | 3 | v_x, velocity ahead | m/s | +-15 |
    | 4 | v_y, velocity to the left | m/s | +-15 |
    | 5 | yaw rate, positive to the left | rad/s | +-15 |
    | 6 | delta, steering angle | rad | +-0.6 |
    | 7-11 | curvature of the track 0, 1, 2, 3.5 and 5 m ahead, positive to the left | 1/m | +-1 |

    Values beyond the bounds are clipped. An obstacle is not observed.

    ## Action: `Box(2,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | steering angle of the front wheels (of the bicycle that turns like the car) | 0.40 rad | +-1, clipped |
    | 1 | throttle: the same torque on all four wheels, 101 N in all at 1; negative brakes | 2.4 N m | +-1, clipped |

    An action of the wrong shape, or not finite, raises ValueError.

    ## Reward

    `v_x cos(e_psi) / speed`, clipped to [0, 1]: progress. The benchmark scores success and autonomy, not this reward.

    ## Start, end, success

    The car starts anywhere along the lap, near the middle (+-0.25 m, +-0.1 rad), at about 4 m/s with settled suspension
    and turning wheels. The episode *terminates*, a failure, when any part of the car leaves the track (3 m wide), when
    it touches an obstacle, or when it turns over. It is *truncated* after T = 100 steps of 0.05 s, a success.

    ## Info (the same keys at reset and at every step)

    | key | type | meaning |
    |---|---|---|
    | `state` | float64 (7,) | [s, e_y, e_psi, v_x, v_y, yaw_rate, delta], undisturbed |
    | `parameters` | float64 (9,) | `parameter_names`, as they are now: see below |
    | `is_success` | bool | the success criterion, evaluated now |
    | `disturbed` | bool | whether the onset has passed |
    | `step` | int | control steps executed |
    | `onset` | int | t0, -1 in an undisturbed episode, T until a placed disturbance comes into view |

    Parameters: mass [kg] and yaw_inertia [kg m^2] of the whole car, l_f and l_r from its centre of mass to the axles
    [m], friction of the ground under the wheels (mean), steering_bias [rad], and of an obstacle obstacle_s and
    obstacle_e (curvilinear) and obstacle_radius of a circle that covers it [m]; all 0 until it is in view.

    ## Arguments

    * `disturbance`: None or one of obstacle, obstacle-held-out, mud, steering-bias, localisation-bias, puddle-paint
      (benign), roadside (benign).
    * `severity`: 1 .. 5.
    * `track`: `"ridge"` or `"hollow"`, which is held out for transfer.
    * `render_mode`: None or `"rgb_array"`; `width`, `height`: of the picture [pixel].
    * any number of `RallyCarConfig` by its name, for example `horizon=680` (two laps).
    """

    task = "rally-car"
    parameter_names = (
        "mass",
        "yaw_inertia",
        "l_f",
        "l_r",
        "friction",
        "steering_bias",
        "obstacle_s",
        "obstacle_e",
        "obstacle_radius",
    )
    camera = "chase"
    steering_only: ClassVar[bool] = False
    defaults: ClassVar[Mapping[str, float]] = MappingProxyType({})
    """Numbers of `RallyCarConfig` in which a task differs from it."""
    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / CONTROL_DT)}  # noqa: RUF012

    def __init__(
        self,
        disturbance: str | None = None,
        severity: int = 3,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 320,
        track: str = "ridge",
        **design: float,
    ) -> None:
        """See the class docstring."""
        self.config = RallyCarConfig.of(**{**self.defaults, **design})
        self.track: Track = find_track(track)
        self._touched = False
        super().__init__(
            course.rally_car(self.track, self.config.timestep, 1 if self.steering_only else 2),
            arguments={
                "disturbance": disturbance,
                "severity": severity,
                "render_mode": render_mode,
                "width": width,
                "height": height,
                "track": track,
                **design,
            },
            control_dt=self.config.control_dt,
            horizon=int(self.config.horizon),
            success_steps=int(self.config.horizon) + 1,  # every state, that of the reset included
            onset_range=(self.config.onset_low, self.config.onset_high),
        )
        model, data = self.simulator.nominal, self.simulator.data
        self._qpos, self._qvel, self._ctrl = data.qpos, data.qvel, data.ctrl
        self._steer_qpos = [int(model.joint(f"steer_{name}").qposadr[0]) for name in WHEELS[:2]]
        self._spin_qvel = [int(model.joint(f"spin_{name}").dofadr[0]) for name in WHEELS]
        self._tyres = [model.geom(f"tyre_{name}").id for name in WHEELS]
        self._ground = model.geom("ground").id
        self._settled = settle(model)
        self._sight: Sight | None = None
        high = np.array([self.track.length, 3.0, math.pi, 15.0, 15.0, 15.0, 0.6, *[1.0] * len(PREVIEW)], np.float32)
        low = -high
        low[0] = 0.0
        self._low, self._high = low.astype(np.float64), high.astype(np.float64)
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, self.simulator.action_shape, np.float32)

    def make_expert(self) -> Expert:
        """Model-predictive expert that knows the full state and the current parameters."""
        from safeswitch.expert.rally_car_model import make_rally_car_expert

        return make_rally_car_expert(
            track_name=self.track.name,
            steering_only=self.steering_only,
            control_dt=self.config.control_dt,
            speed=self.config.speed,
        )

    # --------------------------------------------------------------------------------------------------------- state

    def _draw_initial_state(self, rng: np.random.Generator) -> Array:
        """On the way round the bend already: yaw rate and steering are those of the track's curvature."""
        c = self.config
        s = rng.uniform(0.0, self.track.length)
        e_y, e_psi, faster = rng.uniform(-1.0, 1.0, 3) * (c.spread_e_y, c.spread_e_psi, c.spread_speed)
        v_x = c.speed + faster
        yaw_rate = v_x * float(self.track.curvature(s))
        delta = math.atan((FRONT + REAR) * yaw_rate / v_x)
        return np.array([s, e_y, e_psi, v_x, REAR * yaw_rate, yaw_rate, delta])

    def _write_state(self, state: Array) -> None:
        s, e_y, e_psi, v_x, v_y, yaw_rate, delta = state.tolist()
        yaw = float(self.track.heading(s)) + e_psi
        cos, sin = math.cos(yaw), math.sin(yaw)
        self._qpos[:] = self._settled
        self._qpos[:2] = self.track.point(s, e_y)
        turn = np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
        mujoco.mju_mulQuat(self._qpos[3:7], turn, self._settled[3:7])
        self._qvel[:] = 0.0
        self._qvel[:2] = cos * v_x - sin * v_y, sin * v_x + cos * v_y
        self._qvel[5] = yaw_rate
        self._qpos[self._steer_qpos] = front_angles(delta)
        for dof, left, ahead in zip(self._spin_qvel, (1, -1, 1, -1), (FRONT, FRONT, -REAR, -REAR), strict=True):
            along, across = v_x - yaw_rate * left * 0.5 * GAUGE, v_y + yaw_rate * ahead
            angle = delta if ahead > 0 else 0.0
            self._qvel[dof] = (along * math.cos(angle) + across * math.sin(angle)) / TYRE_RADIUS
        self._touched = False

    def _read_state(self) -> Array:
        qpos, qvel = self._qpos.tolist(), self._qvel.tolist()
        yaw = yaw_of(qpos)
        cos, sin = math.cos(yaw), math.sin(yaw)
        s, e_y = self.track.project(qpos[0], qpos[1])
        e_psi = math.remainder(yaw - self.track.heading_at(s), math.tau)
        left, right = (qpos[index] for index in self._steer_qpos)
        return np.array(
            [
                s,
                e_y,
                e_psi,
                cos * qvel[0] + sin * qvel[1],
                cos * qvel[1] - sin * qvel[0],
                qvel[5],
                bicycle_angle(left, right),
            ]
        )

    def _read_parameters(self, model: mujoco.MjModel) -> Array:
        bias, obstacle = 0.0, (0.0, 0.0, 0.0)
        if model is self.simulator.disturbed and isinstance(self.disturbance, RallyDisturbance):
            bias, obstacle = self.disturbance.steering_bias, self.disturbance.obstacle
        mass, inertia, front, rear = whole_car(self.simulator.nominal)
        friction = self.simulator.nominal.geom(f"tyre_{WHEELS[0]}").friction[0]
        return np.array([mass, inertia, front, rear, friction, bias, *obstacle])

    @property
    def parameters(self) -> Array:
        """Model parameters (np,) as they are now: see the class docstring."""
        parameters = super().parameters
        grip = self._grip()
        if grip is not None:
            parameters[4] *= grip.mean()
        return parameters

    # ------------------------------------------------------------------------------------------------------- physics

    def _actuator(self) -> Callable[[Array], None]:
        return self._actuate

    def _actuate(self, action: Array) -> None:
        """Write steering targets, motor commands and the friction under the tyres for the coming control step."""
        angle = STEERING_LIMIT * float(action[0])
        if self.disturbed and isinstance(self.disturbance, RallyDisturbance):
            angle += self.disturbance.steering_bias
        self._ctrl[:2] = front_angles(angle)
        self._ctrl[2:] = self._throttle(action)
        grip = self._grip()
        if grip is not None:
            model, nominal = self.simulator.disturbed, self.simulator.nominal
            model.geom_friction[self._tyres, 0] = grip * nominal.geom_friction[self._tyres, 0]

    def _throttle(self, action: Array) -> float:
        """Motor command in [-1, 1], the same for all four wheels."""
        return float(action[1])

    def _grip(self) -> Array | None:
        """Factors (4,) of the friction under the tyres; None where the ground is as ever."""
        if not (isinstance(self.disturbance, Placed) and self.disturbance.slippery):
            return None
        x, y, *_ = self._qpos
        return self.disturbance.grip(corners(x, y, yaw_of(self._qpos), (-REAR, FRONT, 0.5 * GAUGE)))

    def distance_ahead(self) -> float:
        """From the front bumper to the middle of what is placed, along the track [m]; negative behind it."""
        if not isinstance(self.disturbance, Placed):
            return math.nan
        s, _ = self.track.project(float(self._qpos[0]), float(self._qpos[1]))
        return math.remainder(self.disturbance.s - s, self.track.length) - FOOTPRINT[1]

    def _watcher(self) -> Callable[[], None] | None:
        self._touched = False
        placed = self.disturbance
        if not (isinstance(placed, Placed) and placed.obstacle[2]):
            return None
        x, y = placed.position[:2]
        return self._watch if math.hypot(self._qpos[0] - x, self._qpos[1] - y) < NEAR + placed.obstacle[2] else None

    def _watch(self) -> None:
        """Remember whether an obstacle is touched: the ground is touched by the four tyres, and by nothing else."""
        data = self.simulator.data
        self._touched = self._touched or any(
            self._ground not in pair for pair in data.contact.geom[: data.ncon].tolist()
        )

    def _judge(self) -> tuple[bool, bool]:
        failed = self._touched or not self._on_track()
        return not failed, failed

    def _on_track(self) -> bool:
        """Whether the car stands upright with its whole footprint between the edges."""
        x, y, _, _, roll, pitch, _ = self._qpos[:7].tolist()
        if not 1.0 - 2.0 * (roll * roll + pitch * pitch) > LOWEST_UPRIGHT:  # NaN fails too
            return False
        s, e_y = self.track.project(x, y)
        if abs(e_y) + REACH < self.track.half_width:
            return True
        outline = corners(x, y, yaw_of(self._qpos), FOOTPRINT).tolist()
        return all(abs(self.track.project(ahead, left, near=s)[1]) <= self.track.half_width for ahead, left in outline)

    def _reward(self) -> float:
        state = self._read_state()
        return min(max(state[3] * math.cos(state[2]) / self.config.speed, 0.0), 1.0)

    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        state = self._read_state()
        if disturbance is not None:
            state = disturbance.sense(state, self._step_index)
        ahead = self.track.curvature(state[0] + np.array(PREVIEW))
        observation = np.concatenate([state, ahead])
        np.clip(observation, self._low, self._high, out=observation)
        return observation.astype(np.float32)

    # ------------------------------------------------------------------------------------------- placed disturbances

    def _place(self, disturbance: Disturbance, rng: np.random.Generator) -> None:
        if isinstance(disturbance, Placed):
            placing = Placing(self.simulator.nominal, self.track, self._eye_of())
            placing(disturbance, self._qpos, self.config.speed * self.control_dt, rng)

    def _sees(self, disturbance: Disturbance) -> bool:
        assert isinstance(disturbance, Placed)
        return self._eye_of().sees(self._qpos[:3], self._qpos[3:7], disturbance.points)

    def _eye_of(self) -> Sight:
        if self._sight is None:
            self._sight = Sight(self.simulator.nominal, "onboard", aspect=2.0)
        return self._sight
