"""What the rally car's camera can see, without rendering: the frustum, and banks and tubes as occluders.

A pixel of an object shows when a point of its surface lies within the camera's field of view and no bank or tube is
between them. Points are sampled on the surface; rays of sight are MuJoCo's, on the very triangles that are drawn. The
camera's pose is computed from the car's, so that the answer is a function of the state alone.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.course import HIDING_GROUP

Array = NDArray[np.float64]

FAR = 30.0
"""Nothing is looked for beyond this distance [m]: there it is smaller than a pixel, or behind a bank."""
ROUND = 12
"""Points on a circle of a round surface."""
SLIVER = 0.006
"""Height of what is seen of an object, divided by half the height of the picture, below which no pixel of it shows."""
SHARE = 0.97
"""Of the way to a point that must be free: a patch on the ground or an object against a bank does not hide itself."""


class Sight:
    """The view of one fixed camera of a car, on one course.

    Args:
        model: with the banks; not changed.
        camera: name of a camera that is fixed to a body.
        aspect: width of its picture divided by its height.
    """

    def __init__(self, model: mujoco.MjModel, camera: str, aspect: float):
        self.model, self._data = model, mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)  # banks never move
        index = model.camera(camera).id
        self._offset = model.cam_pos[index].copy()
        self._turn = _matrix(model.cam_quat[index])
        up = math.tan(0.5 * math.radians(float(model.cam_fovy[index])))
        self._half = np.array([aspect * up, up])
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[HIDING_GROUP] = 1

    def sees(self, position: Array, quaternion: Array, points: Array) -> bool:
        """Whether any of the points (n, 3) [m] is in view, and more than a sliver.

        Args:
            position: (3,) of the car's body [m].
            quaternion: (4,) of the car's body.
            points: in the world.
        """
        body = _matrix(quaternion)
        eye = position + body @ self._offset
        rays = points - eye
        right, up, back = (rays @ (body @ self._turn)).T  # a camera looks along its -z
        inside = (back < 0.0) & (back > -FAR)
        inside &= (np.abs(right) <= -self._half[0] * back) & (np.abs(up) <= -self._half[1] * back)
        if not inside.any():
            return False
        chosen = np.ascontiguousarray(rays[inside])
        count = len(chosen)
        hit, distance = np.full(count, -1, np.int32), np.full(count, -1.0)
        mujoco.mj_multiRay(
            self.model, self._data, eye, chosen.ravel(), self._groups, 1, -1, hit, distance, None, count, FAR
        )
        free = (distance < 0.0) | (distance > SHARE)  # in units of the ray
        if not free.any():
            return False
        height = (up[inside] / back[inside])[free] / self._half[1]
        return bool(np.ptp(height) > SLIVER)


def surface_points(model: mujoco.MjModel, body: str) -> Array:
    """Points (n, 3) on the surfaces of a body's geoms, in the body's frame [m]."""
    index = model.body(body).id
    clouds = []
    for geom in range(model.body_geomadr[index], model.body_geomadr[index] + model.body_geomnum[index]):
        local = _SURFACES[int(model.geom_type[geom])](model.geom_size[geom])
        clouds.append(local @ _matrix(model.geom_quat[geom]).T + model.geom_pos[geom])
    return np.concatenate(clouds)


def _box(size: Array) -> Array:
    ticks = np.linspace(-1.0, 1.0, 7)
    lattice = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    return lattice[np.abs(lattice).max(1) == 1.0] * size


def _cylinder(size: Array) -> Array:
    return np.concatenate(
        [_circle(share * size[0], height * size[1]) for height in (-1.0, 0.0, 1.0) for share in (0.5, 1.0)]
    )


def _ellipsoid(size: Array) -> Array:
    levels = np.linspace(-1.0, 1.0, 9)
    return np.concatenate([_circle(math.sqrt(1.0 - level**2), level) for level in levels]) * size


def _sphere(size: Array) -> Array:
    return _ellipsoid(np.full(3, size[0]))


def _capsule(size: Array) -> Array:
    ball = _sphere(size)
    return np.concatenate([ball + (0.0, 0.0, size[1]), ball - (0.0, 0.0, size[1])])


_SURFACES = {
    int(mujoco.mjtGeom.mjGEOM_BOX): _box,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): _cylinder,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): _ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): _sphere,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): _capsule,
}


def _circle(radius: float, height: float) -> Array:
    angle = np.arange(ROUND) * (math.tau / ROUND)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(ROUND, height)])


def _matrix(quaternion: Array) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, np.float64))
    return matrix.reshape(3, 3)
