"""Disturbances: what changes at the onset step t0, with a severity from 1 to 5.

A disturbance is a pure function of what it draws at reset and of the step index. It owns no other state, so that an
episode restored from a snapshot meets exactly the same disturbance. It may act in four ways:

* `alter` writes into a *second* copy of the model, which takes over at t0 (the nominal one is never touched);
* `force` is a generalised force applied during the steps from t0 on;
* `show` moves what is only seen, in the same second copy, from step to step;
* `sense` changes what is observed, not what is.

To add one, subclass `Disturbance` and decorate it with `@offer`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.names import unknown

Array = NDArray[np.float64]
Kind = Literal["dynamics", "actuation", "sensing", "appearance"]

SEVERITIES: tuple[int, ...] = (1, 2, 3, 4, 5)
CART_POLES = frozenset({"cart-pole", "cart-pole-image"})
SENSED_STATE = frozenset({"cart-pole"})


class Disturbance:
    """Base class: does nothing.

    Attributes:
        name: as written in tables and in ``gym.make(..., disturbance=name)``.
        kind: what it touches.
        benign: True if it looks new but does no harm.
        tasks: names of the tasks that offer it.
        levels: the value of severity 1 .. 5, in the unit that `sentence` states; the effect grows with severity.
        sentence: description with one placeholder for the value.
        changes_inertia: whether constants that MuJoCo derives from masses must be recomputed after `alter`.
        only_seen: whether it changes what is seen alone, so that the same state can be observed without it.
        placed: whether it stands in the world from the reset on; its onset is then the first step at which it is in
            view, and not drawn.
    """

    name: ClassVar[str]
    kind: ClassVar[Kind]
    benign: ClassVar[bool] = False
    tasks: ClassVar[frozenset[str]] = frozenset()
    levels: ClassVar[tuple[float, float, float, float, float]]
    sentence: ClassVar[str]
    changes_inertia: ClassVar[bool] = False
    only_seen: ClassVar[bool] = False
    placed: ClassVar[bool] = False

    drawn: str = ""
    """Which of its kinds this episode has; empty for a disturbance of one kind."""

    def __init__(self, severity: int) -> None:
        self.severity = check_severity(severity)
        self.value = self.levels[self.severity - 1]

    @classmethod
    def describe(cls, severity: int) -> str:
        """One sentence, with the value of this severity and its unit."""
        return cls.sentence.format(cls.levels[check_severity(severity) - 1])

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw what this episode needs: everything later is a function of this and of the step index."""

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Write the disturbed values into `model`, computed from `nominal` (called once per episode, idempotent)."""

    def force(self, elapsed: int) -> Array | None:
        """Generalised force (nv,) [N or N m] during step t0 + `elapsed`; None for none."""
        return None

    def show(self, model: mujoco.MjModel, elapsed: int) -> None:
        """Write what is seen at step t0 + `elapsed` into `model`, before it is drawn; nothing that the physics uses."""

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """What is observed at `step` instead of `observation`, before it is clipped into the observation space."""
        return observation


DISTURBANCES: dict[str, type[Disturbance]] = {}
"""Every disturbance by name."""


def offer(cls: type[Disturbance]) -> type[Disturbance]:
    """Class decorator: register a disturbance under its name."""
    DISTURBANCES[cls.name] = cls
    return cls


def offered(task: str) -> list[str]:
    """Names of the disturbances that `task` offers, in the order of their registration."""
    return [name for name, cls in DISTURBANCES.items() if task in cls.tasks]


def check_severity(severity: int) -> int:
    """`severity` as an int if it is one of 1 .. 5, else a ValueError."""
    # bool is an int and np.int64 is not: compare values, and refuse what would be truncated.
    if isinstance(severity, bool) or severity not in SEVERITIES:
        raise ValueError(f"severity must be an integer from 1 to 5, got {severity!r}")
    return int(severity)


def make_disturbance(name: str, severity: int, task: str) -> Disturbance:
    """The disturbance `name` of `task` at a severity.

    Raises:
        ValueError: `task` offers no such disturbance (the names it offers are listed, nearest first), or the severity
            is not one of 1 .. 5.
    """
    names = offered(task)
    if name not in names:
        raise unknown(f"disturbance of {task}", name, names)
    return DISTURBANCES[name](severity)


def scale_mass(nominal: mujoco.MjModel, model: mujoco.MjModel, body: str, factor: float) -> None:
    """Scale a body's mass and, since its shape stays, its inertia. Mass alone would be silently wrong."""
    index = nominal.body(body).id
    model.body_mass[index] = factor * nominal.body_mass[index]
    model.body_inertia[index] = factor * nominal.body_inertia[index]


def repaint(nominal: mujoco.MjModel, model: mujoco.MjModel, material: str, colour: Array, share: float) -> None:
    """Mix the colour of a material with a `share` of `colour` (red, green, blue)."""
    index = nominal.material(material).id
    model.mat_rgba[index, :3] = (1.0 - share) * nominal.mat_rgba[index, :3] + share * colour


# ---------------------------------------------------------------------------------------------------------- dynamics


