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

"""The numbers and matrices that the documents A to E print; where one slipped, what is right and why.

The slips are listed in doc/mathematics.md, "Slips in the documents".
B and E order the wheels left, right: `[:, ::-1]` puts our columns, right and left, in their order.
"""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.control import go_to_goal
from diffdrive_jacobian.kinematics import contact, se2
from diffdrive_jacobian.kinematics import diff_drive as dd
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.kinematics.rigid_body import point_velocity

HEADINGS = np.linspace(-np.pi, np.pi, 25)
r, l, d, psi = 0.033, 0.16, 0.1, 0.7  # noqa: E741 - the documents' letters
c, s = np.cos(psi), np.sin(psi)
LEFT_RIGHT = np.array([4.0, 9.0])  # wheel speeds


def close(actual, expected, tolerance=1e-14):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=tolerance)


J_B = np.array([[r / 2 * c, r / 2 * c], [r / 2 * s, r / 2 * s], [-r / l, r / l]])
J_OFFSET = np.array(
    [
        [r / 2 * c + d * r / l * s, r / 2 * c - d * r / l * s],
        [r / 2 * s - d * r / l * c, r / 2 * s + d * r / l * c],
    ]
)
PRINTED = {
    'A S(theta)': (dd.unicycle_jacobian(psi), [[c, 0.0], [s, 0.0], [0.0, 1.0]]),
    'A J_w': (dd.wheel_to_body_jacobian(r, l), [[r / 2, r / 2], [r / l, -r / l]]),
    'B v_b and psi_dot_b': (dd.wheel_to_body(9.0, 4.0, r, l), [13.0 * r / 2, 5.0 * r / l]),
    # Of its two H_B^w the text kept the planar one; the others have rows of other matrices mixed in.
    'B H_B^W': (se2.homogeneous([3.0, 4.0, psi]), [[c, -s, 3.0], [s, c, 4.0], [0.0, 0.0, 1.0]]),
    'B one wheel': (dd.single_wheel_jacobian(psi, r), [[r * c, 0.0], [r * s, 0.0], [0.0, 1.0]]),
    'B and E in the world': (dd.wheel_to_world_jacobian(psi, r, l)[:, ::-1], J_B),
    'B position': (dd.wheel_to_position_jacobian(psi, r, l), [[r / 2 * c] * 2, [r / 2 * s] * 2]),
    'B offset point': (dd.offset_point_jacobian(psi, r, l, d)[:, ::-1], J_OFFSET),
    'C point on a wheel': (
        contact.wheel_contact_position(0.4, psi, r),
        [0.4 + r * s, r + r * c, 0.0],
    ),
    'C its J_P': (contact.wheel_contact_jacobian(psi, r), [[1.0, r * c], [0.0, -r * s], [0.0, 0.0]]),
    'C at the ground': (
        contact.wheel_contact_jacobian(np.pi, r),
        [[1.0, -r], [0.0, 0.0], [0.0, 0.0]],
    ),
    'E rolling and no slip': (
        dd.rolling_constraints(psi, r, l)[0],
        [[s, -c, 0.0], [c, s, l / 2], [c, s, -l / 2]],
    ),
    'E J': (dd.wheel_to_body_jacobian(r, l)[:, ::-1], [[r / 2, r / 2], [-r / l, r / l]]),
    'E its inverse': (
        dd.body_to_wheel_jacobian(r, l)[::-1],
        [[1 / r, -l / (2 * r)], [1 / r, l / (2 * r)]],
    ),
    # A slip: it prints [v, theta_dot] for three rows, too. They are v_x, v_y = 0, theta_dot.
    'E in its own frame': (
        dd.wheel_to_world_jacobian(0.0, r, l)[:, ::-1],
        [[r / 2, r / 2], [0.0, 0.0], [-r / l, r / l]],
    ),
}


@pytest.mark.parametrize('name', PRINTED)
def test_matrices_are_as_printed(name):
    close(*PRINTED[name])


# --- A: course module 3.2. Its text lost every formula; they follow its prose and script


