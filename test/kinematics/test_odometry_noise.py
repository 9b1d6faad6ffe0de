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

"""The covariance of odometry: what it is over a short time, and that a drive is many short ones.

That noisy wheels have it, test/simulation/test_exact_moments.py shows.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.kinematics.diff_drive import unicycle_jacobian
from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance, twist_covariance

L, K = 0.16, 1e-5
START = np.array([0.7, -1.2, 0.4])
COVARIANCE = np.array([[4e-4, 1e-4, -2e-4], [1e-4, 2e-4, 5e-5], [-2e-4, 5e-5, 9e-4]])
# v, omega, duration: straight, next to straight, both sides of the series' end, spins, large turns.
ARCS = [
    *((v, omega, 4.0) for v in (0.2, -0.2) for omega in (0.0, 1e-12, 1e-3, -0.2499, 0.2501, 2.0)),
    *((0.0, omega, 4.0) for omega in (1e-12, -1.0, 12.5)),
    *((v, -2.5, 20.0) for v in (0.3, -0.01)),
    *((1.0, omega, 3.0) for omega in (12.5, -12.6)),  # one wheel (almost) at rest, or backwards
    *((0.5, 0.3, duration) for duration in (0.0, 1e-9)),
]
TWISTS, DURATIONS = np.array(ARCS)[:, :2], np.array(ARCS)[:, 2]


def spectral_density(v, omega):
    """W: `B diag(K |v_R|, K |v_L|) B^T`, from the rim speeds."""
    B = np.array([[0.5, 0.5], [1.0 / L, -1.0 / L]])
    rim_speeds = np.array([v + omega * L / 2.0, v - omega * L / 2.0])
    return B @ np.diag(K * np.abs(rim_speeds)) @ B.T


def propagated(covariance, pose, twist, duration, k=K):
    return propagate_covariance(covariance, pose, twist, duration, L, k)


def close(actual, expected, tolerance=1e-13):
    """Compare by what rounding errors are measured by: positions by the larger axis, as they rotate."""
    variances = np.diagonal(expected, axis1=-2, axis2=-1)
    deviations = np.sqrt(variances[..., [0, 0, 2]] + variances[..., [1, 1, 2]] * [1.0, 1.0, 0.0])
    scales = deviations[..., :, np.newaxis] * deviations[..., np.newaxis, :]
    assert np.all(np.abs(actual - expected) <= tolerance * scales)


def test_over_a_short_time_it_grows_by_the_density_of_the_wheels():
    for twist in TWISTS:
        S = unicycle_jacobian(START[2])
        grown = propagated(np.zeros((3, 3)), START, twist, 1e-9)
        close(grown, S @ spectral_density(*twist) @ S.T * 1e-9, 1e-7)


@pytest.mark.parametrize('start', [np.zeros((3, 3)), COVARIANCE], ids=['certain', 'uncertain'])
def test_a_drive_is_its_parts_one_after_the_other(start):
    whole, pose, parts = propagated(start, START, TWISTS, DURATIONS), START, start
    for part in (0.1, 0.0, 0.6, 0.3):
        parts = propagated(parts, pose, TWISTS, part * DURATIONS)
        pose = integrate(pose, TWISTS, part * DURATIONS)
    close(whole, parts)
    assert np.array_equal(whole, np.swapaxes(whole, 1, 2))


def test_without_noise_the_start_is_carried_by_the_jacobian_of_the_motion():
    def reached(start):
        return integrate(start, TWISTS[:, np.newaxis], DURATIONS[:, np.newaxis])

    Phi = np.swapaxes(reached(START + 1e-6 * np.eye(3)) - reached(START - 1e-6 * np.eye(3)), 1, 2) / 2e-6
    carried = propagated(COVARIANCE, START, TWISTS, DURATIONS, k=0.0)
    close(carried, Phi @ COVARIANCE @ np.swapaxes(Phi, 1, 2), 1e-7)


def test_the_twist_covariance_is_the_density_over_the_interval():
    for twist in ((0.3, 0.0), (-0.3, 1.0), (0.0, 2.0), (0.1, -4.0)):
        actual = twist_covariance(twist, L, K, 0.02)
        np.testing.assert_allclose(actual, spectral_density(*twist) / 0.02, rtol=1e-13, atol=1e-18)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'dt': [1.0, -1.0]}, 'dt must be zero or positive'),
        ({'wheel_travel_variance': -1e-5}, 'wheel_travel_variance must be zero or positive'),
        ({'covariance': [np.eye(3), -np.eye(3)]}, 'covariance must be symmetric and positive semidef'),
        ({'covariance': [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, 'covariance must be symmetric'),
    ],
)
def test_nothing_that_gives_negative_variances_is_accepted(changes, message):
    valid = {'covariance': COVARIANCE, 'pose': START, 'twist': (0.2, 0.1), 'dt': 1.0, 'L': L}
    with pytest.raises(ValueError, match=f'^{message}'):
        propagate_covariance(**valid | {'wheel_travel_variance': K} | changes)
