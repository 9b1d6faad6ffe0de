# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A planned path: its shape, the nearest point, its times."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.control.path_source import figure_eight_path
from diffdrive_jacobian.kinematics import se2


def circle(count, radius=1.0, turns=1.0):
    """Positions on a circle to the left, from the origin along x."""
    angle = np.linspace(0.0, 2.0 * math.pi * turns, count)
    return radius * np.stack([np.sin(angle), 1.0 - np.cos(angle)], -1)


def wobbly(rng, count=40):
    """A random smooth path, coarsely sampled."""
    heading = np.cumsum(rng.uniform(-0.5, 0.5, count))
    step = rng.uniform(0.5, 1.5, (count, 1))
    return np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], -1), axis=0)


@pytest.mark.parametrize('turns', [0.6, 1.0])
def test_a_coarse_circle_is_a_circle(turns):
    path = Path(circle(17, 1.5, turns))
    assert path.closed is (turns == 1.0)
    assert path.length == pytest.approx(3.0 * math.pi * turns, rel=1e-12)
    s = np.linspace(0.0, path.length, 1000, endpoint=False)
    x, y, theta = path.poses_at(s).T
    assert_allclose(np.hypot(x, y - 1.5), 1.5, atol=1e-12)
    assert_allclose(se2.wrap_angle(theta - s / 1.5), 0.0, atol=1e-12)


def test_a_reference_has_the_derivatives_of_the_path():
    path, h = Path(wobbly(np.random.default_rng(1))), 1e-6
    for s in np.linspace(0.1, path.length - 0.1, 40):
        before, here, after = (path.at(at, 0.3) for at in (s - 0.3 * h, s, s + 0.3 * h))
        heading = np.array([math.cos(here.theta), math.sin(here.theta)])
        velocity = (after.x - before.x) / (2 * h), (after.y - before.y) / (2 * h)
        assert_allclose(velocity, 0.3 * heading, atol=1e-8)
        if before.omega == after.omega:
            assert (after.theta - before.theta) / (2 * h) == pytest.approx(here.omega, abs=1e-8)
            across = np.array([-heading[1], heading[0]])
            assert_allclose([here.ax, here.ay], 0.3 * here.omega * across, atol=1e-15)


def test_the_path_goes_through_the_poses_with_one_tangent():
    positions = wobbly(np.random.default_rng(2))
    path = Path(positions)
    s = path.arc_lengths[1:-1]
    assert_allclose(path.poses_at(path.arc_lengths)[:, :2], positions, atol=1e-12)
    turns = path.poses_at(s - 1e-9)[:, 2] - path.poses_at(s + 1e-9)[:, 2]
    assert_allclose(se2.wrap_angle(turns), 0.0, atol=1e-7)


def curve(rng, ratio):
    """Return uneven positions on a curve of curvature `sin(2 s)`, and their arc lengths."""
    s = np.concatenate([[0.0], np.cumsum(0.1 * rng.uniform(1.0, ratio, 60))])
    fine = np.linspace(0.0, s[-1], 100_001)
    # The integral of the curvature, and that of its direction by the trapezoidal rule.
    directions = np.array([np.cos(np.sin(fine) ** 2), np.sin(np.sin(fine) ** 2)])
    steps = np.diff(fine) * (directions[:, 1:] + directions[:, :-1]) / 2.0
    places = np.concatenate([np.zeros((2, 1)), np.cumsum(steps, axis=1)], axis=1)
    return np.column_stack([np.interp(s, fine, one) for one in places]), s


@pytest.mark.parametrize(('ratio', 'most'), [(1.0, 0.09), (3.0, 0.23)])
def test_the_curvature_follows_that_of_a_curve_and_does_not_zigzag(ratio, most):
    positions, s = curve(np.random.default_rng(5), ratio)
    path = Path(positions)
    inside = np.linspace(0.5, path.length - 0.5, 2000)
    curvature = np.array([path.at(one, 1.0).omega for one in inside])
    # Each arc has one curvature: a step between two that the curve has over its length.
    assert abs(curvature - np.sin(2.0 * inside)).max() < most
    jumps = np.diff(curvature)
    against = jumps * np.cos(2.0 * inside[1:]) < 0.0
    assert abs(jumps[against]).sum() < 0.02 * abs(jumps).sum()
    assert path.arc_lengths == pytest.approx(s, abs=1e-4)