def test_a_script_prints_these_numbers():
    state, goal = np.array([0.0, 0.0, 0.0]), np.array([1.0, 1.0])
    v, omega = go_to_goal(state, goal, Kp=3.0, Kv=0.5)
    wheels = dd.body_to_wheel(v, omega, 0.033, 0.16)
    S = dd.unicycle_jacobian(state[2])
    printed = [f'{number:.3f}' for number in (v, omega, *wheels, *(S @ [v, omega]))]
    assert printed == ['0.500', '2.356', '20.864', '9.440', '0.500', '0.000', '2.356']
    close(dd.wheel_to_world_jacobian(state[2], 0.033, 0.16) @ wheels, S @ [v, omega])


def test_a_two_links_near_a_singularity_ask_for_impossible_speeds_and_damping_bounds_them():
    arm, x_dot = PlanarArm([0.5, 0.5]), np.array([0.1, 0.0])
    q = np.column_stack([np.zeros(4), [1.0, 1e-2, 1e-4, 1e-6]])
    fast = np.linalg.norm(arm.inverse_velocity(q, x_dot), axis=-1)
    assert np.all(fast[1:] > 90.0 * fast[:-1])
    factor = iv.damping(iv.manipulability(arm.jacobian(q)), threshold=0.1, maximum=0.05)
    damped = np.linalg.norm(iv.damped_least_squares(arm.jacobian(q), x_dot, factor), axis=-1)
    assert factor[0] == 0.0  # small when w is large, increased as it falls towards zero
    assert np.all(np.diff(factor) > 0.0)
    assert np.all(damped[1:] <= 0.1 / (2.0 * factor[1:]))


def test_a_slip_entries_for_velocities_across_the_arm_stay_finite_near_a_singularity():
    # It lets each entry of J^-1 grow. With the arm along x only the column of the velocity along x does.
    arm = PlanarArm([0.5, 0.4])
    inverse = iv.adjugate_inverse(arm.jacobian([[0.0, 1e-3], [0.0, 1e-6]]))
    assert np.all(np.abs(inverse[1, :, 0]) > 900.0 * np.abs(inverse[0, :, 0]))
    close(inverse[..., 1], [[2.0, -2.0], [2.0, -2.0]], 1e-9)


def test_a_slip_twists_become_wheel_speeds_by_the_inverse_of_equation_8():
    u = [0.5, 2.356]
    J_w = dd.wheel_to_body_jacobian(r, l)
    close(dd.body_to_wheel(*u, r, l), np.linalg.inv(J_w) @ u, 1e-12)
    assert np.linalg.norm(J_w @ u) < 0.4 < 15.0 < np.linalg.norm(dd.body_to_wheel(*u, r, l))


# --- B: lecture slides, "Mobile Robot Jacobians"


def test_b_position_alone_has_rank_1_no_matter_what_psi_we_put_in_and_the_offset_point_2():
    for singular in dd.wheel_to_position_jacobian(HEADINGS, r, l):  # "won't work!"
        assert np.linalg.matrix_rank(singular) == 1
        with pytest.raises(np.linalg.LinAlgError):
            iv.adjugate_inverse(singular)
    # "Can we invert this new Jacobian? Yes!", for every psi; the order of columns turns the sign.
    close(np.linalg.det(dd.offset_point_jacobian(HEADINGS, r, l, d)), -d * r**2 / l)
    assert np.linalg.det(J_OFFSET) > 0.0


def test_b_slip_the_left_wheel_moves_the_offset_point_to_the_right():
    # It prints y_d_dot = d psi = [dr/l, dr/l] [omega_L, omega_R]. It is d psi_dot, and the left entry is
    # -dr/l, as in the matrix after it: the left wheel turns the robot to the right. (Its r/z is r/2.)
    row = dd.offset_point_jacobian(0.0, r, l, d)[:, ::-1]
    close(row, [[r / 2, r / 2], [-d * r / l, d * r / l]])
    psi_dot = dd.wheel_to_body(*LEFT_RIGHT[::-1], r, l)[1]
    close(row[1] @ LEFT_RIGHT, d * psi_dot)
    assert abs(np.array([d * r / l, d * r / l]) @ LEFT_RIGHT - d * psi_dot) > 0.1


