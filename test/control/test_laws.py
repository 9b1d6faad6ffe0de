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

"""The laws of goals: document A's, document B's offset point, Aicardi's of poses (1995)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffdrive_jacobian.control import (
    Arrival,
    VelocityLimits,
    go_to_goal,
    go_to_pose,
    offset_point,
)
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.simulation import closed_loops

KP, KV = 3.0, 0.5  # document A's gains
COUNT = 2_000


def random_poses(seed, count=COUNT, size=3.0):
    """Return independent starts and goals, shape (2, count, 3)."""
    box = [size, size, np.pi]
    return np.random.default_rng(seed).uniform(np.negative(box), box, (2, count, 3))


def random_gains(seed, count=COUNT, names=2):
    """Sluggish and wild ones."""
    return 10.0 ** np.random.default_rng(seed).uniform(-1.5, 1.5, (names, count))


def polar(states, targets):
    """Return distance, bearing from the robot's heading, and that from the goal's heading."""
    direct = (targets[..., 0] - states[..., 0]) + 1j * (targets[..., 1] - states[..., 1])
    alpha = np.angle(direct * np.exp(-1j * states[..., 2]))
    phi = np.angle(direct * np.exp(-1j * targets[..., 2]))
    return np.abs(direct), alpha, phi


def point(poses, d):
    """The offset point, written out."""
    x, y, theta = np.moveaxis(np.asarray(poses), -1, 0)
    return np.stack([x + d * np.cos(theta), y + d * np.sin(theta)], -1)


def random_offsets(seed, count=COUNT):
    """Points in front of the axle and behind it."""
    rng = np.random.default_rng(seed)
    return rng.choice([-1.0, 1.0], count) * 10.0 ** rng.uniform(-2.0, 0.5, count)


# --- Document A


def document_a(state, goal, Kp, Kv):
    """Equations (9)-(11) as document A's script computes them."""
    (x, y, theta), (x_goal, y_goal) = state, goal
    d = math.sqrt((x_goal - x) ** 2 + (y_goal - y) ** 2)
    error = math.atan2(y_goal - y, x_goal - x) - theta
    error = math.atan2(math.sin(error), math.cos(error))
    return Kv * d * math.cos(error), Kp * error


def test_go_to_goal_is_document_as():
    (states, targets), gains = random_poses(7), random_gains(8)
    # Abeam of the goal; and across the cut, where 2 degrees are left.
    states[:4] = [(0, 0, 0), (0, 0, 0), (0, 0, math.radians(-179)), (0, 0, math.radians(179))]
    degree = math.radians(1.0)
    cut = 2.0 * np.array([-math.cos(degree), math.sin(degree)])
    targets[:4, :2] = [(0, 1), (0, -1), cut, cut * [1, -1]]
    v, omega = go_to_goal(states, targets[:, :2], *gains)
    expected = [document_a(*one) for one in zip(states, targets[:, :2], *gains, strict=True)]
    assert_allclose(np.column_stack([v, omega]), expected, rtol=1e-12, atol=1e-12)
    assert_allclose(v[:2], 0.0, atol=1e-14)
    assert_allclose(omega[:4] / gains[0, :4], [math.pi / 2, -math.pi / 2, -2 * degree, 2 * degree])
    # The distance never grows: d_dot = -Kv d cos^2(e).
    distance, error, _ = polar(states, targets)
    q_dot = (diff_drive.unicycle_jacobian(states[:, 2]) @ np.stack([v, omega], -1)[..., None])[..., 0]
    d_dot = -np.sum((targets - states)[:, :2] * q_dot[:, :2], axis=-1) / distance
    assert_allclose(d_dot, -gains[1] * distance * np.cos(error) ** 2, rtol=1e-9, atol=1e-12)


# --- Document B: the offset point goes straight to its goal, like exp(-k t)


def test_the_offset_point_moves_straight_towards_its_goal_whatever_the_heading():
    (states, targets), (k, _), d = random_poses(12), random_gains(13), random_offsets(14)
    goals = targets[:, :2]
    v, omega = offset_point(states, goals, k, d)
    wanted = k[:, np.newaxis] * (goals - point(states, d))
    # With document B's Jacobian, whatever the wheels.
    r, L = np.random.default_rng(15).uniform([[0.01], [0.1]], [[0.1], [0.6]], (2, COUNT))
    wheels = np.stack(diff_drive.body_to_wheel(v, omega, r, L), -1)
    J_d = diff_drive.offset_point_jacobian(states[:, 2], r, L, d)
    assert_allclose((J_d @ wheels[..., np.newaxis])[..., 0], wanted, rtol=1e-8, atol=1e-8)
    for axle_centre in (0.0, -0.0, [0.1, 0.0]):
        with pytest.raises(ValueError, match=r'^d must be .*not 0.* rank 1.*got -?0'):
            offset_point(np.zeros(3), [1.0, 1.0], 1.0, axle_centre)