def test_the_figure_eight_is_the_lemniscate():
    path = figure_eight_path(1.0)
    u = np.linspace(0.0, 2.0 * math.pi, 100_001)
    speed = 1.0 / np.sqrt(1.0 + np.sin(u) ** 2)
    s = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2.0 * np.diff(u))])
    assert path.length == pytest.approx(s[-1], rel=1e-6)
    for place in np.linspace(0.0, path.length, 500, endpoint=False):
        at = np.interp(place * s[-1] / path.length, s, u)
        here, c = path.at(place, 1.0), 1.0 / (1.0 + math.sin(at) ** 2)
        assert here[:2] == pytest.approx(
            (c * math.sin(at) * math.cos(at), 1.0 - c * math.cos(at)), abs=2e-6
        )
        assert here.omega == pytest.approx(3.0 * math.cos(at) * math.sqrt(c), abs=0.04)


def test_positions_that_creep_are_one_position():
    """As those of a robot that stands."""
    for positions in (
        [(0, 0), (0.9e-6, 0), (1.8e-6, 0), (0, 0), (1, 0)],
        [(0, 0), (1, 0), (1, 0.9e-6), (1, 1.8e-6), (1, 0), (2, 0)],
    ):
        path = Path(np.array(positions, dtype=float))
        assert path.length == pytest.approx(positions[-1][0], abs=1e-5)
        for s in np.linspace(0.0, path.length, 50):
            assert np.isfinite(path.at(s, 1.0)).all()
    once, twice = Path(circle(40)), Path(np.repeat(circle(40), 2, axis=0))
    assert_allclose(twice.arc_lengths[::2], once.arc_lengths, atol=1e-12)


