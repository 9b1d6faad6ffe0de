"""The differential drive: its Jacobians, their chain and their constraints. Wheels stand right, left."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.kinematics import diff_drive as dd
from diffdrive_jacobian.kinematics import rigid_body

deterministic = settings(deadline=None, derandomize=True, max_examples=50)

headings = st.floats(-np.pi, np.pi)
dimensions = st.floats(1e-3, 10.0)
speeds = st.floats(-100.0, 100.0)
vectors = st.tuples(speeds, speeds, speeds)


def close(actual, expected, scale=1.0):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-13 * scale)


# --- The chain w -> u -> q_dot


@deterministic
@given(headings)
def test_the_unicycle_jacobian_never_loses_rank(theta):
    S = dd.unicycle_jacobian(theta)
    assert np.linalg.matrix_rank(S) == 2
    close(np.linalg.svd(S, compute_uv=False), [1.0, 1.0])


@deterministic
@given(headings, dimensions, dimensions)
def test_the_matrices_are_inverse_and_make_the_chain(theta, r, L):
    J_w, J_w_inverse = dd.wheel_to_body_jacobian(r, L), dd.body_to_wheel_jacobian(r, L)
    condition = np.linalg.cond(J_w)
    close(J_w @ J_w_inverse, np.eye(2), condition)
    close(J_w_inverse @ J_w, np.eye(2), condition)
    chain = dd.wheel_to_world_jacobian(theta, r, L)
    close(chain, dd.unicycle_jacobian(theta) @ J_w, np.abs(J_w).max())
    assert np.linalg.matrix_rank(chain) == 2


@deterministic
@given(speeds, speeds, dimensions, dimensions)
def test_the_written_out_maps_are_the_matrices_and_undo_each_other(first, second, r, L):
    J_w, J_w_inverse = dd.wheel_to_body_jacobian(r, L), dd.body_to_wheel_jacobian(r, L)
    vector = np.array([first, second])
    body, wheels = dd.wheel_to_body(first, second, r, L), dd.body_to_wheel(first, second, r, L)
    close(body, J_w @ vector, np.linalg.norm(J_w) * 100.0)
    close(wheels, J_w_inverse @ vector, np.linalg.norm(J_w_inverse) * 100.0)
    close(dd.body_to_wheel(*body, r, L), vector, np.linalg.cond(J_w) * 100.0)
    close(dd.wheel_to_body(*wheels, r, L), vector, np.linalg.cond(J_w) * 100.0)


# --- Constraints


@deterministic
@given(headings)
def test_what_does_not_slip_sideways_is_what_the_unicycle_can_do(theta):
    A, S = dd.no_lateral_slip_constraint(theta), dd.unicycle_jacobian(theta)
    assert A.shape == (1, 3)
    close(A @ S, 0.0)
    # Projectors on the null space of the row and on the range of S, whose columns are orthonormal.
    null_space = np.linalg.svd(A)[2][1:].T
    close(null_space @ null_space.T, S @ S.T)


@deterministic
@given(headings, dimensions, dimensions, speeds, speeds)
def test_rolling_of_both_wheels_is_the_chain(theta, r, L, omega_R, omega_L):
    A_q, A_w = dd.rolling_constraints(theta, r, L)
    chain = dd.wheel_to_world_jacobian(theta, r, L)
    wheels = np.array([omega_R, omega_L])
    close(A_q @ (chain @ wheels), A_w @ wheels, 100.0 * r)
    close(np.linalg.solve(A_q, A_w), chain, np.linalg.cond(A_q) * r)
    # Row by row, with the velocities of the wheels' centres, which stand L/2 beside the axle's.
    x_dot, y_dot, theta_dot = q_dot = chain @ wheels
    forward = x_dot * np.cos(theta) + y_dot * np.sin(theta)
    centres = [forward + L / 2.0 * theta_dot, forward - L / 2.0 * theta_dot]
    close(A_q @ q_dot, [0.0, *centres], 100.0 * r)
    close(centres, r * wheels, 100.0 * r)


# --- The centres of the wheels


@deterministic
@given(headings, dimensions, dimensions, speeds, speeds)
def test_the_wheel_centres_roll_forward_and_the_axle_centre_is_half_way(theta, r, L, omega_R, omega_L):
    pose = np.array([3.0, -2.0, theta])
    right, left = dd.wheel_centres(pose, L)
    close((right + left) / 2.0, pose[:2], L)
    e_f, e_l = dd.unicycle_jacobian(theta)[:2, 0], dd.no_lateral_slip_constraint(theta)[0, :2]
    close(right - left, L * e_l, 10.0 + L)
    q_dot = dd.wheel_to_world_jacobian(theta, r, L) @ [omega_R, omega_L]
    velocities = dd.wheel_centre_velocities(theta, q_dot, L)
    close(velocities @ e_f, [r * omega_R, r * omega_L], 1e3 * r)
    close(velocities @ e_l, [0.0, 0.0], 1e3 * r)
    close(velocities.mean(axis=0), q_dot[:2], 1e3 * r)


@deterministic
@given(headings, dimensions, vectors)
def test_the_velocities_of_the_wheel_centres_are_those_of_a_rigid_body(theta, L, q_dot):
    """Also of a robot that slips: by differences of the centres, and from one wheel to the other."""
    pose, theta_dot = np.array([0.5, 1.0, theta]), q_dot[2]
    velocities = dd.wheel_centre_velocities(theta, q_dot, L)
    ahead, behind = (dd.wheel_centres(pose + sign * 1e-6 * np.array(q_dot), L) for sign in (1, -1))
    np.testing.assert_allclose(velocities, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-5 * (1.0 + L))
    (right, left), (v_R, v_L) = dd.wheel_centres(pose, L), velocities
    from_left = rigid_body.point_velocity([*v_L, 0.0], [0.0, 0.0, theta_dot], [*(right - left), 0.0])
    close(from_left, [*v_R, 0.0], 1e3 * (1.0 + L))


@deterministic
@given(vectors, vectors, vectors, vectors)
def test_the_velocity_of_a_point_of_a_rigid_body(v, omega, first, second):
    close(rigid_body.point_velocity(v, omega, first), v + np.cross(omega, first), 1e5)
    # From P to Q and on to R is from P to R; the distance of two points does not change.
    at_first = rigid_body.point_velocity(v, omega, first)
    at_second = rigid_body.point_velocity(at_first, omega, second)
    close(at_second, rigid_body.point_velocity(v, omega, np.add(first, second)), 1e5)
    close((at_second - at_first) @ second, 0.0, 1e7)
