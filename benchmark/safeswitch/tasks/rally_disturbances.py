"""Disturbances of the rally car.

What is `placed` stands beside or on the track from the reset on, out of view, and sets in when the camera first sees
it; the others set in at a step that is drawn. Kinds of `obstacle-held-out` never occur in `obstacle`.
"""

from __future__ import annotations

import colorsys
import math
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.disturbances import Array, Disturbance, offer
from safeswitch.tasks.sight import surface_points
from safeswitch.tasks.track import Track

CARS = frozenset({"rally-car", "rally-car-image"})

Colour = tuple[float, float, float]


class RallyDisturbance(Disturbance):
    """Base class: what an expert may know of it, besides what it reads from the model.

    Attributes:
        steering_bias: added to the steering angle [rad].
        obstacle: (s, e_y, radius) [m] of a circle that covers it; radius 0 without one.
    """

    tasks = CARS
    steering_bias: float = 0.0
    obstacle: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def grip(self, wheels: Array) -> Array | None:
        """Factors (4,) of the friction under wheels at (4, 2) [m]; None where the ground is as ever."""
        return None


class Placed(RallyDisturbance):
    """Something that stands in the world; the task chooses where along the track.

    Attributes:
        bodies: names of the bodies that it may be.
        sight: distance before it, along the track, at which it should come into view [m]; None: any.
        lateral: its lateral offset [m].
        slippery: whether `grip` has anything to say.
    """

    placed = True
    slippery: ClassVar[bool] = False
    bodies: ClassVar[tuple[str, ...]]
    sight: float | None = None
    lateral: float = 0.0

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the body, its turn, its colour and its lateral offset."""
        self.body = self.bodies[int(rng.integers(len(self.bodies)))]
        self.drawn = self.body.partition("_")[2]
        self._turn = rng.uniform(-math.pi, math.pi)
        self._colour = self._draw_colour(rng)
        self.lateral = self._draw_lateral(rng)

    def _draw_colour(self, rng: np.random.Generator) -> Colour:
        """Red, green, blue."""
        raise NotImplementedError

    def _draw_lateral(self, rng: np.random.Generator) -> float:
        """Lateral offset [m], positive to the left."""
        raise NotImplementedError

    def place(self, model: mujoco.MjModel, track: Track, s: float) -> None:
        """Stand at arc length `s` [m] of the track."""
        self.track, self.s = track, s
        x, y = track.point(s, self.lateral)
        self.position = np.array([x, y, 0.0])
        self.heading = float(track.heading(s)) + self._turn
        turned = surface_points(model, self.body) @ _turned(self.heading).T
        self.points = self.position + turned
        radius = float(np.hypot(*turned[:, :2].T).max())
        self.obstacle = (s % track.length, self.lateral, radius)

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Put the body there, and nothing else of an earlier episode."""
        model.body_pos[:], model.body_quat[:] = nominal.body_pos, nominal.body_quat
        model.geom_rgba[:] = nominal.geom_rgba
        body = nominal.body(self.body).id
        model.body_pos[body] = self.position
        model.body_quat[body] = (math.cos(0.5 * self.heading), 0.0, 0.0, math.sin(0.5 * self.heading))
        first, count = nominal.body_geomadr[body], nominal.body_geomnum[body]
        model.geom_rgba[first : first + count] = (*self._colour, 1.0)


@offer
class Obstacle(Placed):
    """An obstacle that no training image shows stands on the track: the paper's disturbance.

    Kind, colour, turn and offset from the middle are drawn. With the severity it comes into view later and stands
    nearer to the middle. It really is there: touching it is a failure.
    """

    name = "obstacle"
    kind = "appearance"
    levels = (9.5, 8.5, 7.5, 6.8, 6.2)
    sentence = "an obstacle stands on the track, seen from about {:g} m"
    bodies: ClassVar[tuple[str, ...]] = ("obstacle_box", "obstacle_barrel", "obstacle_ball", "obstacle_slab")
    OFFSET: ClassVar[tuple[float, ...]] = (0.6, 0.45, 0.3, 0.2, 0.1)
    """Largest distance from the centreline [m], per severity."""
    COLOURS: ClassVar[tuple[Colour, ...]] = (
        (0.80, 0.10, 0.08),
        (0.10, 0.22, 0.75),
        (0.92, 0.45, 0.05),
        (0.06, 0.06, 0.07),
        (0.90, 0.78, 0.08),
        (0.08, 0.45, 0.20),
    )

    def __init__(self, severity: int) -> None:
        super().__init__(severity)
        self.sight = self.value

    def _draw_colour(self, rng: np.random.Generator) -> Colour:
        colour = np.array(self.COLOURS[int(rng.integers(len(self.COLOURS)))])
        red, green, blue = np.clip(colour * rng.uniform(0.85, 1.1), 0.0, 1.0)
        return float(red), float(green), float(blue)

    def _draw_lateral(self, rng: np.random.Generator) -> float:
        largest = self.OFFSET[self.severity - 1]
        return float(rng.uniform(-largest, largest))