def test_a_corner_stays_a_corner_and_a_line_a_line():
    square = Path([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    assert (square.length, square.closed) == (4.0, False)
    assert square.at(0.5, 1.0).theta == 0.0
    assert square.at(1.5, 1.0).theta == pytest.approx(math.pi / 2)
    # A long line that goes over into a finely sampled arc stays straight.
    joined = Path(np.concatenate([[(-10.0, 0.0)], circle(100)[:25]]))
    assert abs(joined.poses_at(np.linspace(0.0, 10.0, 100))[:, 1]).max() < 1e-12


def test_the_nearest_point_stays_on_its_branch():
    path = figure_eight_path(1.0)
    s = np.linspace(0.0, path.length, 400, endpoint=False)
    x, y, theta = path.poses_at(s).T
    for off in (-0.1, 0.0, 0.1):
        beside = np.stack([x - off * np.sin(theta), y + off * np.cos(theta)], -1)
        assert_allclose(path.project(beside), s, atol=1e-3)
    # On the whole path the other branch is nearer to some of these.
    assert max(abs(np.array([path.nearest(*one) for one in beside.tolist()]) - s)[1:-1]) > 1.0


def test_progress_on_a_closed_path_goes_on():
    path = Path(circle(60))
    angle = np.linspace(-0.3, 4.0 * math.pi, 300)
    inside = np.stack([0.9 * np.sin(angle), 1.0 - 0.9 * np.cos(angle)], -1)
    assert_allclose(path.project(inside), angle, atol=1e-9)
    assert_allclose(path.at(path.length + 1.0, 1.0)[:7], path.at(1.0, 1.0)[:7], atol=1e-9)
    assert path.nearest(0.0, -0.2) == pytest.approx(0.0, abs=1e-12)


def test_open_ends():
    path = Path([(0, 0), (1, 0), (2, 0)])
    assert path.at(5.0, 0.3)[:3] == (2.0, 0.0, 0.0)
    assert path.at(-5.0, 0.3)[:3] == (0.0, 0.0, 0.0)
    assert path.nearest(9.0, 1.0) == path.nearest(9.0, 1.0, near=7.0) == 2.0
    assert path.nearest(1.4, 3.0, near=1.2) == pytest.approx(1.4)


def test_errors_are_in_the_frame_of_the_reference():
    reference = Path([(0, 0), (0, 1)]).at(0.5, 0.2)
    along, across, heading = Path.errors((-0.1, 0.7, math.pi), reference)
    assert (along, across, heading) == pytest.approx((0.2, 0.1, math.pi / 2))
    batch = Path.errors(np.tile([-0.1, 0.7, math.pi], (4, 1)), reference)
    assert_allclose(batch.across, [0.1] * 4)


def test_a_path_gets_times_by_a_speed():
    path = Path(np.array([(0, 0), (0, 0), (1, 0), (1, 0), (1, 2)], dtype=float))
    timed = path.timed(0.5)
    assert timed.times.tolist() == pytest.approx(path.arc_lengths[[0, 2, 4]] / 0.5)
    assert timed.poses.tolist() == path.poses[[0, 2, 4]].tolist()
    with pytest.raises(ValueError, match='speed must be positive'):
        path.timed(0.0)


def test_a_trajectory_keeps_its_times_and_its_pauses():
    angle = np.linspace(0.0, 1.5, 16)
    t = angle / 0.4
    path = Path(circle(16, turns=1.5 / (2 * math.pi)), t + 100.0)
    assert path.duration == pytest.approx(t[-1])
    for at in np.linspace(0.0, t[-1], 20, endpoint=False):
        here = path.at_time(at)
        assert (here.s, here.v, here.omega) == pytest.approx((0.4 * at, 0.4, 0.4))
        assert math.hypot(here.ax, here.ay) == pytest.approx(0.16)
    end = math.sin(1.5), 1.0 - math.cos(1.5), 1.5
    assert path.at_time(99.0)[:5] == pytest.approx((*end, 0.0, 0.0))
    paused = Path([(0, 0), (1, 0), (1, 0), (2, 0.5)], [0, 2, 3, 5])
    assert paused.at_time(2.5)[:5] == pytest.approx((*paused.poses_at(paused.arc_lengths[1]), 0.0, 0.0))
    speeds = [paused.at_time(at).v for at in np.linspace(0.0, 5.0, 100)]
    assert min(speeds) >= 0.0
    assert max(abs(np.diff(speeds)[:-1])) < 0.1
    h = 1e-6
    for at in (0.3, 1.7, 3.2, 4.4):
        before, here, after = (paused.at_time(at + d) for d in (-h, 0.0, h))
        assert (after.s - before.s) / (2 * h) == pytest.approx(here.v, abs=1e-8)
        first, last = (
            one.v * np.array([math.cos(one.theta), math.sin(one.theta)]) for one in (before, after)
        )
        assert_allclose((last - first) / (2 * h), [here.ax, here.ay], atol=1e-6)


BAD = [
    ([(1, 1, 0)] * 5, None, 'two different positions, got 5 in one place'),
    ([(0, 0, 0), (math.nan, 0, 0)], None, 'poses must be finite'),
    ([(0, 0), (1e308, 0), (-1e308, 0)], None, 'finite length'),
    ([[(0, 0), (1, 0)]], None, 'shape'),
    ([0, 1], None, 'shape'),
    ([(0, 0), (1, 0), (2, 0)], [0, 2, 1], 'got 1 s after 2 s at index 2'),
    ([(0, 0), (1, 0)], [0, 0], 'times must increase'),
    ([(0, 0), (1, 0)], [0, 1, 2], 'as many as poses'),
]


def test_invalid_arguments_are_refused_and_a_path_is_immutable():
    for poses, times, message in BAD:
        with pytest.raises(ValueError, match=message):
            Path(poses, times)
    path = Path(circle(20))
    with pytest.raises(ValueError, match='read-only'):
        path.poses[0, 0] = 1.0
    with pytest.raises(ValueError, match='path must have times'):
        path.at_time(0.0)
    with pytest.raises(ValueError, match='s must be finite'):
        path.at(math.nan, 1.0)
