"""Disturbances of what a camera sees. None of them touches the physics: the same actions give the same trajectory.

An object is one of the props of the scene, invisible in the nominal model; here it gets a place, a size and a colour
in the disturbed one. Kinds of `object-held-out` never occur in `object`, so that what is calibrated on the one can be
tested on something that it has not seen.
"""

from __future__ import annotations

import colorsys
import math
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks import disturbances
from safeswitch.tasks.disturbances import offer, repaint

IMAGES = frozenset({"cart-pole-image"})

HINGE_HEIGHT = 0.85
"""Of the rail above the ground [m]."""
BEHIND, IN_FRONT = 0.35, -0.45
"""Where objects stand, seen from the rail, away from the camera [m]."""

GREEN = 1.0 / 3.0
"""Hue of green: neither cart (blue) nor pole (orange) nor bob (red)."""

Sizes = dict[str, tuple[float, float, float]]


class Visual(disturbances.Disturbance):
    """A disturbance of the picture."""

    tasks = IMAGES
    only_seen = True


KINDS: dict[str, Sizes] = {
    "ball": {"prop_ball": (1.0, 1.0, 1.0)},
    "box": {"prop_box": (0.9, 0.9, 0.9)},
    "cylinder": {"prop_cylinder": (0.6, 1.0, 0.0)},
    "bar": {"prop_bar": (0.3, 1.2, 0.0)},
}
"""Props of each kind of object, and their sizes (as MuJoCo defines them per shape) in units of the object's size."""

HELD_OUT: dict[str, Sizes] = {
    "disc": {"prop_disc": (1.3, 0.4, 0.7)},
    "cross": {"prop_cross_1": (1.2, 0.3, 0.3), "prop_cross_2": (0.3, 0.3, 1.2)},
}
"""The same of the kinds that no calibration shows."""


@offer
class Object(Visual):
    """An object that no training image shows appears, and stays: the paper's disturbance.

    Kind, colour, size, turn and place are drawn. With the severity grow its size and the range of its colours, from
    greens to all, those of cart and pole too; from severity 3 on it may stand in front of the rail and cover them.
    """

    name = "object"
    kind = "appearance"
    levels = (0.08, 0.16, 0.24, 0.31, 0.38)
    sentence = "an object of up to {:g} m in radius appears in the picture"
    KINDS: ClassVar[dict[str, Sizes]] = KINDS
    HUES: ClassVar[tuple[float, ...]] = (0.1, 0.2, 0.35, 0.65, 1.0)
    """Width of the range of hues about green, 1 is all of them, per severity."""
    SMALLEST: ClassVar[float] = 0.5
    """Of the sizes that are drawn, as a share of the largest."""

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the object."""
        kinds = list(self.KINDS)
        self.drawn = kinds[int(rng.integers(len(kinds)))]
        self._props = self.KINDS[self.drawn]
        self._size = self.value * rng.uniform(self.SMALLEST, 1.0)
        self._colour = self._draw_colour(rng)
        self._turn = rng.uniform(-math.pi / 2, math.pi / 2)
        self._place = self._draw_place(rng, horizon)

    def _draw_colour(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Red, green and blue."""
        hue = GREEN + self.HUES[self.severity - 1] * rng.uniform(-0.5, 0.5)
        return colorsys.hsv_to_rgb(hue % 1.0, rng.uniform(0.6, 1.0), rng.uniform(0.4, 1.0))

    def _draw_place(self, rng: np.random.Generator, horizon: int) -> NDArray[np.float64]:
        """(3,) [m]: somewhere about the rail."""
        depth = IN_FRONT if self.severity >= 3 and rng.random() < 0.5 else BEHIND
        return np.array([rng.uniform(-0.95, 0.95), depth, HINGE_HEIGHT + rng.uniform(-0.8, 0.95)])

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Put the object there, and nothing else of an earlier episode."""
        model.geom_rgba[:] = nominal.geom_rgba
        half = 0.5 * self._turn
        for name, sizes in self._props.items():
            geom = nominal.geom(name).id
            model.geom_size[geom] = self._size * np.array(sizes)
            model.geom_pos[geom] = self._place
            model.geom_quat[geom] = (math.cos(half), 0.0, math.sin(half), 0.0)  # about the line of sight
            model.geom_rgba[geom] = (*self._colour, 1.0)


@offer
class ObjectHeldOut(Object):
    """The same with kinds of object that `object` does not have, in any colour: for tests only."""

    name = "object-held-out"
    KINDS = HELD_OUT
    HUES = (1.0,) * 5


@offer
class ObjectPassing(Object):
    """An object moves through the picture and leaves it: control could then be given back."""

    name = "object-passing"
    sentence = "an object of up to {:g} m in radius passes through the picture"
    START: ClassVar[float] = 1.5
    """Distance from the middle at which it enters, and leaves [m]: just out of view."""
    STEPS: ClassVar[tuple[int, int]] = (20, 30)
    """Control steps that it takes."""

    def _draw_place(self, rng: np.random.Generator, horizon: int) -> NDArray[np.float64]:
        place = super()._draw_place(rng, horizon)
        self._side = rng.choice((-1.0, 1.0))
        self._steps = int(rng.integers(*self.STEPS, endpoint=True))
        place[0] = self._side * self.START
        return place

    def show(self, model: mujoco.MjModel, elapsed: int) -> None:
        """Move it to the other side; there it stays, out of view."""
        share = min(max(elapsed, 0) / self._steps, 1.0)
        for name in self._props:
            model.geom_pos[model.geom(name).id, 0] = self._side * self.START * (1.0 - 2.0 * share)


@offer
class ObjectFar(Object):
    """A pale object in an upper corner of the picture. Benign: new, but far from everything that matters."""

    name = "object-far"
    benign = True
    levels = (0.02, 0.03, 0.04, 0.05, 0.06)
    sentence = "a pale object of up to {:g} m in radius appears in an upper corner"

    def _draw_place(self, rng: np.random.Generator, horizon: int) -> NDArray[np.float64]:
        side = rng.choice((-1.0, 1.0))
        return np.array([side * rng.uniform(0.85, 1.05), BEHIND, HINGE_HEIGHT + rng.uniform(0.85, 1.05)])

    def _draw_colour(self, rng: np.random.Generator) -> tuple[float, float, float]:
        return colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.05, 0.2), rng.uniform(0.75, 0.9))


@offer
class Lighting(Visual):
    """The light is dimmed."""

    name = "lighting"
    kind = "appearance"
    levels = (0.85, 0.7, 0.55, 0.4, 0.25)
    sentence = "all light is multiplied by {:g}"

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Scale every light of the scene and the one at the camera."""
        for name in ("light_ambient", "light_diffuse", "light_specular"):
            getattr(model, name)[:] = self.value * getattr(nominal, name)
        for name in ("ambient", "diffuse", "specular"):
            getattr(model.vis.headlight, name)[:] = self.value * getattr(nominal.vis.headlight, name)