# --- Aicardi et al.: position and heading


def test_go_to_pose_is_aicardis_law_with_document_as_speed():
    (states, targets), (Kp, Kv, h) = random_poses(19), random_gains(20, names=3)
    rho, alpha, phi = polar(states, targets)
    bend = Kv * np.cos(alpha) * np.sin(alpha) / alpha
    v, omega = go_to_pose(states, targets, Kp, Kv, h)
    assert_allclose(v, Kv * rho * np.cos(alpha), rtol=1e-11, atol=1e-12)
    assert_allclose(omega, Kp * alpha + bend * (alpha + h * phi), rtol=1e-10, atol=1e-10)
    assert np.array_equal(v, go_to_goal(states, targets[:, :2], Kp, Kv)[0])
    # Towards alpha = 0 there is no hole.
    for alpha in (0.0, 1e-300, -1e-300, 1e-12, -1e-9, 1e-6):
        v, omega = go_to_pose([-1.0, 0.0, -alpha], [0.0, 0.0, 0.4], KP, KV, 2.0)
        assert v == pytest.approx(KV)
        assert omega == pytest.approx(KP * alpha + KV * (alpha + 2.0 * -0.4), abs=1e-11)


def test_the_default_weight_is_critical_damping_or_twice_as_fast_as_the_distance():
    (states, targets), (Kp, Kv) = random_poses(21), random_gains(22)
    ratio = Kp / Kv
    assert 0.1 < np.mean(ratio > 4.0) < 0.9
    weight = np.where(ratio <= 4.0, (ratio / 2.0) ** 2, 2.0 * ratio - 4.0)
    given = go_to_pose(states, targets, Kp, Kv, weight)
    assert_allclose(go_to_pose(states, targets, Kp, Kv), given, rtol=1e-9, atol=1e-9)


def test_at_the_position_the_commands_are_zero_whatever_the_headings():
    states, targets = random_poses(23, 1000)
    targets[:, :2] = states[:, :2]
    assert not np.any(go_to_pose(states, targets, KP, KV))
    assert not np.any(go_to_goal(states, targets[:, :2], KP, KV))
    for theta in (0.0, -0.0, math.pi, -math.pi):
        assert go_to_pose([-0.0, 0.0, theta], [0.0, -0.0, 1.0], KP, KV) == (0.0, 0.0)


# --- Robots that are driven to the end


def test_poses_are_reached_from_everywhere():
    """A batch of robots without limits, within limits, and that may not back up."""
    states, targets = random_poses(28, 120, 1.5)
    limited, forwards = slice(40, 80), slice(80, 120)
    # Under limits the paths are shorter: several of them take long all the same.
    states[limited], targets[limited] = random_poses(30, 40, 0.7)
    # Exactly behind, and with headings of pi.
    states[::8, 2], targets[::12, 2] = np.pi, -np.pi
    Kp = np.full(120, KP)
    Kp[forwards] = np.repeat([6.0, 12.0, 24.0, 45.0], 10)
    v, omega, wheels = np.full((3, 120), np.inf)
    v[limited], omega[limited], wheels[limited] = 0.22, 2.84, 6.67
    min_v = -v
    min_v[forwards] = 0.0
    limits = VelocityLimits(
        min_v=min_v, max_v=v, min_omega=-omega, max_omega=omega, max_wheel_speed=wheels
    )
    how = {'arrival': Arrival(use_heading=True), 'limits': limits, 'duration': 90.0}
    found = closed_loops(go_to_pose, states, targets, Kp, KV, **how)
    off = np.hypot(*(found.pose - targets).T[:2])
    turned = np.abs(se2.wrap_angle((found.pose - targets)[:, 2]))
    failed = np.flatnonzero(~found.arrived | (off > 0.02) | (turned > 0.02))
    assert not failed.size, [(states[i].tolist(), targets[i].tolist()) for i in failed]
