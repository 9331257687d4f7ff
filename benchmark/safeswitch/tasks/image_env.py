"""What tasks observed through a camera share: one renderer for observations, beside the one of `render()`."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.base import TaskEnv
from safeswitch.tasks.disturbances import Disturbance
from safeswitch.tasks.rendering import Renderer

OVERSAMPLING = 2
"""A pixel is the mean of this number squared of rendered ones: where an edge lies within a pixel can then be seen, and
with it how fast something moves. Cheaper than multisampling by the driver."""


class ImageEnv(TaskEnv):
    """Mixin of a task whose observation is a picture; it stands before the task that it pictures.

    Attributes:
        eye: name of the camera that observes.
        eye_size: height and width of an observation [pixel].
    """

    eye: ClassVar[str]
    eye_size: ClassVar[tuple[int, int]]
    _eye: Renderer | None = None

    def close(self) -> None:
        """Free both renderers; the environment keeps working and makes new ones."""
        super().close()
        if self._eye is not None:
            self._eye.close()
            self._eye = None

    def _observe(self, disturbance: Disturbance | None) -> NDArray[Any]:
        if self._eye is None:
            height, width = (OVERSAMPLING * side for side in self.eye_size)
            self._eye = Renderer(self.simulator.nominal, width, height, self.eye, fast=True)
        picture = shrink(self._draw(self._eye, disturbance))
        return picture if disturbance is None else disturbance.sense(picture, self._step_index)


def shrink(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Picture (2 h, 2 w, 3) at half the size: the mean of each block of four pixels, rounded."""
    wide = picture.astype(np.uint16)
    rows = wide[0::2] + wide[1::2]
    return ((rows[:, 0::2] + rows[:, 1::2] + 2) >> 2).astype(np.uint8)
