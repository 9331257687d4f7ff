"""Laws of the tracks: arc length, curvature, and curvilinear coordinates there and back."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from safeswitch.tasks.track import TRACKS, Track, track

NAMES = sorted(TRACKS)
CIRCLE = Track("circle", tuple((5.0 * math.cos(a), 5.0 * math.sin(a)) for a in np.arange(24) * math.tau / 24))


@pytest.mark.parametrize("name", NAMES)
def test_dimensions(name: str) -> None:
    course = track(name)
    s = np.linspace(0.0, course.length, 5000, endpoint=False)
    curvature = course.curvature(s)
    assert 67.0 < course.length < 69.0 and course.half_width == 1.5
    assert 3.49 <= 1.0 / np.abs(curvature).max() < 3.7
    assert (curvature > 0.1).mean() > 0.2 and (curvature < -0.1).mean() > 0.08
    # Two places are either near along the track, or far enough apart for a bank between them.
    points = course.position(s[::10])
    distance = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    along = np.abs(s[::10, None] - s[None, ::10])
    apart = np.minimum(along, course.length - along) > 9.0
    assert distance[apart].min() > 5.0


@pytest.mark.parametrize("name", NAMES)
def test_it_closes_smoothly_and_is_parametrised_by_arc_length(name: str) -> None:
    course = track(name)
    for function in (course.position, course.curvature):
        np.testing.assert_allclose(function(0.0), function(course.length), atol=1e-9)
        np.testing.assert_allclose(function(-3.0), function(course.length - 3.0), atol=1e-9)
    s, h = np.linspace(0.0, course.length, 3000), 1e-4
    speed = np.hypot(*((course.position(s + h) - course.position(s - h)) / (2 * h)).T)
    np.testing.assert_allclose(speed, 1.0, atol=1e-5)
    turn = np.unwrap(course.heading(np.linspace(0.0, course.length, 4000)))
    assert turn[-1] - turn[0] == pytest.approx(math.tau)


@pytest.mark.parametrize("name", NAMES)
def test_curvature_is_the_derivative_of_the_heading(name: str) -> None:
    course = track(name)
    s, h = np.linspace(0.0, course.length, 2000), 1e-4
    turned = np.remainder(course.heading(s + h) - course.heading(s - h) + math.pi, math.tau) - math.pi
    np.testing.assert_allclose(course.curvature(s), turned / (2 * h), atol=2e-4)


def test_a_circle() -> None:
    assert pytest.approx(10.0 * math.pi, rel=1e-4) == CIRCLE.length
    np.testing.assert_allclose(CIRCLE.curvature(np.linspace(0, 30, 50)), 0.2, atol=2e-3)  # it turns left
    _, inside = CIRCLE.project(0.0, 4.0)
    _, outside = CIRCLE.project(0.0, 7.0)
    assert inside == pytest.approx(1.0, abs=1e-3) and outside == pytest.approx(-2.0, abs=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_projection_there_and_back(name: str) -> None:
    course = track(name)
    rng = np.random.default_rng(0)
    s = rng.uniform(0.0, course.length, 2000)
    e_y = rng.uniform(-2.4, 2.4, 2000)  # the smallest radius is 3.5 m
    for (x, y), there, left in zip(course.point(s, e_y), s, e_y, strict=True):
        found, offset = course.project(x, y)
        apart = abs(found - there)
        assert 0.0 <= found < course.length
        assert min(apart, course.length - apart) < 1e-5 and abs(offset - left) < 1e-6
        near, same = course.project(x, y, near=there + rng.uniform(-1.0, 1.0))
        assert (near, same) == pytest.approx((found, offset), abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_projection_is_the_nearest_point(name: str) -> None:
    course = track(name)
    dense = course.position(np.linspace(0.0, course.length, 20_000))
    for x, y in np.random.default_rng(1).uniform(-15.0, 15.0, (400, 2)):
        _, e_y = course.project(x, y)
        distance = np.hypot(*(dense - (x, y)).T).min()
        if distance < 3.0:
            assert abs(e_y) == pytest.approx(distance, abs=2e-3)
        assert np.isfinite(e_y)


def test_projection_is_a_function_of_the_point() -> None:
    fresh = copy.deepcopy(track("ridge"))
    points = np.random.default_rng(2).uniform(-12.0, 12.0, (200, 2))
    forward = [track("ridge").project(x, y) for x, y in points]
    assert forward == [fresh.project(x, y) for x, y in points[::-1]][::-1]


def test_far_away_and_unknown() -> None:
    s, e_y = track("ridge").project(1e3, -1e3)
    assert np.isfinite([s, e_y]).all() and abs(e_y) > 900
    with pytest.raises(ValueError, match="ridge"):
        track("rigde")
