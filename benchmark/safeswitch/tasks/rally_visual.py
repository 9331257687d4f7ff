"""Disturbances of what the rally car's camera sees. None of them touches the physics."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.disturbances import Array, offer
from safeswitch.tasks.rally_disturbances import RallyDisturbance


class OnCamera(RallyDisturbance):
    """A disturbance of the picture."""

    tasks = frozenset({"rally-car-image"})
    only_seen = True


@offer
class Dusk(OnCamera):
    """It gets dark: sun, sky and everything that shines are dimmed."""

    name = "dusk"
    kind = "appearance"
    levels = (0.85, 0.7, 0.55, 0.4, 0.25)
    sentence = "all light is multiplied by {:g}"

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Scale every light, the one at the camera, and what materials emit."""
        for name in ("light_ambient", "light_diffuse", "light_specular", "mat_emission"):
            getattr(model, name)[:] = self.value * getattr(nominal, name)
        for name in ("ambient", "diffuse", "specular"):
            getattr(model.vis.headlight, name)[:] = self.value * getattr(nominal.vis.headlight, name)


@offer
class CameraPitch(OnCamera):
    """The camera's mount gives way: it looks further up or down."""

    name = "camera-pitch"
    kind = "sensing"
    levels = (1.0, 2.0, 4.0, 6.0, 9.0)
    sentence = "the camera is tilted by {:g} degrees, up or down"

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw up or down."""
        self._angle = math.radians(self.value) * float(rng.choice((-1.0, 1.0)))

    def alter(self, nominal: mujoco.MjModel, model: mujoco.MjModel) -> None:
        """Turn the camera about its own x axis."""
        camera = nominal.camera("onboard").id
        half, turned = 0.5 * self._angle, np.empty(4)
        mujoco.mju_mulQuat(turned, nominal.cam_quat[camera], np.array([math.cos(half), math.sin(half), 0.0, 0.0]))
        model.cam_quat[camera] = turned
        mat = np.empty(9)
        mujoco.mju_quat2Mat(mat, turned)
        model.cam_mat0[camera] = mat


@offer
class CameraDirt(OnCamera):
    """A splash of mud on the lens: a soft, brown blotch that covers part of the picture."""

    name = "camera-dirt"
    kind = "sensing"
    levels = (0.06, 0.10, 0.16, 0.22, 0.30)
    sentence = "a blotch of dirt with a radius of {:g} times the width covers part of the picture"
    COLOUR: ClassVar[Array] = np.array((62.0, 48.0, 36.0))
    SOFT: ClassVar[float] = 0.35
    """Share of the radius over which it fades."""

    def reset(self, rng: np.random.Generator, horizon: int) -> None:
        """Draw the place, as shares of the picture, and the outline."""
        self._row, self._column = rng.uniform(0.15, 0.85, 2)
        self._lobes = rng.uniform(0.0, 0.15, 3)
        self._phases = rng.uniform(-math.pi, math.pi, 3)

    def sense(self, observation: NDArray[Any], step: int) -> NDArray[Any]:
        """Cover the blotch."""
        height, width = observation.shape[:2]
        down = (np.arange(height)[:, None] + 0.5 - self._row * height) / (self.value * width)
        right = (np.arange(width)[None, :] + 0.5 - self._column * width) / (self.value * width)
        angle = np.arctan2(down, right)
        outline = 1.0 + sum(
            lobe * np.sin(order * angle + phase)
            for order, lobe, phase in zip((2, 3, 5), self._lobes, self._phases, strict=True)
        )
        cover = np.clip((outline - np.hypot(down, right)) / self.SOFT + 0.5, 0.0, 1.0)[..., None]
        return np.rint((1.0 - cover) * observation + cover * self.COLOUR).astype(np.uint8)
