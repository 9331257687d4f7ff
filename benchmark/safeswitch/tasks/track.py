"""Closed tracks for the rally car: a smooth centreline, and curvilinear coordinates along it.

A point is described by the arc length s of its projection on the centreline and by its lateral offset e_y, positive to
the left. The centreline is a periodic cubic spline through control points, sampled densely and fitted again over its
own arc length, so that |dp/ds| = 1 to about 1e-6.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safeswitch.names import unknown

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

HALF_WIDTH = 1.5
"""[m]"""
KNOT = 0.05
"""Distance of the knots of the spline over arc length [m]."""
NODE = 0.01
"""Distance of the nodes from which a projection starts [m]: between them the centreline is a circular arc to 1e-8 m."""
CELL = 0.25
"""Size of the cells that know the nearest node [m]."""
MARGIN = 6.0
"""The cells reach this far beyond the centreline [m]; points outside start from the nearest cell."""
SLIDES = 50
"""A projection is found after two or three steps; more are only needed far from the track."""


@dataclass(frozen=True)
class Track:
    """A closed track of constant width.

    Attributes:
        name: as in `TRACKS`.
        control_points: corners (x, y) [m] that the centreline passes, in the driving direction.
        half_width: from the centreline to the edge [m].
    """

    name: str
    control_points: tuple[tuple[float, float], ...]
    half_width: float = HALF_WIDTH

    @cached_property
    def length(self) -> float:
        """Of the centreline [m]."""
        return float(self._spline.x[-1])

    def position(self, s: ArrayLike) -> Array:
        """Points (..., 2) of the centreline [m] at arc lengths (...)."""
        return np.asarray(self._spline(np.mod(s, self.length)))

    def heading(self, s: ArrayLike) -> Array:
        """Direction (...) of travel [rad], in [-pi, pi]."""
        x_prime, y_prime = np.moveaxis(self._spline(np.mod(s, self.length), 1), -1, 0)
        return np.asarray(np.arctan2(y_prime, x_prime))

    def heading_at(self, s: float) -> float:
        """Direction of travel [rad] at one arc length, from the nearest node and its arc: fifty times faster."""
        nodes = self._nodes
        index = round(s / nodes.step)
        slide = s - index * nodes.step
        index %= nodes.count
        return math.atan2(nodes.sin[index], nodes.cos[index]) + nodes.kappa[index] * slide

    def curvature(self, s: ArrayLike) -> Array:
        """Curvature (...) [1/m], positive where the track turns left: (x' y'' - y' x'') / |p'|^3."""
        s = np.mod(s, self.length)
        (x1, y1), (x2, y2) = (np.moveaxis(self._spline(s, order), -1, 0) for order in (1, 2))
        return np.asarray((x1 * y2 - y1 * x2) / np.hypot(x1, y1) ** 3)

    def point(self, s: ArrayLike, e_y: ArrayLike) -> Array:
        """Points (..., 2) [m] at curvilinear coordinates (s, e_y): the inverse of `project`."""
        heading = self.heading(s)
        normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        return self.position(s) + np.asarray(e_y)[..., None] * normal

    def project(self, x: float, y: float, near: float | None = None) -> tuple[float, float]:
        """Curvilinear coordinates of the point (x, y) [m]: s in [0, length) and e_y.

        From the nearest node that is known for the point's cell, slide along circular arcs to the foot of the
        perpendicular. The answer is a function of the point alone, unless `near` says where to start [m].
        """
        nodes = self._nodes
        index = self._nearest(x, y) if near is None else round(near / nodes.step) % nodes.count
        for _ in range(SLIDES):
            dx, dy = x - nodes.x[index], y - nodes.y[index]
            cos, sin, kappa = nodes.cos[index], nodes.sin[index], nodes.kappa[index]
            along, left = cos * dx + sin * dy, cos * dy - sin * dx
            ahead = 1.0 - kappa * left
            if ahead <= 0.0 or abs(kappa) < 1e-9:  # beyond the centre of curvature, or straight
                slide, e_y = along, left
            else:
                slide = math.atan2(kappa * along, ahead) / kappa
                # (1 - hypot(kappa along, ahead)) / kappa, without the cancellation
                e_y = (2.0 * left - kappa * (along * along + left * left)) / (1.0 + math.hypot(kappa * along, ahead))
            shift = round(slide / nodes.step)
            if shift == 0:
                break
            index = (index + shift) % nodes.count
        return (index * nodes.step + slide) % self.length, e_y

    def _nearest(self, x: float, y: float) -> int:
        grid = self._grid
        row = min(max(int((x - grid.left) / CELL), 0), grid.rows - 1)
        column = min(max(int((y - grid.low) / CELL), 0), grid.columns - 1)
        return grid.node[row][column]

    @cached_property
    def _spline(self) -> CubicSpline:
        """(x, y) over arc length."""
        from scipy.interpolate import CubicSpline

        corners = np.array([*self.control_points, self.control_points[0]], float)
        chords = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        drawn = CubicSpline(chords, corners, bc_type="periodic")
        parameter = np.linspace(0.0, chords[-1], 20_001)
        speed = np.hypot(*drawn(parameter, 1).T)
        middle = np.hypot(*drawn(0.5 * (parameter[1:] + parameter[:-1]), 1).T)
        pieces = np.diff(parameter) * (speed[:-1] + 4.0 * middle + speed[1:]) / 6.0  # Simpson's rule
        arc = np.concatenate([[0.0], np.cumsum(pieces)])
        knots = np.linspace(0.0, arc[-1], round(arc[-1] / KNOT) + 1)
        points = drawn(np.interp(knots, arc, parameter))
        points[-1] = points[0]
        return CubicSpline(knots, points, bc_type="periodic")

    @cached_property
    def _nodes(self) -> _Nodes:
        count = round(self.length / NODE)
        s = np.arange(count) * (self.length / count)
        position, heading = self.position(s), self.heading(s)
        columns = (position[:, 0], position[:, 1], np.cos(heading), np.sin(heading), self.curvature(s))
        return _Nodes(self.length / count, count, *(column.tolist() for column in columns))

    @cached_property
    def _grid(self) -> _Grid:
        from scipy.spatial import cKDTree

        points = np.column_stack([self._nodes.x, self._nodes.y])
        (left, low), (right, high) = points.min(0) - MARGIN, points.max(0) + MARGIN
        rows, columns = math.ceil((right - left) / CELL), math.ceil((high - low) / CELL)
        centres = np.stack(
            np.meshgrid(left + CELL * (np.arange(rows) + 0.5), low + CELL * (np.arange(columns) + 0.5), indexing="ij"),
            axis=-1,
        )
        node = cKDTree(points).query(centres)[1]
        return _Grid(float(left), float(low), rows, columns, node.tolist())

    def __getstate__(self) -> dict[str, Any]:
        """What defines the track, without the tables that are made from it."""
        return {"name": self.name, "control_points": self.control_points, "half_width": self.half_width}

    def samples(self, distance: float) -> Iterator[float]:
        """Arc lengths once around, about `distance` [m] apart."""
        count = round(self.length / distance)
        return (index * self.length / count for index in range(count))