def test_b_slip_only_the_two_velocities_of_the_point_belong_behind_the_inverse():
    # Its last line feeds [X_d_dot, psi_dot], three numbers, to the inverse of a 2x2 matrix.
    J, p_d_dot = dd.offset_point_jacobian(psi, r, l, d), np.array([0.2, -0.1])
    close(J @ (iv.adjugate_inverse(J) @ p_d_dot), p_d_dot)
    with pytest.raises(ValueError, match=r'^x_dot must have shape'):
        iv.damped_least_squares(J, [*p_d_dot, 0.0], 0.0)


# --- C: ETH Zürich, "Kinematics"


def test_c_a_wheel_that_must_not_slip_turns_as_its_body_moves():
    J_F, J_body = contact.wheel_contact_jacobian(contact.AT_GROUND, r), np.array([[1.0, 0.0]])
    close(J_F @ contact.rolling_direction(r), 0.0)
    q_dot = iv.prioritized([(J_F, np.zeros(3)), (J_body, [0.3])])
    close(q_dot, [0.3, 0.3 / r], 1e-11)  # x_dot - r phi_dot = 0
    N_F = iv.null_space_projector(J_F)
    close(q_dot, N_F @ iv.pseudoinverse(J_body @ N_F) @ [0.3], 1e-11)


def test_c_slip_the_null_space_projector_is_the_identity_minus_a_projector():
    # It prints N = (I J^+ J): the minus is lost. I J^+ J moves the task, I - J^+ J does not.
    J = PlanarArm([0.5, 0.4, 0.3]).jacobian([0.3, 0.8, -0.5])
    printed = np.eye(3) @ iv.pseudoinverse(J) @ J
    N = iv.null_space_projector(J)
    close(N, np.eye(3) - printed)
    close(J @ N, 0.0)
    close(J @ printed, J)


def test_c_slip_the_newton_update_goes_by_the_goal_minus_what_is_reached():
    # It prints q + J^+ (r_goal r_i): the minus is lost.
    arm, q = PlanarArm([0.5, 0.4, 0.3]), np.array([0.3, 0.8, -0.5])
    goal = arm.forward_kinematics([0.5, 0.7, -0.2])[:2]
    errors = []
    for _ in range(6):
        error = goal - arm.forward_kinematics(q)[:2]
        errors.append(np.linalg.norm(error))
        q = q + iv.pseudoinverse(arm.jacobian(q)) @ error
    assert errors[0] > 0.1
    assert errors[4] < 10.0 * errors[3] ** 2  # quadratically
    assert errors[-1] < 1e-14


def test_c_slip_at_a_singularity_the_norm_of_the_difference_is_least():
    # It prints |r_goal r|: the minus is lost. A stretched arm cannot move along itself.
    J, goal = PlanarArm([0.5, 0.4]).jacobian([0.3, 0.0]), np.array([0.7, -0.4])
    q_dot = iv.pseudoinverse(J) @ goal
    least = np.linalg.norm(goal - J @ q_dot)
    assert least > 0.1
    others = q_dot + 0.1 * np.random.default_rng(1).normal(size=(100, 2))
    assert np.all(np.linalg.norm(goal - others @ J.T, axis=1) >= least - 1e-15)


def test_c_from_the_third_task_on_a_product_of_the_single_projectors_is_wrong():
    tasks = [([[1.0, 0.0, 0.0]], [1.0]), ([[1.0, 1.0, 0.0]], [2.0]), ([[0.0, 1.0, 1.0]], [3.0])]
    close(iv.prioritized(tasks), [1.0, 1.0, 2.0])
    J, two = np.array([J for J, _ in tasks]), iv.prioritized(tasks[:2])
    product = iv.null_space_projector(J[0]) @ iv.null_space_projector(J[1])
    wrong = two + product @ iv.pseudoinverse(J[2] @ product) @ (3.0 - J[2] @ two)
    assert abs(J[1, 0] @ wrong - 2.0) > 0.5