@offer
class CameraShift(Visual):
    """Somebody bumps into the camera: it stands elsewhere, in a random direction across the line of sight."""

    name = "camera-shift"
    kind = "sensing"
    levels = (0.02, 0.05, 0.10, 0.15, 0.20)
    sentence = "the camera stands {:g} m beside its place, in a random direction"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the direction."""
        angle = rng.uniform(-math.pi, math.pi)
        self._shift = self.value * np.array([math.cos(angle), 0.0, math.sin(angle)])

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Move the camera."""
        camera = nominal.camera("third_person").id
        for name in ("cam_pos", "cam_pos0"):
            getattr(model, name)[camera] = getattr(nominal, name)[camera] + self._shift


@offer
class Background(Visual):
    """Wall and floor are painted in another colour."""

    name = "background"
    kind = "appearance"
    levels = (0.1, 0.2, 0.4, 0.6, 0.8)
    sentence = "the colours of wall and floor are mixed with a share of {:g} of a new one"
    MATERIALS: ClassVar[tuple[str, ...]] = ("wall", "ground")

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the new colour."""
        self._colour = np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.6, 1.0), rng.uniform(0.3, 0.9)))

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Mix the colours."""
        for name in self.MATERIALS:
            repaint(nominal, model, name, self._colour, self.value)


@offer
class Occlusion(Visual):
    """A square of the picture shows nothing any more, as with dirt on the lens."""

    name = "occlusion"
    kind = "sensing"
    levels = (0.10, 0.15, 0.25, 0.35, 0.45)
    sentence = "a square of {:g} times the width of the picture is one dark colour"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the place, as shares of the free range, and the colour."""
        self._row, self._column = rng.random(2)
        self._colour = rng.integers(20, 110, 3, dtype=np.uint8)

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Cover the square."""
        height, width = observation.shape[:2]
        side = max(round(self.value * width), 1)
        top, left = round(self._row * (height - side)), round(self._column * (width - side))
        covered = observation.copy()
        covered[top : top + side, left : left + side] = self._colour
        return covered


@offer
class PixelNoise(Visual):
    """Every pixel becomes noisy: Gaussian, white, keyed by (episode seed, step) and therefore repeatable."""

    name = "pixel-noise"
    kind = "sensing"
    tasks = IMAGES | {"rally-car-image"}
    levels = (0.02, 0.04, 0.08, 0.14, 0.22)
    sentence = "Gaussian noise of std {:g} times the full range is added to every pixel"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the key of the episode's noise."""
        self._key = int(rng.integers(2**62))

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Add the noise of this step."""
        rng = np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence((self._key, step))))
        noisy = observation + 255.0 * self.value * rng.standard_normal(observation.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
