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

"""Arms in space: published robots, differences, adjoint, planar arms, inverse kinematics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from diffdrive_jacobian.control import resolved_rate
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.kinematics.spatial import (
    pose_vector,
    pose_vector_difference,
    pose_vector_displacement,
    spatial_displacement,
)
from diffdrive_jacobian.kinematics.spatial_arm import IIWA, PANDA, UR5, SpatialArm

pytestmark = pytest.mark.slow
STANFORD = SpatialArm(
    a=0.0,
    alpha=[-np.pi / 2, np.pi / 2, 0.0, -np.pi / 2, np.pi / 2, 0.0],
    d=[0.412, 0.154, 0.0, 0.0, 0.0, 0.263],
    prismatic=(2,),
)
"""The arm of Scheinman 1969: its third joint slides."""
ARMS = {'UR5': UR5, 'Panda': PANDA, 'iiwa': IIWA, 'Stanford': STANFORD}
every_arm = pytest.mark.parametrize('arm', ARMS.values(), ids=ARMS)
every_robot = pytest.mark.parametrize('arm', [UR5, PANDA, IIWA], ids=list(ARMS)[:3])


def configurations(arm, count=50):
    return np.random.default_rng(5).uniform(-2.0, 2.0, (count, arm.joints))


# --- Poses

ZERO = {
    'UR5': (UR5, [-0.81725, -0.19145, -0.005491], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    'Panda': (PANDA, [0.088, 0.0, 0.926], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
    'iiwa': (IIWA, [0.0, 0.0, 1.306], np.eye(3)),
}


@pytest.mark.parametrize('name', ZERO)
def test_published_robots_are_where_their_makers_say_at_zero(name):
    arm, position, rotation = ZERO[name]
    T = arm.forward_kinematics(np.zeros(arm.joints))
    np.testing.assert_allclose(T[:3, 3], position, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], rotation, rtol=0.0, atol=1e-12)


@every_arm
def test_a_pose_is_the_product_of_the_links(arm):
    q = configurations(arm, 1)[0]
    T = np.eye(4)
    for a, alpha, d, theta, slides, q_i in zip(
        arm.a, arm.alpha, arm.d, arm.theta, arm.slides, q, strict=True
    ):
        d, theta = (d + q_i, theta) if slides else (d, theta + q_i)
        turn, twist, along, across = np.eye(4), np.eye(4), np.eye(4), np.eye(4)
        turn[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
        twist[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
        along[2, 3], across[0, 3] = d, a
        T = T @ turn @ along @ across @ twist
    np.testing.assert_allclose(arm.forward_kinematics(q), T, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(arm.joint_positions(q)[-1], T[:3, 3], rtol=0.0, atol=1e-14)
    assert arm.joint_positions(q)[0].tolist() == [0.0, 0.0, 0.0]


# --- Jacobians


@every_arm
def test_the_jacobian_is_the_derivative_of_the_pose(arm):
    """Position and rotation, by central differences, of 50 configurations at once."""
    q, step = configurations(arm), 1e-5
    J = arm.jacobian(q)
    assert J.shape == (50, 6, arm.joints)
    for joint in range(arm.joints):
        by = step * np.eye(arm.joints)[joint]
        before, after = (pose_vector(arm.forward_kinematics(q + sign * by)) for sign in (-1.0, 1.0))
        moved = pose_vector_difference(after, before) / (2.0 * step)
        np.testing.assert_allclose(J[..., joint], moved, rtol=0.0, atol=1e-9)


@every_arm
def test_the_jacobians_of_both_frames_are_adjoint(arm):
    """Of base and end effector: the same velocity, seen from either."""
    q = configurations(arm)
    R = arm.forward_kinematics(q)[:, :3, :3]
    adjoint = np.zeros((50, 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = R
    np.testing.assert_allclose(adjoint @ arm.jacobian(q, 'end'), arm.jacobian(q), rtol=0.0, atol=1e-14)


@every_arm
def test_torques_are_the_transpose_of_the_jacobian_times_the_wrench(arm):
    q, wrench = configurations(arm), np.random.default_rng(6).normal(size=(50, 6))
    expected = np.einsum('kin,ki->kn', arm.jacobian(q), wrench)
    np.testing.assert_allclose(arm.joint_torques(q, wrench), expected, rtol=0.0, atol=1e-12)


# --- Redundancy


def test_the_elbow_moves_while_the_hand_stays():
    q = np.radians([0.0, 30.0, 0.0, -90.0, 0.0, 60.0, 0.0])
    T, elbow = IIWA.forward_kinematics(q), IIWA.joint_positions(q)[3]
    for _ in range(200):
        J = IIWA.jacobian(q)
        e = pose_vector_difference(pose_vector(T), pose_vector(IIWA.forward_kinematics(q)))
        q_dot = resolved_rate(J, np.zeros(6), e, np.zeros(6), gain=20.0, q_dot_0=np.eye(7)[2])
        q = IIWA.integrate(q, q_dot, 0.01)
    assert np.linalg.norm(spatial_displacement(T, IIWA.forward_kinematics(q))) < 1e-4
    assert np.linalg.norm(IIWA.joint_positions(q)[3] - elbow) > 0.15


# --- Inverse kinematics


@every_arm
def test_reachable_poses_are_reached_within_the_limits_of_the_arm(arm):
    arm = dataclasses.replace(arm, limits=(-1.0, 1.0)) if arm is STANFORD else arm
    lower, upper = arm.limits
    rng = np.random.default_rng(8)
    q, q0 = rng.uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (2, 100, arm.joints))
    target = arm.forward_kinematics(q)
    result = arm.inverse_kinematics(target, q0)
    assert result.converged.all()
    assert np.abs(spatial_displacement(target, arm.forward_kinematics(result.q))).max() < 2e-6
    assert np.all((result.q >= lower) & (result.q <= upper))
    # Others may be given.
    narrow = result.q[0] + 0.01, result.q[0] + 0.02
    assert not arm.inverse_kinematics(target[0], q0[0], limits=narrow, restarts=0).converged


MASKS = {
    'rotations about one axis': [1, 1, 1, 0, 0, 1],
    'unequal weights': [1, 1, 1, 0.1, 1, 10],
    'two rotations': [0, 0, 0, 1, 1, 0],
    'a direction': [1, 1, 1, 1, 1, 0],
    'a position': [1, 1, 1, 0, 0, 0],
}


@pytest.mark.parametrize('frame', ['base', 'end'])
@pytest.mark.parametrize('mask', MASKS.values(), ids=MASKS)
@every_robot
def test_parts_of_a_pose_are_reached(arm, mask, frame):
    rng = np.random.default_rng(8)
    lower, upper = arm.limits
    q, q0 = rng.uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (2, 8, arm.joints))
    target = arm.forward_kinematics(q)
    result = arm.inverse_kinematics(target, q0, frame, mask=mask)
    assert result.converged.all()
    assert np.mean(result.iterations) < 100
    reached = arm.forward_kinematics(result.q)
    if frame == 'base':
        missing = pose_vector_difference(pose_vector(target), pose_vector(reached))
    else:
        missing = spatial_displacement(reached, target)
    assert np.linalg.norm(np.sqrt(mask) * missing, axis=-1).max() < 1.1e-6


def test_one_angle_is_reached_from_a_start_where_another_error_would_stop_the_search():
    q = [3.135, -1.494, 2.193, 0.664, 1.923, 0.819]
    q0 = [0.311, 2.422, 2.335, -2.311, -1.225, -0.579]
    target = UR5.forward_kinematics(q)
    assert UR5.inverse_kinematics(target, q0, mask=[0, 0, 0, 0, 0, 1], restarts=0).converged


# --- Pose vectors


def test_differences_of_pose_vectors_are_displacements_of_poses():
    """In the axes of the base or of the end effector."""
    T, T_desired = (UR5.forward_kinematics(configurations(UR5) + by) for by in (0.0, 0.5))
    delta = spatial_displacement(T, T_desired)
    in_base = np.einsum('kij,kpj->kpi', T[:, :3, :3], delta.reshape(50, 2, 3)).reshape(50, 6)
    vectors = pose_vector(T_desired), pose_vector(T)
    np.testing.assert_allclose(pose_vector_difference(*vectors), in_base, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(pose_vector_displacement(*vectors), delta, rtol=0.0, atol=1e-12)


# --- Arguments


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'a': [1.0, 2.0]}, r'must have one shape \(n,\), with n >= 1, got a \(2,\), alpha \(1,\)'),
        ({'alpha': 0.0, 'a': 0.0}, r'must have one shape \(n,\), with n >= 1, got a \(\)'),
        ({'a': [[1.0]]}, 'must have one shape'),
        ({'a': [], 'alpha': []}, 'must have one shape'),
        ({'a': [np.nan]}, 'a must be finite'),
        ({'prismatic': (1,)}, 'prismatic must be an integer from 0 to 0'),
        ({'limits': (1.0, -1.0)}, 'limits must be .* lower <= upper'),
        ({'limits': (np.inf, np.inf)}, 'limits must be .* got .*inf'),
        ({'limits': [[-1.0, 1.0]]}, 'limits must be a pair'),
        ({'limits': ([1.0, 1.0], 2.0)}, r'shape \(\) or \(1,\)'),
        ({'limits': 1.0}, 'limits must be a pair'),
    ],
)
def test_wrong_parameters_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        SpatialArm(**{'a': [1.0], 'alpha': [0.0], 'd': 0.0} | changes)


@pytest.mark.parametrize(
    ('call', 'words'),
    [
        (lambda: UR5.jacobian(np.zeros(6), 'tool'), "frame must be one of 'base', 'end', got 'tool'"),
        (lambda: UR5.jacobian(np.zeros(7)), r'q must have shape \(..., 6\)'),
        (lambda: UR5.joint_torques(np.zeros(6), np.zeros(3)), r'wrench must have shape \(..., 6\)'),
        (lambda: UR5.inverse_kinematics(np.ones((4, 4)), np.zeros(6)), 'target must be'),
        (lambda: UR5.inverse_kinematics(np.eye(3), np.zeros(6)), r'target must have .* 4, 4\)'),
        (lambda: UR5.inverse_kinematics(np.eye(4), np.zeros(5)), r'q0 must have shape \(..., 6\)'),
        (lambda: UR5.inverse_kinematics(np.eye(4), np.zeros(6), 'tool'), 'frame must be one of'),
    ],
)
def test_wrong_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_arms_are_immutable_and_compared_and_copied_by_their_parameters():
    same, other = dataclasses.replace(UR5), dataclasses.replace(UR5, d=0.1)
    assert (same, hash(same)) == (UR5, hash(UR5))
    assert UR5 not in (other, dataclasses.replace(UR5, limits=None))
    assert dataclasses.replace(UR5, prismatic=(2,)).slides.tolist() == [0, 0, 1, 0, 0, 0]
    with pytest.raises(ValueError, match='read-only'):
        UR5.a[0] = 1.0
    assert PlanarArm([1.0, 0.5]) == PlanarArm(np.array([1.0, 0.5])) != PlanarArm([1.0, 0.6])
