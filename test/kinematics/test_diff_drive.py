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

"""The differential drive: the chain of its Jacobians, its constraints, its wheel centres.

Laws are checked for one batch of random robots. Wheels stand right, left.
"""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.kinematics import diff_drive as dd
from diffdrive_jacobian.kinematics import rigid_body

COUNT = 200
RNG = np.random.default_rng(1)
THETA = RNG.uniform(-np.pi, np.pi, COUNT)
R, L = 10.0 ** RNG.uniform(-3.0, 1.0, (2, COUNT))
SPEEDS = RNG.uniform(-100.0, 100.0, (COUNT, 2))
S, A = dd.unicycle_jacobian(THETA), dd.no_lateral_slip_constraint(THETA)
J_W, J_W_INVERSE = dd.wheel_to_body_jacobian(R, L), dd.body_to_wheel_jacobian(R, L)
CHAIN = dd.wheel_to_world_jacobian(THETA, R, L)


def times(matrices, vectors):
    return (matrices @ vectors[..., np.newaxis])[..., 0]


def close(actual, expected, scale=1.0):
    """Compare with the rounding of numbers of a size, which may differ from robot to robot."""
    error = np.abs(actual - expected).reshape(COUNT, -1).max(axis=-1)
    assert np.all(error <= 1e-13 * scale)


def test_the_unicycle_jacobian_has_orthonormal_columns_for_every_heading():
    close(np.swapaxes(S, 1, 2) @ S, np.eye(2))


def test_the_matrices_and_the_scalar_forms_undo_each_other_and_make_the_chain():
    condition = np.linalg.cond(J_W)
    close(J_W @ J_W_INVERSE, np.eye(2), condition)
    close(CHAIN, S @ J_W, np.abs(J_W).max(axis=(1, 2)))
    for forward, back, J in (
        (dd.wheel_to_body, dd.body_to_wheel, J_W),
        (dd.body_to_wheel, dd.wheel_to_body, J_W_INVERSE),
    ):
        there = forward(*SPEEDS.T, R, L)
        close(np.stack(there, axis=-1), times(J, SPEEDS), np.linalg.norm(J, axis=(1, 2)) * 100.0)
        close(np.stack(back(*there, R, L), axis=-1), SPEEDS, condition * 100.0)


def test_what_does_not_slip_sideways_is_what_the_unicycle_can_do():
    assert A.shape == (COUNT, 1, 3)
    close(A @ S, 0.0)
    # Projectors on the null space of the row and on the range of S, whose columns are orthonormal.
    close(np.eye(3) - np.swapaxes(A, 1, 2) @ A, S @ np.swapaxes(S, 1, 2))


def test_rolling_of_both_wheels_is_the_chain():
    A_q, A_w = dd.rolling_constraints(THETA, R, L)
    close(A_q @ CHAIN, A_w, R)
    close(np.linalg.solve(A_q, A_w), CHAIN, np.linalg.cond(A_q) * R)


def test_the_wheel_centres_roll_forward_and_the_axle_centre_is_half_way():
    poses = np.column_stack([RNG.uniform(-3.0, 3.0, (COUNT, 2)), THETA])
    right, left = np.moveaxis(dd.wheel_centres(poses, L), 1, 0)
    close((right + left) / 2.0, poses[:, :2], 10.0 + L)
    close(right - left, L[:, np.newaxis] * A[:, 0, :2], 10.0 + L)
    velocities = dd.wheel_centre_velocities(THETA, times(CHAIN, SPEEDS), L)
    close(times(velocities, S[:, :2, 0]), R[:, np.newaxis] * SPEEDS, 1e3 * R)


def test_the_velocities_of_the_wheel_centres_are_those_of_a_rigid_body():
    """Also of a robot that slips: by differences of the centres."""
    q_dot = RNG.uniform(-100.0, 100.0, (COUNT, 3))
    poses = np.column_stack([np.zeros((COUNT, 2)), THETA])
    velocities = dd.wheel_centre_velocities(THETA, q_dot, L)
    ahead, behind = (dd.wheel_centres(poses + sign * 1e-6 * q_dot, L) for sign in (1, -1))
    np.testing.assert_allclose(velocities, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-4)


def test_the_velocity_of_a_point_of_a_rigid_body():
    v, omega, first, second = RNG.uniform(-100.0, 100.0, (4, COUNT, 3))
    at_first = rigid_body.point_velocity(v, omega, first)
    close(at_first, v + np.cross(omega, first), 1e5)
    # From P to Q and on to R is from P to R; the distance of two points does not change.
    at_second = rigid_body.point_velocity(at_first, omega, second)
    close(at_second, rigid_body.point_velocity(v, omega, first + second), 1e5)
    close(np.sum((at_second - at_first) * second, axis=-1), 0.0, 1e7)
