"""Where along the track a placed disturbance stands: met within the episode, out of view at the start.

An obstacle should also come into view at a distance that its severity says. On an open straight it would be seen from
afar; behind a bend the bank hides it. How far before each place of a track a car in the middle sees an obstacle is
found out once per track.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from safeswitch.tasks.rally_disturbances import Placed
from safeswitch.tasks.sight import Sight, surface_points
from safeswitch.tasks.track import Track

Array = NDArray[np.float64]

MET = (40, 80)
"""Control steps, at the nominal speed, between which it is met."""
LATEST = 94
"""The same of one that would be in view at the start if it stood nearer."""
STRIDE = 0.25
"""Distance of the places that are considered [m]."""
KNOWN_STRIDE = 1.0
"""Distance of the places for which sight distances are known [m]; they are interpolated."""
LATERALS = (-0.5, 0.0, 0.5)
"""Lateral offsets for which sight distances are known [m]."""
NEAREST, FURTHEST, GRID = 4.0, 14.0, 0.5
"""Sight distances are found out between these, on this grid [m]."""
BODY_HEIGHT = 0.12
"""Of the car's body above the ground [m]."""
APPROACH = (3.0, 4.0, 5.0, 6.0)
"""Distances before it [m] from at least one of which it can be seen."""
SCATTER = 0.6
"""Of several places with about the right sight distance [m], any may be taken."""
TYPICAL = "obstacle_box"
"""The obstacle for which sight distances are found out."""


class Placing:
    """Puts placed disturbances on one track, seen through one camera."""

    def __init__(self, model: mujoco.MjModel, track: Track, sight: Sight):
        self.model, self.track, self.sight = model, track, sight

    def __call__(self, placed: Placed, qpos: Array, stride: float, rng: np.random.Generator) -> None:
        """Place it.

        Args:
            placed: what has drawn already what it is and how far beside the middle it stands.
            qpos: positions (nq,) of the car at the start.
            stride: distance that the car drives in a control step [m].
            rng: decides between equally good places.
        """
        start, _ = self.track.project(qpos[0], qpos[1])
        places = start + np.arange(MET[0] * stride, LATEST * stride, STRIDE)
        cost = rng.uniform(0.0, SCATTER, len(places))
        if placed.sight is not None:
            cost += np.abs(self.distances(places, placed.lateral) - placed.sight)
        cost[places > start + MET[1] * stride] += FURTHEST  # after all others
        order = places[np.argsort(cost)]
        for side in (1.0, -1.0):  # the other side where this one offers nothing
            placed.lateral *= side
            for s in order:
                placed.place(self.model, self.track, float(s))
                if not self.sight.sees(qpos[:3], qpos[3:7], placed.points) and self._shows(placed, float(s)):
                    return

    def _shows(self, placed: Placed, s: float) -> bool:
        """Whether a car in the middle of the track sees it on the way to arc length `s` [m]."""
        return any(_sees_from(self.track, self.sight, s - distance, placed.points) for distance in APPROACH)

    def distances(self, s: Array, lateral: float) -> Array:
        """Sight distances (n,) [m] of obstacles at arc lengths (n,) and a lateral offset."""
        known = sight_distances(self.track, self.sight)
        grid = np.linspace(0.0, self.track.length, known.shape[1] + 1)
        closed = np.concatenate([known, known[:, :1]], axis=1)
        rows = [np.interp(np.mod(s, self.track.length), grid, row) for row in closed]
        at = np.interp(lateral, LATERALS, np.arange(len(LATERALS)))
        low = min(int(at), len(LATERALS) - 2)
        return (low + 1 - at) * rows[low] + (at - low) * rows[low + 1]


_KNOWN: dict[str, Array] = {}


def sight_distances(track: Track, sight: Sight) -> Array:
    """(laterals, places) distance along the track at which a car in the middle first sees a typical obstacle [m]."""
    if track.name not in _KNOWN:
        points = surface_points(sight.model, TYPICAL)
        places = list(track.samples(KNOWN_STRIDE))
        _KNOWN[track.name] = np.array(
            [[_first_sight(track, sight, points, s, lateral) for s in places] for lateral in LATERALS]
        )
    return _KNOWN[track.name]


def _first_sight(track: Track, sight: Sight, points: Array, s: float, lateral: float) -> float:
    """The largest distance, on a grid, from which it is in view without a gap down to the nearest ones [m]."""
    x, y = track.point(s, lateral)
    turned = points @ _about_z(float(track.heading(s))).T + (x, y, 0.0)
    for distance in np.arange(NEAREST, FURTHEST, GRID):
        if not _sees_from(track, sight, s - distance, turned):
            return float(distance) - 0.5 * GRID
    return FURTHEST


def _sees_from(track: Track, sight: Sight, s: float, points: Array) -> bool:
    """Whether a car in the middle of the track at arc length `s` [m] sees any of the points (n, 3)."""
    x, y = track.position(s)
    half = 0.5 * track.heading_at(s)
    return sight.sees(np.array([x, y, BODY_HEIGHT]), np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), points)


def _about_z(angle: float) -> Array:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
