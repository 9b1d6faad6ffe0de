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

"""Planar arms, alone and on a differential drive, and a wheel as a contact."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.kinematics import contact, se2
from diffdrive_jacobian.kinematics import diff_drive as dd
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

R, L = 0.033, 0.16  # document A's robot
BATCH = (4, 5)
links = pytest.mark.parametrize('n', [1, 2, 5])
two_links = pytest.mark.parametrize('lengths', [(1.0, 1.0), (2.0**0.5, 1.0), (0.01, 5.0)])


def close(actual, expected, tolerance=1e-12):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=tolerance)


def same_pose(actual, expected):
    close(actual[..., :2], expected[..., :2])
    close(se2.wrap_angle(actual[..., 2] - expected[..., 2]), 0.0)


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1)


def times(matrices, vectors):
    return (matrices @ vectors[..., np.newaxis])[..., 0]


def an_arm(n):
    """Return an arm, a batch of joint angles, some beyond a turn, and joint velocities."""
    rng = np.random.default_rng(1)
    q, q_dot = rng.uniform(-9.0, 9.0, (*BATCH, n)), rng.normal(size=(*BATCH, n))
    return PlanarArm(rng.uniform(0.1, 1.0, n)), q, q_dot


def a_robot(n):
    (arm, joints, rates), rng = an_arm(n), np.random.default_rng(2)
    robot = MobileManipulator(R, L, arm, mount=rng.uniform(-0.3, 0.3, 2))
    q = np.concatenate([rng.uniform(-3.0, 3.0, (*BATCH, 3)), joints], axis=-1)
    return robot, q, np.concatenate([rng.uniform(-9.0, 9.0, (*BATCH, 2)), rates], axis=-1)


# --- The arm


@links
def test_the_tip_is_a_chain_of_rigid_motions_through_the_joints(n):
    arm, q, _ = an_arm(n)
    chain, positions = np.zeros((*BATCH, 3)), [np.zeros((*BATCH, 2))]
    for angle, length in zip(np.moveaxis(q, -1, 0), arm.lengths, strict=True):
        turned = se2.compose(chain, angle[..., np.newaxis] * [0.0, 0.0, 1.0])
        chain = se2.compose(turned, [length, 0.0, 0.0])
        positions.append(chain[..., :2])
    same_pose(arm.forward_kinematics(q), chain)
    close(arm.joint_positions(q), np.stack(positions, axis=-2))
    assert arm.joints == n


@links
@pytest.mark.parametrize('heading', [False, True])
def test_torques_are_the_transpose_of_the_jacobian_times_the_wrench(n, heading):
    arm, q, _ = an_arm(n)
    wrench = np.random.default_rng(3).normal(size=(*BATCH, 3 if heading else 2))
    J = arm.jacobian(q, heading)
    close(arm.joint_torques(q, wrench), times(np.swapaxes(J, -1, -2), wrench))


@two_links
def test_two_links_move_the_tip_as_told_and_are_singular_by_the_sine(lengths):
    arm, rng = PlanarArm(lengths), np.random.default_rng(4)
    q = rng.uniform([-4.0, 0.1], [4.0, 3.0], (*BATCH, 2))
    x_dot = rng.normal(size=(*BATCH, 2))
    close(times(arm.jacobian(q), arm.inverse_velocity(q, x_dot)), x_dot, 1e-9)
    close(arm.determinant(q), lengths[0] * lengths[1] * np.sin(q[..., 1]))
    close(arm.determinant(q), np.linalg.det(arm.jacobian(q)))
    singular = arm.singular_configurations(q[..., 0])
    close(arm.determinant(singular), 0.0)
    reach = norm(arm.forward_kinematics(singular)[..., :2])
    close(reach, np.broadcast_to(np.abs([sum(lengths), lengths[0] - lengths[1]]), reach.shape))


@links
def test_all_links_on_one_line_are_the_singular_configurations_of_any_arm(n):
    arm = PlanarArm(np.linspace(0.3, 0.8, n))
    q = arm.singular_configurations([0.4, -2.0])
    assert q.shape == (2, 2 ** (n - 1), n)
    assert np.all(q[..., 0] == [[0.4], [-2.0]])
    assert not q[:, 0, 1:].any()  # the stretched arm first
    assert len(np.unique(q[0], axis=0)) == 2 ** (n - 1)
    close(iv.manipulability(arm.jacobian(q)), 0.0)
    # Along the line nothing moves.
    close(np.einsum('abmn,am->abn', arm.jacobian(q), [[np.cos(a), np.sin(a)] for a in (0.4, -2.0)]), 0.0)


@two_links
def test_elbow_down_and_elbow_up_put_the_tip_there_and_there_is_no_third_solution(lengths):
    arm = PlanarArm(lengths)
    q = np.random.default_rng(6).uniform(-np.pi, np.pi, (*BATCH, 2))
    down_up = arm.inverse_kinematics(arm.forward_kinematics(q)[..., :2])
    tips = arm.forward_kinematics(down_up)[..., :2]
    close(tips, np.broadcast_to(arm.forward_kinematics(q)[..., np.newaxis, :2], tips.shape))
    down, up = np.moveaxis(down_up, -2, 0)
    assert np.all(down[..., 1] >= 0.0)
    close(se2.wrap_angle(np.where(q[..., 1:] > 0.0, down, up) - q), 0.0, 1e-5)
    # The rim, up to rounding.
    for reach in (sum(lengths), abs(lengths[0] - lengths[1])):
        rim = reach * np.array([[1.0, 0.0], [np.cos(2.0), np.sin(2.0)], [-0.6, 0.8]])
        close(arm.forward_kinematics(arm.inverse_kinematics(rim)[:, 0])[:, :2], rim)


@two_links
def test_stretched_and_folded_arms_are_refused_also_after_many_turns(lengths):
    arm = PlanarArm(lengths)
    for q in ([-3.1, 0.0], [2.5, np.pi], [1000.0, -np.pi]):
        with pytest.raises(np.linalg.LinAlgError, match=r'got a determinant of'):
            arm.inverse_velocity(q, [1.0, 0.0])


def test_clearance_is_the_distance_of_the_nearest_of_many_points_of_the_arm():
    arm, rng = PlanarArm([0.5, 0.4, 0.3]), np.random.default_rng(6)
    q, obstacle = rng.uniform(-4.0, 4.0, (100, 3)), rng.uniform(-1.5, 1.5, (100, 2))
    joints, part = arm.joint_positions(q)[:, :, np.newaxis], np.linspace(0.0, 1.0, 1001)[:, np.newaxis]
    points = (joints[:, :-1] + part * (joints[:, 1:] - joints[:, :-1])).reshape(100, -1, 2)
    nearest = norm(points - obstacle[:, np.newaxis]).min(axis=-1)
    close(arm.clearance(q, obstacle), nearest, 1e-3)
    # By hand: beside the second link of an arm like an L, at 0.1 m from its middle.
    assert np.isclose(arm.clearance([0.0, np.pi / 2.0, 0.0], [0.6, 0.2]), 0.1)
    close(arm.clearance_gradient([0.0, np.pi / 2.0, 0.0], [0.6, 0.2]), [0.2, 0.2, 0.0])
    assert not arm.clearance_gradient([0.0, 0.0, 0.0], [0.3, 0.0]).any()  # it touches the first link


def test_the_cost_of_joint_limits_is_zero_in_the_middle_and_an_eighth_at_the_limits():
    lower, upper = np.array([-1.0, -2.0, -0.5]), np.array([2.0, 1.0, 2.5])
    ends = [lower, upper, np.where([True, False, True], lower, upper)]
    close(iv.joint_limit_cost(ends, lower, upper), 0.125)
    close(iv.joint_limit_cost((lower + upper) / 2.0, lower, upper), 0.0)


# --- The arm on its base


@links
def test_the_tip_of_a_mobile_manipulator_is_base_and_mount_and_arm(n):
    robot, q, _ = a_robot(n)
    mount = np.array([*robot.mount, 0.0])
    tip = se2.compose(se2.compose(q[..., :3], mount), robot.arm.forward_kinematics(q[..., 3:]))
    same_pose(robot.forward_kinematics(q), tip)
    assert MobileManipulator(R, L, robot.arm).mount.tolist() == [0.0, 0.0]


@links
def test_one_step_is_many_and_the_base_drives_as_if_alone(n):
    robot, q, q_dot = a_robot(n)
    here, there = q, robot.integrate(q, q_dot, 1.0)
    for _ in range(20):
        here = robot.integrate(here, q_dot, 0.05)
    same_pose(here, there)
    v, omega = dd.wheel_to_body(q_dot[..., 0], q_dot[..., 1], R, L)
    same_pose(there, se2.integrate(q[..., :3], np.stack([v, omega], axis=-1), 1.0))
    # Joints go on turning, on an arm alone, too.
    close(there[..., 3:], q[..., 3:] + q_dot[..., 2:])
    alone = robot.arm.integrate(q[..., 3:], q_dot[..., 2:], np.arange(5.0))
    close(alone[:, 3], q[:, 3, 3:] + 3.0 * q_dot[:, 3, 2:])


# --- The wheel as a contact


def test_the_point_at_the_ground_stands_still_where_the_wheel_rolls():
    r, phi = np.array([[0.01], [R], [2.0]]), np.linspace(-3.0, 3.0, 7)
    rolling = contact.rolling_direction(r)
    close(times(contact.wheel_contact_jacobian(contact.AT_GROUND, r), rolling), 0.0, 1e-15)
    close(contact.wheel_contact_position(0.7, contact.AT_GROUND, r), [[[0.7, 0.0, 0.0]]] * 3, 1e-15)
    assert norm(times(contact.wheel_contact_jacobian(phi, r), rolling)).min() > 1e-4
    hub = np.stack([0.7 + 0.0 * r, r, 0.0 * r], axis=-1)
    close(norm(contact.wheel_contact_position(0.7, phi, r) - hub), np.broadcast_to(r, (3, 7)))
    top = contact.wheel_contact_jacobian(0.0, r) @ np.array([0.0, 1.0])
    close(top[..., 0], r)  # forward, for phi turns as the wheel rolls


# --- Bad input

ARM, LONG = PlanarArm([0.3, 0.2]), PlanarArm([1.0] * 3)


@pytest.mark.parametrize(
    ('message', 'call'),
    [
        ('the arm must have 2 links for this, got 3$', lambda: LONG.determinant([0.0] * 3)),
        ('the arm must have 2 links', lambda: LONG.inverse_kinematics([0.1, 0.2])),
        ('the arm must have 2 links', lambda: LONG.inverse_velocity([0.0] * 3, [0.0, 1.0])),
        ('wrench must have shape', lambda: ARM.joint_torques([0.0] * 2, [0.0] * 4)),
        ('lengths must be positive', lambda: PlanarArm([1.0, 0.0])),
        ('r must be positive', lambda: contact.rolling_direction([1.0, 0.0])),
        ('d must .* rank 1', lambda: dd.offset_point_jacobian(0.0, R, L, [1.0, 0.0])),
        *(
            ('position must be from 0.1 to 0.5 m away', lambda at=at: ARM.inverse_kinematics(at))
            for at in ([0.5 + 1e-9, 0.0], [0.0, 0.1 - 1e-9], [[0.2, 0.2], [1e200, 1e200]])
        ),
    ],
)
def test_an_error_names_the_argument_and_what_is_allowed(message, call):
    with pytest.raises(ValueError, match=f'^{message}'):
        call()