@offer
class ObstacleHeldOut(Obstacle):
    """The same with shapes and colours that `obstacle` does not have: for tests only."""

    name = "obstacle-held-out"
    bodies = ("obstacle_rock", "obstacle_pillar")
    COLOURS = ((0.93, 0.93, 0.91), (0.47, 0.33, 0.20), (0.55, 0.55, 0.55))


@offer
class Mud(Placed):
    """A wet patch across the track. It looks dark, and the tyres slip on it."""

    name = "mud"
    kind = "dynamics"
    slippery = True
    levels = (0.6, 0.45, 0.3, 0.22, 0.15)
    sentence = "friction is multiplied by {:g} on a dark, wet patch of the track, 3 m long"
    bodies = ("patch_round",)
    RADII: ClassVar[tuple[float, float]] = (1.5, 1.2)

    def _draw_colour(self, rng: np.random.Generator) -> Colour:
        return 0.22, 0.15, 0.10

    def _draw_lateral(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(-0.2, 0.2))

    def place(self, model: mujoco.MjModel, track: Track, s: float) -> None:
        """Cover the track; nothing to steer around."""
        super().place(model, track, s)
        self.obstacle = (0.0, 0.0, 0.0)
        body = model.body(self.body)
        geoms = range(int(body.geomadr[0]), int(body.geomadr[0]) + int(body.geomnum[0]))
        self._centres = (model.geom_pos[geoms] @ _turned(self.heading).T + self.position)[:, :2]
        self._radii = model.geom_size[geoms, 0]

    def grip(self, wheels: Array) -> Array | None:
        """Low on any of the discs that the patch is drawn with."""
        distance = np.hypot(*(wheels[:, None] - self._centres).transpose(2, 0, 1))
        return np.where((distance < self._radii).any(1), self.value, 1.0)


@offer
class PuddlePaint(Placed):
    """A patch of paint on the ground. Benign: it looks new, and the tyres do not notice."""

    name = "puddle-paint"
    kind = "appearance"
    benign = True
    only_seen = True
    tasks = CARS
    levels = (0.2, 0.35, 0.5, 0.75, 1.0)
    sentence = "a patch of the track is mixed with a share of {:g} of another colour"
    bodies = ("patch_round",)
    GROUND: ClassVar[Array] = np.array((0.60, 0.46, 0.32))

    def _draw_colour(self, rng: np.random.Generator) -> Colour:
        new = np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.9)))
        red, green, blue = (1.0 - self.value) * self.GROUND + self.value * new
        return float(red), float(green), float(blue)

    def _draw_lateral(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(-0.8, 0.8))

    def place(self, model: mujoco.MjModel, track: Track, s: float) -> None:
        """On the ground; nothing to steer around."""
        super().place(model, track, s)
        self.obstacle = (0.0, 0.0, 0.0)


@offer
class Roadside(Placed):
    """Something new stands behind the bank, beside the track. Benign: it is in nobody's way."""

    name = "roadside"
    kind = "appearance"
    benign = True
    only_seen = True
    levels = (4.5, 4.0, 3.5, 3.0, 2.6)
    sentence = "a board or a tent stands {:g} m beside the middle of the track"
    bodies = ("roadside_board", "roadside_tent")

    def _draw_colour(self, rng: np.random.Generator) -> Colour:
        return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.3, 0.9), rng.uniform(0.4, 0.9))

    def _draw_lateral(self, rng: np.random.Generator) -> float:
        return self.value * float(rng.choice((-1.0, 1.0)))

    def place(self, model: mujoco.MjModel, track: Track, s: float) -> None:
        """Off the track; nothing to steer around."""
        super().place(model, track, s)
        self.obstacle = (0.0, 0.0, 0.0)


# --------------------------------------------------------------------------------------------------- at a drawn step


@offer
class SteeringBias(RallyDisturbance):
    """The steering linkage is knocked out of line: a constant angle, of random sign, is added to what is commanded."""

    name = "steering-bias"
    kind = "actuation"
    levels = (0.03, 0.06, 0.10, 0.14, 0.18)
    sentence = "{:g} rad are added to the steering angle"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the sign."""
        self.steering_bias = self.value * float(rng.choice((-1.0, 1.0)))


@offer
class LocalisationBias(RallyDisturbance):
    """The position estimate drifts off: a constant error, of random sign, in the observed lateral offset."""

    name = "localisation-bias"
    kind = "sensing"
    tasks = frozenset({"rally-car"})
    levels = (0.2, 0.4, 0.6, 0.9, 1.2)
    sentence = "the observed lateral offset is off by {:g} m"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the sign."""
        self._bias = self.value * float(rng.choice((-1.0, 1.0)))

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Add the bias to e_y, the second number of the state."""
        observation = observation.copy()
        observation[1] += self._bias
        return observation


def _turned(angle: float) -> Array:
    """Rotation (3, 3) about the vertical by `angle` [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