@offer
class CartMass(Disturbance):
    """The cart loses mass at once: the paper's disturbance, 1.0 kg -> 0.2 kg at severity 3."""

    name = "cart-mass"
    kind = "dynamics"
    tasks = CART_POLES
    levels = (0.6, 0.4, 0.2, 0.15, 0.1)
    sentence = "the cart's mass is multiplied by {:g}"
    changes_inertia = True

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Scale the mass of the cart."""
        scale_mass(nominal, model, "cart", self.value)


@offer
class PoleLength(Disturbance):
    """The bob slides towards the hinge; its mass and its inertia about its own centre stay."""

    name = "pole-length"
    kind = "dynamics"
    tasks = CART_POLES
    levels = (0.8, 0.65, 0.5, 0.4, 0.3)
    sentence = "the distance from the hinge to the pole's centre of mass is multiplied by {:g}"
    changes_inertia = True

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Move the centre of mass, and shorten the rod that is drawn."""
        body = nominal.body("pole").id
        model.body_ipos[body] = self.value * nominal.body_ipos[body]
        rod, bob = nominal.geom("pole").id, nominal.geom("bob").id
        for geom in (rod, bob):
            model.geom_pos[geom] = self.value * nominal.geom_pos[geom]
        model.geom_size[rod, 1] = self.value * nominal.geom_size[rod, 1]


@offer
class JointFriction(Disturbance):
    """Both joints become sticky: viscous friction is added to the rail and, in proportion, to the hinge."""

    name = "joint-friction"
    kind = "dynamics"
    tasks = CART_POLES
    levels = (0.3, 0.6, 1.0, 1.5, 2.0)
    sentence = "viscous friction grows by {:g} N s/m on the rail and by 1/200 of that, in N m s/rad, in the hinge"
    HINGE_SHARE: ClassVar[float] = 1.0 / 200.0

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Add viscous friction to both joints."""
        for joint, added in (("slide", self.value), ("hinge", self.HINGE_SHARE * self.value)):
            dof = int(nominal.joint(joint).dofadr[0])
            model.dof_damping[dof] = nominal.dof_damping[dof] + added


@offer
class Push(Disturbance):
    """Somebody pushes the cart, to the left or to the right, for three control steps. The parameters do not change."""

    name = "push"
    kind = "dynamics"
    tasks = CART_POLES
    levels = (1.5, 3.0, 5.0, 7.5, 10.0)
    sentence = "the cart is pushed with {:g} N for three control steps"
    STEPS: ClassVar[int] = 3

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the direction."""
        sign = rng.choice((-1.0, 1.0))
        self._push = np.array([sign * self.value, 0.0])
        self._rest = np.zeros(2)

    def force(self, elapsed: int) -> Array | None:
        """The push on the slide joint [N], nothing on the hinge; zeros afterwards, to end it."""
        return self._push if 0 <= elapsed < self.STEPS else self._rest


# --------------------------------------------------------------------------------------------------------- actuation


@offer
class MotorGain(Disturbance):
    """The motor's gain jumps up: the same action makes a larger force. Recoverable, since no force is lost."""

    name = "motor-gain"
    kind = "actuation"
    tasks = CART_POLES
    levels = (1.5, 2.0, 3.0, 4.0, 5.0)
    sentence = "the force of a given action is multiplied by {:g}"

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Scale the gear of the motor."""
        motor = nominal.actuator("force").id
        model.actuator_gear[motor] = self.value * nominal.actuator_gear[motor]


# ----------------------------------------------------------------------------------------------------------- sensing


@offer
class SensorBias(Disturbance):
    """The angle sensor slips: a constant error, of random sign, in the observed theta only."""

    name = "sensor-bias"
    kind = "sensing"
    tasks = SENSED_STATE
    levels = (0.05, 0.1, 0.2, 0.3, 0.4)
    sentence = "the observed angle is off by {:g} rad"
    ANGLE: ClassVar[int] = 2

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the sign."""
        self._bias = self.value * float(rng.choice((-1.0, 1.0)))

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Add the bias to the angle."""
        observation = observation.copy()
        observation[self.ANGLE] += self._bias
        return observation


@offer
class SensorNoise(Disturbance):
    """Every sensor becomes noisy: Gaussian, white, keyed by (episode seed, step) and therefore repeatable."""

    name = "sensor-noise"
    kind = "sensing"
    tasks = SENSED_STATE
    levels = (0.02, 0.05, 0.1, 0.15, 0.2)
    sentence = "Gaussian noise of std {:g} times (0.5 m, 2 m/s, 1 rad, 4 rad/s) is added to the observation"
    SCALE: ClassVar[Array] = np.array([0.5, 2.0, 1.0, 4.0])

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the noise of every step."""
        self._noise = self.value * self.SCALE * rng.standard_normal((horizon + 1, self.SCALE.size))

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Add the noise of this step."""
        return observation + self._noise[step]


# -------------------------------------------------------------------------------------------------------- appearance


@offer
class Repaint(Disturbance):
    """Cart, pole and bob change colour. Benign: nothing moves differently."""

    name = "repaint"
    kind = "appearance"
    benign = True
    tasks = CART_POLES
    levels = (0.4, 0.6, 0.8, 0.9, 1.0)
    sentence = "the colours of cart, pole and bob are mixed with a share of {:g} of new ones"
    PALETTES: ClassVar[tuple[tuple[tuple[float, float, float], ...], ...]] = (
        ((0.20, 0.62, 0.30), (0.55, 0.20, 0.60), (0.95, 0.85, 0.15)),
        ((0.93, 0.80, 0.15), (0.10, 0.60, 0.60), (0.15, 0.20, 0.70)),
        ((0.70, 0.20, 0.45), (0.15, 0.50, 0.20), (0.10, 0.75, 0.80)),
    )
    """Each gives red, green, blue of cart, pole and bob; none is close to the nominal blue, orange and red."""

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the palette."""
        self._palette = self.PALETTES[int(rng.integers(len(self.PALETTES)))]

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Mix the colours."""
        for name, colour in zip(("cart", "pole", "bob"), self._palette, strict=True):
            repaint(nominal, model, name, np.array(colour), self.value)
