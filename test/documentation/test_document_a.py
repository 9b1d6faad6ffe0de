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

"""What document A says beside its equations: saturation, controllability, parking, obstacles.

Its numbers are in test_documents.py, and what doc/document_a.md shows is run by test_pages.py.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import StraightLine, go_to_goal
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.inverse_kinematics import solve
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.plots import arm_pictures, motion_pictures, parking
from diffdrive_jacobian.simulation import track_line

HEADINGS = np.linspace(-np.pi, np.pi, 101)
S = diff_drive.unicycle_jacobian(HEADINGS)


def close(actual, expected, tolerance=1e-12):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=tolerance)


@pytest.mark.slow
def test_saturated_actuators_do_not_follow():
    # Two lines, beside the hole around the base and through it; actuators without limits and with.
    arm, x = PlanarArm([0.5, 0.4]), np.array([0.11, 0.05])
    line = StraightLine(np.stack([x, [-0.4, -0.4]], axis=-1), np.stack([x, [0.4, 0.4]], axis=-1), 0.1)
    q0 = solve(lambda q: arm.forward_kinematics(q)[..., :2], arm.jacobian, line.start, [-2.0, 2.0]).q
    limits = np.array([np.inf, 1.0])[:, np.newaxis, np.newaxis] * np.ones(2)
    run = track_line(arm, np.stack([q0, q0]), line, rate=25.0, settling=2.0, max_velocity=limits)
    fastest, largest, last = np.abs(run.q_dot).max(axis=(0, -1)), run.error.max(axis=0), run.error[-1]
    assert fastest[0, 0] > 1.2
    assert fastest[0, 1] > 20.0
    assert fastest[1].max() <= 1.0
    assert largest[0, 0] < 2e-4 < 9e-3 < largest[1, 0]  # beside the hole: late
    assert last[1, 0] < 1e-4
    assert last[1, 1] > 0.4  # through it: stuck


def test_the_columns_of_a_manipulator_are_parallel_where_it_is_singular():
    J = PlanarArm([0.5, 0.4]).jacobian([[0.3, 0.0], [0.3, np.pi], [0.3, 0.9]])
    parallel = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    close(parallel, [0.0, 0.0, 0.2 * np.sin(0.9)])


def test_the_forbidden_direction_is_the_same_one_of_the_body():
    turned = np.stack([0.0 * HEADINGS, 0.0 * HEADINGS, HEADINGS], axis=-1)
    A = diff_drive.no_lateral_slip_constraint(HEADINGS) @ se2.homogeneous(turned)
    close(A, np.broadcast_to([0.0, -1.0, 0.0], A.shape))


def test_the_lie_bracket_is_the_derivative_and_the_forbidden_direction():
    step = 1e-6
    ahead = diff_drive.unicycle_jacobian(HEADINGS + step)
    by_theta = (ahead - diff_drive.unicycle_jacobian(HEADINGS - step)) / (2.0 * step)
    # dg/dq h = dg/dtheta h_theta, since x and y do not enter.
    bracket = by_theta[..., 1] * S[:, 2:, 0] - by_theta[..., 0] * S[:, 2:, 1]
    close(diff_drive.lie_bracket(HEADINGS), bracket, 1e-9)
    close(diff_drive.lie_bracket(HEADINGS), diff_drive.no_lateral_slip_constraint(HEADINGS)[:, 0])
    matrices = diff_drive.controllability_matrix(HEADINGS)
    close(matrices[..., :2], S)
    close(np.linalg.det(matrices), 1.0)


def test_four_motions_leave_a_gap_that_is_the_bracket_to_second_order():
    for a, b in ((1e-2, 3e-2), (1e-3, -3e-3), (1e-4, 3e-4)):
        pose = np.array([2.0, -1.0, 0.7])
        for twist in ([a, 0.0], [0.0, b], [-a, 0.0], [0.0, -b]):
            pose = se2.integrate(pose, twist, 1.0)
        gap = pose - [2.0, -1.0, 0.7]
        assert np.linalg.norm(gap - a * b * diff_drive.lie_bracket(0.7)) <= a * b**2


def test_the_parking_robot_gets_sideways_without_ever_driving_sideways():
    poses = motion_pictures.parked()
    close(poses[0], [0.0, 0.4 * (1.0 - np.cos(1.2)), 0.0])
    close(poses[-1], 0.0)
    moved = np.diff(poses, axis=0)
    middle = se2.wrap_angle(poses[:-1, 2] + moved[:, 2] / 2.0)
    close(diff_drive.no_lateral_slip_constraint(middle) @ moved[..., np.newaxis], 0.0)


def test_the_picture_of_parking_leaves_out_where_the_robot_stands_or_only_turns():
    poses = motion_pictures.parked()
    turned = poses[-1] + [[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]]
    stands_and_turns = np.concatenate([np.repeat(poses, 2, axis=0), turned])
    texts = [text.get_text() for text in parking(stands_and_turns).axes[0].texts]
    assert texts == [text.get_text() for text in parking().axes[0].texts]
    for bad in (poses[[0, 0]], poses[0], [poses], poses[:, :2], poses * np.nan):
        with pytest.raises(ValueError, match=r'^poses must'):
            parking(bad)


def test_the_pseudo_inverse_of_s_stands_still_where_the_law_turns():
    close(iv.pseudoinverse(S) @ diff_drive.lie_bracket(HEADINGS)[..., np.newaxis], 0.0)
    v, omega = go_to_goal([0.0, 0.0, 0.0], [0.0, 1.0], Kp=3.0, Kv=0.5)
    close([v, omega], [0.0, 1.5 * np.pi])


@pytest.mark.slow
def test_null_space_motion_leaves_the_tip_and_keeps_the_arm_away_from_an_obstacle():
    arm, track = arm_pictures.ARM, arm_pictures.self_motion()
    tips = arm.forward_kinematics(track)[:, :2]
    close(tips, np.broadcast_to(tips[0], tips.shape), 1e-4)
    assert np.ptp(track, axis=0).min() > 0.5
    without, avoiding = (arm_pictures.tracked(avoid=avoid) for avoid in (False, True))
    hit, kept = (arm.clearance(run.q, arm_pictures.OBSTACLE).min() for run in (without, avoiding))
    assert hit < 0.02 < 0.15 < kept
    assert avoiding.error.max() < 1e-4


def test_positions_of_wheels_do_not_determine_the_pose_and_velocities_linearize_it():
    J_w, turns = diff_drive.wheel_to_body_jacobian(0.033, 0.16), np.array([[20.0, 10.0], [5.0, 15.0]])
    ends = []
    for order in (turns, turns[::-1]):
        pose = np.zeros(3)
        for angles in order:
            pose = se2.integrate(pose, J_w @ angles, 1.0)
        ends.append(pose)
    assert abs(ends[0][1] - ends[1][1]) > 1.0
    close(ends[0][2], ends[1][2])  # the heading is r (phi_R - phi_L) / L
    u, errors = np.array([0.5, 1.0]), []
    for dt in (1e-2, 1e-3):
        linear = diff_drive.unicycle_jacobian(0.7) @ u * dt
        errors.append(np.linalg.norm(se2.integrate([0.0, 0.0, 0.7], u, dt) - [0.0, 0.0, 0.7] - linear))
    assert 99.0 < errors[0] / errors[1] < 101.0
