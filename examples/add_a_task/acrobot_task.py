"""An acrobot swing-up as an outsider's task: environment, disturbances, expert and the line that lists it.

`import acrobot_task` registers `Acrobot/SwingUp-v0`; `safeswitch bench --task acrobot_task:TASK` needs no more.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np

from safeswitch.suite import Cell, Task
from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.disturbances import Disturbance, offer

HERE = Path(__file__).resolve().parent
CONTROL_DT, HORIZON = 0.05, 120
SPREAD = (0.1, 0.1, 0.1, 0.1)
"""Starts are uniform within +- this of hanging to one side at rest [rad, rad, rad/s, rad/s]."""
SIDE = 1.5
"""Angle of the upper link from hanging at the start [rad]. From hanging straight down the expert would go either way,
by chance, and no learner can imitate what is not a function of the state."""
SUCCESS_ANGLE, SUCCESS_SECONDS = math.radians(20.0), 0.5
"""Both links within this angle of upright, for this long at the end."""
SPEED_BOUND = 60.0
"""Spinning faster than this [rad/s] is failure."""


@cache
def model() -> mujoco.MjModel:
    """The compiled model, shared: `TaskEnv` copies it."""
    return mujoco.MjModel.from_xml_path(str(HERE / "acrobot.xml"))


class AcrobotEnv(TaskEnv):
    """Swing two links up with a motor at the elbow. Observation (4,) float32: q1, q2 [rad], q1_dot, q2_dot [rad/s]."""

    task = "acrobot"
    parameter_names = (
        "upper_mass",
        "lower_mass",
        "upper_com",
        "lower_com",
        "upper_inertia",
        "lower_inertia",
        "length",
        "shoulder_damping",
        "elbow_damping",
        "torque_limit",
    )
    camera = "side"
    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_DT)}  # noqa: RUF012

    def __init__(self, disturbance=None, severity=3, render_mode=None, width=480, height=320):
        super().__init__(
            model(),
            arguments={
                "disturbance": disturbance,
                "severity": severity,
                "render_mode": render_mode,
                "width": width,
                "height": height,
            },
            control_dt=CONTROL_DT,
            horizon=HORIZON,
            success_steps=math.ceil(round(SUCCESS_SECONDS / CONTROL_DT, 9)),
            onset_range=(0.1, 0.6),
        )
        high = np.array([math.pi, math.pi, SPEED_BOUND, SPEED_BOUND], np.float32)
        self.observation_space = gym.spaces.Box(-high, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def make_expert(self):
        """Model-predictive expert that knows the full state and the current parameters."""
        from acrobot_expert import make_acrobot_expert

        return make_acrobot_expert(self.control_dt)

    def _draw_initial_state(self, rng):
        return np.array([math.pi - SIDE, 0.0, 0.0, 0.0]) + rng.uniform(-1, 1, 4) * SPREAD

    def _write_state(self, state):
        self.simulator.data.qpos[:], self.simulator.data.qvel[:] = state[:2], state[2:]

    def _read_state(self):
        return np.concatenate([self.simulator.data.qpos, self.simulator.data.qvel])

    def _read_parameters(self, model):
        upper, lower = model.body("upper").id, model.body("lower").id
        return np.array(
            [
                *model.body_mass[[upper, lower]],
                *model.body_ipos[[upper, lower], 2],
                *model.body_inertia[[upper, lower], 1],
                model.body_pos[lower, 2],
                *model.dof_damping,
                model.actuator_gear[0, 0],
            ]
        )

    def _judge(self):
        q1, q2, *speeds = self._read_state()
        failed = not max(map(abs, speeds)) <= SPEED_BOUND  # not a number fails too
        upright = max(abs(math.remainder(angle, math.tau)) for angle in (q1, q1 + q2)) < SUCCESS_ANGLE
        return upright and not failed, failed

    def _reward(self):
        q1, q2, *_ = self._read_state()
        return float((2 + math.cos(q1) + math.cos(q1 + q2)) / 4)  # height of the tip, 0 hanging, 1 upright

    def _observe(self, disturbance):
        observation = self._read_state()
        if disturbance is not None:
            observation = disturbance.sense(observation, self.step_index)
        observation[:2] = [math.remainder(angle, math.tau) for angle in observation[:2]]
        high = self.observation_space.high
        return np.clip(observation, -high, high).astype(np.float32)


@offer
class Payload(Disturbance):
    """Somebody hangs a weight into the lower link: at the link's middle, so that its inertia about it stays."""

    name = "acrobot-payload"
    kind = "dynamics"
    tasks = frozenset({"acrobot"})
    levels = (0.03, 0.06, 0.1, 0.15, 0.2)
    sentence = "the lower link becomes {:g} kg heavier"
    changes_inertia = True

    def alter(self, nominal, model):
        """Add the mass."""
        lower = nominal.body("lower").id
        model.body_mass[lower] = nominal.body_mass[lower] + self.value


@offer
class WornMotor(Disturbance):
    """The motor pulls harder than it should."""

    name = "acrobot-motor"
    kind = "actuation"
    tasks = frozenset({"acrobot"})
    levels = (1.2, 1.4, 1.7, 2.0, 2.5)
    sentence = "the torque of a given action is multiplied by {:g}"

    def alter(self, nominal, model):
        """Scale the gear."""
        model.actuator_gear[0] = self.value * nominal.actuator_gear[0]


@offer
class Recoloured(Disturbance):
    """The links change colour. Benign: nobody looks."""

    name = "acrobot-colour"
    kind = "appearance"
    benign = True
    tasks = frozenset({"acrobot"})
    levels = (0.2, 0.4, 0.6, 0.8, 1.0)
    sentence = "the links are mixed with a share of {:g} of green"

    def alter(self, nominal, model):
        """Mix the colour."""
        for name in ("upper", "lower"):
            geom = nominal.geom(name).id
            model.geom_rgba[geom, 1] = (1 - self.value) * nominal.geom_rgba[geom, 1] + self.value


ENV_ID = "Acrobot/SwingUp-v0"
if ENV_ID not in gym.registry:
    gym.register(id=ENV_ID, entry_point="acrobot_task:AcrobotEnv")

TASK = Task(
    name="acrobot",
    env_id=f"acrobot_task:{ENV_ID}",  # the module in front: worker processes import it
    learner="bayesian-mlp",
    learner_options={"angles": (0, 1), "epochs": 100, "dropout": 0.0, "last_dropout": 0.1},
    dataset="acrobot/expert-v0",
    demonstrations={
        "episodes": 300,
        "noise": {"low": 0.02, "high": 0.1, "correlated_fraction": 0.5, "correlation": 0.7},
    },
    signals=("epistemic", "aleatoric", "total", "total-mean3"),
    cells=(
        Cell("acrobot", "acrobot-payload", 3, "paper"),  # the cell of the headline
        Cell("acrobot", "none", 0, "none"),
        Cell("acrobot", "acrobot-colour", 3, "benign"),
        Cell("acrobot", "acrobot-motor", 3, "other"),
    ),
    modules=("acrobot_task", "acrobot_expert"),
    assets=(str(HERE / "acrobot.xml"),),
)
"""What the suite needs to know. Free parameters are chosen on the `design` split, before any rule runs."""
