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

"""The exact moments of odometry's error: against a matrix exponential, and in Monte Carlo."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from support.moments_reference import DRIVES, noisy_runs, reference

from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.exact_moments import gaussian, propagate_moments
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance

L, K = 0.16, 1e-5
START = np.array([0.7, -1.2, 0.4])
COVARIANCE = 1e-3 * np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 9.0]])
SURE = gaussian(np.zeros((3, 3)))
SECOND = 10**9
# v, omega, duration: straight, both sides of the series' end, in place, one wheel at rest, long.
ARCS = [
    *((0.2, omega, 4.0) for omega in (0.0, 1e-12, -1e-6, 0.0124, -0.0126, 2.0)),
    *((-0.2, omega, 4.0) for omega in (0.0, 1e-3)),
    *((0.0, omega, 4.0) for omega in (1e-12, -1.0)),
    *((0.08, 1.0, duration) for duration in (1e-9, 0.02, 0.0499, 0.0501, 5.0)),
    *((0.22, omega, 300.0) for omega in (0.0, 1e-4, 0.5)),
    *((0.22, 0.0, 1e-9), (0.0, 0.0, 1.0)),
]


def scales(moments):
    """What rounding errors are measured by: positions by the larger axis, for they are rotated."""
    position = math.sqrt(moments.xx + moments.yy)
    heading = math.sqrt(moments.tt)
    trigonometric = position * min(heading, 1.0)
    return np.array(
        [
            *(position**2, position**2, position * heading, position**2, position * heading),
            *(heading**2, *[trigonometric] * 6),
        ]
    )


def positive_semidefinite(moment, tolerance=1e-12):
    assert np.array_equal(moment, moment.T)
    assert np.all(np.diag(moment) >= 0.0)
    deviations = np.sqrt(np.maximum(np.diag(moment), 1e-300))
    assert np.linalg.eigvalsh(moment / np.outer(deviations, deviations)).min() >= -tolerance


STARTS = {
    'sure': SURE,
    'unsure': gaussian(COVARIANCE),
    'heading': gaussian(np.diag([0.0, 0.0, 1.0])),
    # That of an arc, which is not Gaussian.
    'arc': propagate_moments(gaussian(COVARIANCE), np.zeros(3), (0.22, 0.3), 20.0, L, 1e-2),
}


@pytest.mark.parametrize('name', STARTS)
def test_the_closed_form_solves_the_differential_equation(name):
    """A matrix exponential in extended precision is the reference."""
    start, noise = STARTS[name], (K, 1e-2) if name == 'sure' else (0.0, K, 1e-2)
    for (v, omega, duration), k in itertools.product(ARCS, noise):
        actual = propagate_moments(start, START, (v, omega), duration, L, k)
        expected = reference(start, START[2], (v, omega), duration, L, k)
        error = np.abs(np.subtract(actual, expected))
        assert np.all(error <= 1e-12 * scales(actual)), (v, omega, duration, k, error / scales(actual))
        positive_semidefinite(actual.second_moment)


def test_for_small_noise_it_is_the_first_order_form():
    k, covariance = 1e-12, 1e-9 * COVARIANCE
    for v, omega, duration in [arc for arc in ARCS if arc[2] < 100.0]:
        exact = propagate_moments(gaussian(covariance), START, (v, omega), duration, L, k)
        first = propagate_covariance(covariance, START, (v, omega), duration, L, k)
        deviations = np.sqrt(np.diag(first))
        error = np.abs(exact.second_moment - first)
        assert np.all(error <= 1e-7 * np.outer(deviations, deviations))


def test_far_from_the_origin_nothing_cancels():
    robots = []
    for place in (0.0, 1e6):
        rng, stamp = np.random.default_rng(3), 0
        pose = np.array([place, -place, 0.3])
        robot = Robot(model=RobotModel(), stamp=0, pose=pose, covariance=COVARIANCE)
        for v, omega in rng.normal(0.0, [0.3, 1.0], (30, 2)).tolist():
            stamp += SECOND // 7
            robot = robot.commanded((v, omega), stamp)
            positive_semidefinite(robot.at(stamp + 1).covariance)
        robots.append(robot.at(stamp + 10 * SECOND))
    assert np.array_equal(robots[0].covariance, robots[1].covariance)


def test_the_first_million_metres_are_positive_semidefinite():
    for duration, omega in itertools.product((1e3, 1e4, 1e5, 1e6), (0.0, 1e-6, 1e-3, 0.5)):
        moments = propagate_moments(SURE, np.zeros(3), (1.0, omega), duration, L, K)
        positive_semidefinite(moments.second_moment)


def test_what_is_no_covariance_or_overflows_raises_an_error():
    with pytest.raises(ValueError, match='overflows'):
        propagate_moments(SURE, START, (1e200, 0.0), 1e10, L, K)
    with pytest.raises(ValueError, match='positive semidefinite'):
        gaussian(-COVARIANCE)
    with pytest.raises(ValueError, match=r'covariance must have shape \(3, 3\)'):
        gaussian(np.zeros((2, 3, 3)))


@pytest.mark.parametrize(
    ('name', 'covariance'), [('arc', np.zeros((3, 3))), ('stop and go', COVARIANCE)], ids=str
)
def test_the_moments_are_those_of_two_thousand_noisy_runs(name, covariance):
    count, drive = 2000, DRIVES[name](60.0)
    moments, pose = gaussian(covariance), np.zeros(3)
    for twist, duration in drive:
        moments = propagate_moments(moments, pose, twist, duration, L, K)
        pose = integrate(pose, twist, duration)
    errors = noisy_runs(np.random.default_rng(7), drive, covariance, count, L, K)
    # Products of the errors x, y, theta with each other, with cos - 1 and with sin; and the errors.
    turned = errors[:, 2]
    trigonometric = {'c': np.cos(turned) - 1.0, 's': np.sin(turned)}
    of = dict(zip('xyt', errors.T, strict=True)) | trigonometric
    for field, expected in zip(moments._fields, moments, strict=True):
        products = np.prod([of[letter] for letter in field], axis=0)
        assert abs(products.mean() - expected) < 5.0 * products.std() / math.sqrt(count) + 1e-15, field
