"""Where the rally car's wheels and corners are, and how its front wheels turn; sources: assets/README.md."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
FRONT, REAR = 0.34, 0.23
"""Distance of the axles from the centre of mass [m]."""
GAUGE = 0.38
"""Distance of the wheels of an axle, and of the points about which the front ones turn [m]."""
TYRE_RADIUS = 0.095
"""[m]"""
FOOTPRINT = (-0.395, 0.505, 0.2265)
"""Rear and front end of the car seen from its centre of mass, and half its width over the tyres [m]."""
REACH = math.hypot(FOOTPRINT[1], FOOTPRINT[2])
"""No point of the car is further from its centre of mass [m]."""


def front_angles(delta: float) -> tuple[float, float]:
    """Angles of the left and the right front wheel [rad] that turn like a bicycle's at `delta` (Ackermann).

    The centre of the turn lies on the rear axle, R = (l_f + l_r) / tan(delta) from its middle; the wheels' own centres
    of turn are half the gauge nearer to it and further from it.
    """
    slope, half = math.tan(delta), 0.5 * GAUGE / (FRONT + REAR)
    return math.atan(slope / (1.0 - half * slope)), math.atan(slope / (1.0 + half * slope))


def bicycle_angle(left: float, right: float) -> float:
    """Angle of the bicycle's wheel [rad], a mean of what the left and the right one say; inverse of `front_angles`."""
    half = 0.5 * GAUGE / (FRONT + REAR)
    first, second = math.tan(left), math.tan(right)
    return math.atan(0.5 * (first / (1.0 + half * first) + second / (1.0 - half * second)))


def yaw_of(qpos: Any) -> float:
    """Direction of the car's x axis, seen from above [rad]."""
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def corners(x: float, y: float, yaw: float, rectangle: tuple[float, float, float]) -> Array:
    """Corners (4, 2) [m] of a rectangle (rear, front, half width) of the car: front left, front right, rear ..."""
    rear, front, half = rectangle
    cos, sin = math.cos(yaw), math.sin(yaw)
    ahead, left = np.array([front, front, rear, rear]), np.array([half, -half, half, -half])
    return np.column_stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left])


def whole_car(model: mujoco.MjModel) -> tuple[float, float, float, float]:
    """Mass [kg], yaw inertia [kg m^2] and distances of the axles from the centre of mass [m] of the whole car."""
    bodies = [model.body("car").id, *(model.body(name).id for name in WHEELS)]
    masses = model.body_mass[bodies]
    # In the frame of the car: wheels hang at their pos, and their axes are its axes.
    places = np.array([model.body_ipos[bodies[0]], *model.body_pos[bodies[1:]]])
    centre = masses @ places / masses.sum()
    away = places[:, :2] - centre[:2]
    inertia = float((model.body_inertia[bodies, 2] + masses * (away**2).sum(1)).sum())
    front, rear = (float(model.body(name).pos[0]) for name in (WHEELS[0], WHEELS[2]))
    return float(masses.sum()), inertia, front - float(centre[0]), float(centre[0]) - rear


def settle(model: mujoco.MjModel) -> Array:
    """Positions (nq,) of the car at rest on its springs, at the origin."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(2.0 / model.opt.timestep))
    settled = data.qpos.copy()
    settled[:2] = 0.0
    return settled
