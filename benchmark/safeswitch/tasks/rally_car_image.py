"""Rally car from images: the same car, seen through its onboard camera; it steers, and a speed controller drives.

The source paper's second task (Lee, Saigol, Theodorou, https://arxiv.org/abs/1803.10231): the learner steers from the
camera alone, and an obstacle that training never showed stands on the track.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.disturbances import Disturbance
from safeswitch.tasks.image_env import ImageEnv
from safeswitch.tasks.rally_car import Array, RallyCarEnv

HEIGHT, WIDTH = 48, 96
"""Of a frame [pixel]."""


class RallyCarImageEnv(ImageEnv, RallyCarEnv):
    """Keep the whole car on the track and touch nothing, steering from the picture of the onboard camera alone.

    ## Observation: `Box(48, 96, 3)`, uint8

    One RGB frame of a camera 0.30 m above the ground and 0.40 m ahead of the centre of mass, tilted down by 10 degrees,
    with a horizontal field of view of 83 degrees. Every pixel has Gaussian noise of std 0.009 of the range.

    ## Action: `Box(1,)`, float32

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | steering angle of the front wheels (of the bicycle that turns like the car) | 0.40 rad | +-1, clipped |

    A speed controller holds 4 m/s: throttle = speed_gain (speed - v_x), clipped to [-1, 1], at every control step.

    ## Reward

    `v_x cos(e_psi) / speed`, clipped to [0, 1].

    ## Start, end, success

    As in `SafeSwitch/RallyCar-v0`: anywhere along the lap at about 4 m/s; the episode terminates when any part of the
    car leaves the track, touches an obstacle, or turns over; it is a success when T = 100 steps of 0.05 s are survived.

    ## Info (the same keys at reset and at every step)

    `state`, `parameters` (mass, yaw_inertia, l_f, l_r, friction, steering_bias, obstacle_s, obstacle_e,
    obstacle_radius), `is_success`, `disturbed`, `step` and `onset`, as in `SafeSwitch/RallyCar-v0`. The expert reads
    them; a learner or a switch rule never does.

    ## Arguments

    * `disturbance`: None or one of obstacle, obstacle-held-out (shapes and colours that calibration never shows), mud,
      roadside (benign), puddle-paint (benign), each of which sets in at the first step at which it is in view; and of
      dusk, camera-dirt, camera-pitch, pixel-noise, steering-bias, at a step uniform on 10-60 % of the episode.
    * `severity`, `track`, `render_mode`, `width`, `height` and the numbers of `RallyCarConfig` as in
      `SafeSwitch/RallyCar-v0`; width and height are those of `render()`, not of the observation.
    """

    task = "rally-car-image"
    steering_only = True
    eye = "onboard"
    eye_size = (HEIGHT, WIDTH)

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
        super().__init__(disturbance, severity, render_mode, width, height, track, **design)
        self.observation_space = gym.spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8)

    def _throttle(self, action: Array) -> float:
        w, x, y, z = self._qpos[3:7].tolist()
        along_x, along_y = 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)
        v_x = (along_x * self._qvel[0] + along_y * self._qvel[1]) / np.hypot(along_x, along_y)
        return float(min(max(self.config.speed_gain * (self.config.speed - v_x), -1.0), 1.0))

    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        return self._noisy(super()._observe(disturbance))

    def _noisy(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture with the camera's noise, which depends on episode and step alone."""
        if not self.config.image_noise:
            return picture
        key = np.random.SeedSequence((self.episode_seed, self._step_index))
        noise = np.random.Generator(np.random.SFC64(key)).standard_normal(picture.shape, np.float32)
        return np.clip(np.rint(picture + 255.0 * self.config.image_noise * noise), 0, 255).astype(np.uint8)