@dataclass(frozen=True)
class _Nodes:
    """The centreline in steps of `step` [m], as lists: reading one number of a list is three times faster."""

    step: float
    count: int
    x: list[float]
    y: list[float]
    cos: list[float]
    sin: list[float]
    kappa: list[float]


@dataclass(frozen=True)
class _Grid:
    """Nearest node of every cell of a grid that begins at (left, low) [m]."""

    left: float
    low: float
    rows: int
    columns: int
    node: list[list[int]]


RIDGE = (
    (10.33, 0.0), (8.98, 3.76), (4.92, 5.37), (1.7, 6.48), (-2.37, 9.03), (-8.56, 9.34), (-12.28, 5.14),
    (-10.1, 0.0), (-5.63, -2.36), (-4.03, -4.39), (-2.39, -9.09), (2.99, -11.41), (7.42, -8.09), (9.02, -3.78),
)  # fmt: skip
HOLLOW = (
    (-1.64, -12.21), (1.06, -10.09), (3.51, -7.57), (5.73, -4.86), (7.13, -1.7), (7.12, 1.73), (5.72, 4.88),
    (3.49, 7.59), (1.04, 10.11), (-1.66, 12.22), (-4.85, 12.26), (-7.07, 9.93), (-6.9, 6.72), (-4.61, 4.26),
    (-2.54, 1.63), (-2.55, -1.66), (-4.63, -4.28), (-6.92, -6.74), (-7.06, -9.96), (-4.83, -12.27),
)  # fmt: skip

TRACKS: dict[str, Track] = {track.name: track for track in (Track("ridge", RIDGE), Track("hollow", HOLLOW))}
"""`ridge` is for training and testing, `hollow` is held out for transfer. Both are 68 m long, turn left and right, and
have a smallest radius of 3.5 m."""


def track(name: str) -> Track:
    """The track `name`; an unknown name lists the valid ones."""
    if name not in TRACKS:
        raise unknown("track", name, TRACKS)
    return TRACKS[name]