def conflicting(rng, kind, n=6):
    """Return five tasks: feasible, repeated, contradictory, or the first one singular."""
    tasks = [(rng.normal(size=(m, n)), rng.normal(size=m)) for m in (2, 2, 1, 2, 1)]
    if kind == 'repeated':
        tasks[2] = tasks[0][0][:1], tasks[0][1][:1]
        tasks[3] = tasks[1]
    if kind == 'contradictory':
        tasks[1] = tasks[0][0] * 2.0, -tasks[0][1]
        tasks[3] = rng.normal(size=(2, 2)) @ tasks[0][0], tasks[3][1]
    if kind == 'singular':
        tasks[0] = np.outer([1.0, 2.0], tasks[0][0][0]), tasks[0][1]
    return tasks


@pytest.mark.parametrize('kind', ['feasible', 'repeated', 'contradictory', 'singular'])
def test_each_task_is_done_as_well_as_those_before_it_allow_and_disturbs_none_of_them(kind):
    rng = np.random.default_rng(11)
    for _ in range(10):
        tasks = conflicting(rng, kind)
        q_dot = iv.prioritized(tasks)
        size = 1.0 + np.linalg.norm(q_dot)
        N = np.eye(6)  # what leaves the tasks so far
        for k, (J, x_dot) in enumerate(tasks, 1):
            # No motion of it reduces the error of the next one.
            close(N @ J.T @ (x_dot - J @ q_dot), 0.0, 1e-9 * size)
            alone = iv.prioritized(tasks[:k])
            done = np.concatenate([J for J, _ in tasks[:k]])
            close(done @ q_dot, done @ alone, 1e-11 * size)
            N = np.eye(6) - np.linalg.pinv(done, 1e-10) @ done
            close(N @ alone, 0.0, 1e-9 * size)  # the least such velocity


def test_tasks_that_conflict_but_for_rounding_move_no_joint_fast():
    rng = np.random.default_rng(12)
    J = rng.normal(size=(2, 5))
    tasks = [(J, [1.0, 1.0]), (J + 1e-12 * rng.normal(size=(2, 5)), [-1.0, 3.0])]
    close(iv.prioritized(tasks), np.linalg.pinv(J) @ [1.0, 1.0], 1e-9)
    assert np.linalg.norm(iv.prioritized(tasks, cutoff=1e-14)) > 1e9


# --- D: notes on manipulator velocity


def test_d_a_resolved_rate_draws_a_straight_line():
    arm, q, velocity, dt = PlanarArm([0.5, 0.4]), np.array([0.3, 0.9]), np.array([-0.1, 0.2]), 1e-3
    start = arm.forward_kinematics(q)[:2]
    for _ in range(200):
        q = arm.integrate(q, arm.inverse_velocity(q, velocity), dt)
    close(arm.forward_kinematics(q)[:2], start + 0.2 * velocity, 2e-4)


def test_d_a_wrench_becomes_torques_by_the_transpose():
    arm, q, W = PlanarArm([0.5, 0.4]), np.array([0.3, 0.9]), np.array([3.0, -2.0, 0.5])
    close(arm.joint_torques(q, W), arm.jacobian(q, heading=True).T @ W)
    # By hand: a pull along y with a lever arm of l1 + l2 turns the first joint, with l2 the second.
    close(arm.joint_torques([0.0, 0.0], [0.0, 1.0]), [0.9, 0.4])


def test_d_the_transpose_and_the_least_squares_steps_reduce_the_error():
    arm, q = PlanarArm([0.5, 0.4, 0.3]), np.array([0.3, 0.8, -0.5])
    m = np.array([1.0, 1.0, 0.04])  # the mask
    J = arm.jacobian(q, heading=True)
    delta = arm.forward_kinematics([0.5, 0.7, -0.2]) - arm.forward_kinematics(q)

    def error(step):
        left = delta - J @ step
        return left @ np.diag(m) @ left

    assert error(0.1 * J.T @ delta) < error(np.zeros(3))
    # Its lambda is not squared: damped least squares of sqrt(M) J with sqrt(lambda).
    root, JTM = np.sqrt(m), J.T @ np.diag(m)
    for factor in (0.0, 1e-6, 1e-2, 1.0):
        step = np.linalg.inv(JTM @ J + factor * np.eye(3)) @ JTM @ delta
        close(iv.damped_least_squares(root[:, np.newaxis] * J, root * delta, factor**0.5), step, 1e-9)
        assert error(step) < error(np.zeros(3))


