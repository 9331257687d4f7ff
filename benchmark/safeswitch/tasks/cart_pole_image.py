"""Cart-pole from images: the same cart-pole, seen through a third-person camera, one frame per step.

The source paper's second task (Lee, Saigol, Theodorou, https://arxiv.org/abs/1803.10231): velocities are not in a
frame, so that a learner has to remember some, and an object that training never showed appears in the picture. The
object is only seen: it touches nothing, and the expert, which knows the full state, is not concerned.
"""

from __future__ import annotations

from types import MappingProxyType

import gymnasium as gym
import mujoco
import numpy as np

from safeswitch.tasks import models
from safeswitch.tasks.cart_pole import CartPoleEnv
from safeswitch.tasks.image_env import ImageEnv

SIZE = 64
"""Width and height of a frame [pixel]."""
CAMERA = "third_person"
RAIL = 1.0
"""Half the length of the rail [m]: all of it is in the picture, and a pixel is 3.4 cm."""


class CartPoleImageEnv(ImageEnv, CartPoleEnv):
    """Swing the pole up from hanging, and keep it upright without leaving the rail, from pictures alone.

    Dynamics and success are those of `SafeSwitch/CartPole-v0`, on a rail of +-1 m.

    ## Observation: `Box(64, 64, 3)`, uint8

    One RGB frame of a camera that stands 4.4 m in front of the rail and sees 2.2 m of it. Positions can be read from a
    frame, velocities cannot: a learner keeps a memory of its own.

    ## Action: `Box(1,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | force on the cart | force limit (6 N) | +-1, clipped |

    ## Reward

    `(1 + cos(theta)) / 2 * (1 - (x / rail)^2)`, clipped to [0, 1].

    ## Start, end, success

    As in `SafeSwitch/CartPole-v0`: the pole hangs, the episode terminates when the cart leaves the rail, is truncated
    after T = 80 steps of 0.06 s, and is a success if the pole was upright during the last second.

    ## Info (the same keys at reset and at every step)

    `state`, `parameters` (cart_mass, pole_mass, pole_length, pole_inertia, cart_damping, pole_damping, force_limit),
    `is_success`, `disturbed`, `step` and `onset`, as in `SafeSwitch/CartPole-v0`. The expert reads them; a learner or a
    switch rule never does.

    ## Arguments

    * `disturbance`: None or one of object, object-held-out (kinds of object that calibration never shows),
      object-passing, object-far (benign), occlusion, lighting, camera-shift, pixel-noise, background, and those of the
      cart-pole that do not need a measured state: cart-mass, pole-length, joint-friction, push, motor-gain, repaint
      (benign). It sets in before the observation of step t0, uniform on 10-60 % of the episode.
    * `severity`, `render_mode`, `width`, `height` and the numbers of `CartPoleConfig` as in `SafeSwitch/CartPole-v0`;
      width and height are those of `render()`, not of the observation.
    """

    task = "cart-pole-image"
    camera = eye = CAMERA
    eye_size = (SIZE, SIZE)
    defaults = MappingProxyType({"rail": RAIL})

    def __init__(
        self,
        disturbance: str | None = None,
        severity: int = 3,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **design: float,
    ) -> None:
        """See the class docstring."""
        super().__init__(disturbance, severity, render_mode, width, height, **design)
        self.observation_space = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)

    def _compiled(self) -> mujoco.MjModel:
        return models.cart_pole_image(self.config)
