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

"""The parts of the calibration: motion of the wheels with its Jacobian, encoders, linear equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_data import NOMINAL, TRUE, Drive, Simulation, stepped, umbmark, with_stops

from diffdrive_jacobian.calibration import Noise
from diffdrive_jacobian.calibration.block_tridiagonal import solve_block_tridiagonal
from diffdrive_jacobian.calibration.encoders import PERIOD, between_readings, densified
from diffdrive_jacobian.calibration.motion import composed, increments, inverted, relative
from diffdrive_jacobian.kinematics.se2 import adjoint


def random_wheels(random, count=40):
    time = np.cumsum(random.uniform(0.01, 0.1, count))
    return time, np.cumsum(random.uniform(-1.0, 2.0, (count, 2)), axis=0)


def test_jacobian_of_the_motion_equals_finite_differences():
    random = np.random.default_rng(1)
    time, angles = random_wheels(random)
    at = np.sort(random.uniform(time[0], time[-1], 9))
    found = increments(time, angles, at, replace(NOMINAL, multipliers=TRUE))
    h = 1e-6
    for index in range(3):
        ends = []
        for sign in (1.0, -1.0):
            factors = np.array(TRUE)
            factors[index] *= np.exp(sign * h)
            changed = replace(NOMINAL, multipliers=tuple(factors))
            ends.append(relative(found.steps, increments(time, angles, at, changed).steps))
        difference = (ends[0] - ends[1]) / (2.0 * h)
        np.testing.assert_allclose(found.jacobian[:, :, index], difference, atol=1e-8)


def test_steps_do_not_depend_on_where_they_are_divided():
    time, angles = random_wheels(np.random.default_rng(2))
    at = np.linspace(time[0], time[-1], 7)
    once = increments(time, angles, at[[0, -1]], NOMINAL)
    many = increments(time, angles, at, NOMINAL)
    pose, jacobian, covariance = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for step, own, noise in zip(many.steps, many.jacobian, many.covariance, strict=True):
        back = adjoint(inverted(step))
        pose = composed(pose, step)
        jacobian = back @ jacobian + own
        covariance = back @ covariance @ back.T + noise
    np.testing.assert_allclose(pose, once.steps[0], atol=1e-12)
    np.testing.assert_allclose(jacobian, once.jacobian[0], atol=1e-12)
    np.testing.assert_allclose(covariance, once.covariance[0], rtol=1e-2, atol=1e-3)


def test_covariance_of_the_motion_is_that_of_simulated_wheels():
    random = np.random.default_rng(3)
    drive = Drive.of([(4.0, 0.2, 0.6)])
    noise = Noise(wheel=1e-6, position=0.0, heading=0.0)
    robot = Simulation(drive=drive, noise=noise, multipliers=(1.0, 1.0, 1.0))
    ends = np.array([relative(*robot.truth(random)[[0, -1]]) for _ in range(1000)])
    found = increments(drive.time, drive.angles, drive.time[[0, -1]], NOMINAL)
    off = relative(np.broadcast_to(found.steps[0], ends.shape), ends)
    nees = np.einsum('ni,ij,nj->n', off, np.linalg.inv(found.covariance[0] * noise.wheel), off)
    assert 2.8 < nees.mean() < 3.2


@pytest.mark.parametrize('count', [1, 2, 3, 8, 13])
def test_cyclic_reduction_equals_dense_linear_algebra(count):
    random = np.random.default_rng(count)
    diagonal, upper = random.standard_normal((count, 3, 3)), random.standard_normal((count - 1, 3, 3))
    diagonal = diagonal @ np.swapaxes(diagonal, 1, 2) + 12.0 * np.eye(3)
    right = random.standard_normal((count, 3, 4))
    dense = np.zeros((count, 3, count, 3))
    for i in range(count):
        dense[i, :, i] = diagonal[i]
    for i in range(count - 1):
        dense[i, :, i + 1], dense[i + 1, :, i] = upper[i], upper[i].T
    dense = dense.reshape(3 * count, 3 * count)
    solution, logarithm = solve_block_tridiagonal(diagonal, upper, right)
    np.testing.assert_allclose(solution.reshape(-1, 4), np.linalg.solve(dense, right.reshape(-1, 4)))
    assert logarithm == pytest.approx(np.linalg.slogdet(dense)[1])


def test_wheels_are_located_between_the_steps_of_their_encoders():
    steps, random = 16, np.random.default_rng(20)
    drive = Drive.of(with_stops(umbmark(side=2.0)))
    for readings, angles in zip(stepped(drive.angles, steps, random).T, drive.angles.T, strict=True):
        # Angles that change with each sample are taken as they are.
        found, deviation = between_readings(drive.time, angles)
        np.testing.assert_allclose(found, angles, atol=1e-12)
        assert not deviation.any()
        found, deviation = between_readings(drive.time, readings)
        largest = deviation.max()
        assert largest == pytest.approx(2.0 * np.pi / steps / 12.0**0.5)
        error = found - angles - np.mean((found - angles)[deviation == 0.0])
        # Wheels that pass a step with each sample are located better than stated.
        assert 0.5 * largest < error[deviation == largest].std() < 1.2 * largest
        assert error[deviation == 0.0].std() < 0.5 * largest


def test_a_wheel_that_turns_back_is_somewhere_within_the_step():
    time = np.arange(100) * 0.02
    # It turns back in the middle of a step, as long as it takes for any other.
    angles = 0.095 - np.abs(time - 0.99) * 0.1
    _, deviation = between_readings(time, np.round(angles, 2))
    uncertain = np.flatnonzero(deviation)
    assert 2 <= len(uncertain) <= 12
    assert uncertain.mean() == pytest.approx(49.5, abs=1.0)


def test_wheels_at_4_hz_are_interpolated():
    """The rates of a robot with finite accelerations change little between the samples."""
    time = np.arange(0.0, 20.0, 0.25)
    angles = np.column_stack([-np.cos(time), np.sin(0.7 * time) / 0.7])
    dense, found = densified(time, angles)
    assert np.diff(dense).max() <= PERIOD * (1.0 + 1e-9)
    true = np.column_stack([-np.cos(dense), np.sin(0.7 * dense) / 0.7])
    linear = np.column_stack([np.interp(dense, time, one) for one in angles.T])
    assert np.std(found - true) < 0.3 * np.std(linear - true)