def test_d_slip_the_stiffness_of_the_spring_belongs_before_the_transpose():
    # Its step 4 prints 1/B J^T Delta for Q = J^T W, W = gamma Delta and q_dot = Q/B.
    arm, q, target = PlanarArm([0.5, 0.4, 0.3]), np.array([0.3, 0.8, -0.5]), np.array([0.7, 0.7, 0.1])
    gamma, B, dt = 2.0, 4.0, 1e-6

    def energy(q):
        delta = target - arm.forward_kinematics(q)
        return 0.5 * gamma * delta @ delta

    q_dot = arm.joint_torques(q, gamma * (target - arm.forward_kinematics(q))) / B
    # Friction consumes what the spring gives, without a rest.
    rate = (energy(q + q_dot * dt) - energy(q - q_dot * dt)) / (2.0 * dt)
    close(rate, -B * q_dot @ q_dot, 1e-8)


# --- E: derivation of the differential drive; wheel 1 is the left one, 2 the right


def test_e_theta_dot_by_constraints_by_the_rigid_axle_and_by_superposition_about_o():
    omega_1, omega_2 = LEFT_RIGHT
    v_x, theta_dot = r * omega_1 / 2.0 + r * omega_2 / 2.0, (r * omega_2 - r * omega_1) / l
    A_q, A_w = dd.rolling_constraints(psi, r, l)
    close(np.linalg.solve(A_q, A_w @ [omega_2, omega_1]), [v_x * c, v_x * s, theta_dot])
    for phi_dot in LEFT_RIGHT:  # v_C = 0 + phi_dot j x r k
        close(point_velocity([0, 0, 0], [0, phi_dot, 0], [0, 0, r]), [r * phi_dot, 0.0, 0.0])
    right = point_velocity([r * omega_1, 0, 0], [0, 0, theta_dot], [0, -l, 0])
    close(right, [r * omega_2, 0.0, 0.0])
    # About O at rest, first by wheel 1, then by wheel 2: each turn moves the other wheel backward.
    theta_1_dot, theta_2_dot = -2 * r * omega_1 / l, 2 * r * omega_2 / l
    v_1 = point_velocity([0, 0, 0], [0, 0, theta_1_dot], [0, l / 2, 0])
    v_2 = point_velocity([0, 0, 0], [0, 0, theta_2_dot], [0, -l / 2, 0])
    close([v_1, v_2], [[r * omega_1, 0.0, 0.0], [r * omega_2, 0.0, 0.0]])
    close((theta_1_dot + theta_2_dot) / 2, theta_dot)


def test_e_slip_the_global_velocity_is_a_matrix_times_the_wheel_speeds():
    # It prints Q [r omega_1/2 + r omega_2/2, 0] = a 2x2 matrix: [omega_1, omega_2] is missing behind it.
    Q, v = se2.homogeneous([0.0, 0.0, psi])[:2, :2], dd.wheel_to_body(*LEFT_RIGHT[::-1], r, l)[0]
    close(Q @ [v, 0.0], J_B[:2] @ LEFT_RIGHT)


def test_e_slip_checking_kinematics_with_unit_dimensions():
    forward = dd.wheel_to_body_jacobian(1.0, 1.0)[:, ::-1]
    inverse = dd.body_to_wheel_jacobian(1.0, 1.0)[::-1]
    assert np.array_equal(forward @ [1.0, -1.0], [0.0, -2.0])
    # It prints [1, -1] for v = 0, theta_dot = 2. Its own inverse gives [-1, 1]: a turn to the left needs
    # the right wheel forward, and [1, -1] was shown to give -2 just before.
    assert np.array_equal(inverse @ [0.0, 2.0], [-1.0, 1.0])
