"""The differential drive: its Jacobians, their chain and their constraints. Wheels stand right, left."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.control import go_to_goal
from diffdrive_jacobian.kinematics import diff_drive as dd
from diffdrive_jacobian.kinematics import rigid_body, se2

R, L = 0.033, 0.16  # document A's robot
deterministic = settings(deadline=None, derandomize=True)

headings = st.floats(-np.pi, np.pi)
dimensions = st.floats(1e-3, 10.0)
speeds = st.floats(-100.0, 100.0)


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


@deterministic
@given(headings, st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(0.01, 1.0), st.floats(0.05, 2.0))
def test_jacobians_are_the_derivatives_of_the_motion(theta, x, y, r, L):
    """Central differences of the exact arc, over small ways and turns and over small wheel angles."""
    pose, step = np.array([x, y, theta]), 1e-4

    def slope(to_twist, direction):
        ahead, behind = (se2.integrate(pose, to_twist(h * direction), 1.0) for h in (step, -step))
        change = ahead - behind
        return np.append(change[:2], se2.wrap_angle(change[2])) / (2.0 * step)

    J_w = dd.wheel_to_body_jacobian(r, L)
    for jacobian, to_twist in [
        (dd.unicycle_jacobian(theta), lambda way_and_turn: way_and_turn),
        (dd.wheel_to_world_jacobian(theta, r, L), lambda wheel_angles: J_w @ wheel_angles),
    ]:
        differences = np.column_stack([slope(to_twist, direction) for direction in np.eye(2)])
        # The arc's bend enters with the square of the turn, rounding with eps / step.
        bend = (step * np.abs(jacobian[2]).max()) ** 2 * np.abs(jacobian[:2]).max()
        np.testing.assert_allclose(differences, jacobian, rtol=1e-12, atol=bend + 1e-14 / step)


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
@given(headings, dimensions, st.tuples(speeds, speeds, speeds))
def test_the_velocities_of_the_wheel_centres_are_those_of_a_rigid_body(theta, L, q_dot):
    """Also of a robot that slips: by differences of the centres, and from one wheel to the other."""
    pose, theta_dot = np.array([0.5, 1.0, theta]), q_dot[2]
    velocities = dd.wheel_centre_velocities(theta, q_dot, L)
    ahead, behind = (dd.wheel_centres(pose + sign * 1e-6 * np.array(q_dot), L) for sign in (1, -1))
    np.testing.assert_allclose(velocities, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-5 * (1.0 + L))
    (right, left), (v_R, v_L) = dd.wheel_centres(pose, L), velocities
    from_left = rigid_body.point_velocity([*v_L, 0.0], [0.0, 0.0, theta_dot], [*(right - left), 0.0])
    close(from_left, [*v_R, 0.0], 1e3 * (1.0 + L))


vectors = st.tuples(speeds, speeds, speeds)


@deterministic
@given(vectors, vectors, vectors, vectors)
def test_the_velocity_of_a_point_of_a_rigid_body(v, omega, first, second):
    close(rigid_body.point_velocity(v, omega, first), v + np.cross(omega, first), 1e5)
    # From P to Q and on to R is from P to R; the distance of two points does not change.
    at_first = rigid_body.point_velocity(v, omega, first)
    at_second = rigid_body.point_velocity(at_first, omega, second)
    close(at_second, rigid_body.point_velocity(v, omega, np.add(first, second)), 1e5)
    close((at_second - at_first) @ second, 0.0, 1e7)


# --- The documents' numbers


def test_the_golden_case_of_document_a():
    state, goal = np.zeros(3), np.ones(2)
    v, omega = go_to_goal(state, goal, Kp=3.0, Kv=0.5)
    omega_R, omega_L = dd.body_to_wheel(v, omega, R, L)
    assert [f'{x:.3f}' for x in (v, omega, omega_R, omega_L)] == ['0.500', '2.356', '20.864', '9.440']
    through_body = dd.unicycle_jacobian(state[2]) @ [v, omega]
    close(through_body, [0.5, 0.0, 0.75 * np.pi])
    close(dd.wheel_to_world_jacobian(state[2], R, L) @ [omega_R, omega_L], through_body)


def test_the_check_of_document_e():
    # Left wheel 1, right wheel -1, r = L = 1: a turn to the right.
    assert dd.wheel_to_body(-1.0, 1.0, 1.0, 1.0) == (0.0, -2.0)
    # A slip: the document prints [left, right] = [1, -1] here, its own inverse gives [-1, 1].
    omega_R, omega_L = dd.body_to_wheel(0.0, 2.0, 1.0, 1.0)
    assert [omega_L, omega_R] == [-1.0, 1.0]
    # Its matrices, with the columns of the forward one and the rows of the inverse in our order.
    assert np.array_equal(dd.wheel_to_body_jacobian(1.0, 1.0)[:, ::-1], [[0.5, 0.5], [-1.0, 1.0]])
    assert np.array_equal(dd.body_to_wheel_jacobian(1.0, 1.0)[::-1], [[1.0, -0.5], [1.0, 0.5]])


# --- Shapes and bad input


def test_every_function_broadcasts_over_leading_axes():
    rng = np.random.default_rng(3)
    theta, first, second = rng.normal(size=(4, 1)), rng.normal(size=(4, 1)), rng.normal(size=5)
    r, L = rng.uniform(0.01, 0.1, 5), rng.uniform(0.1, 1.0, (4, 1))
    for function, arguments in [
        (dd.unicycle_jacobian, (theta,)),
        (dd.no_lateral_slip_constraint, (theta,)),
        (dd.wheel_to_body_jacobian, (r, L)),
        (dd.body_to_wheel_jacobian, (r, L)),
        (dd.wheel_to_world_jacobian, (theta, r, L)),
        (lambda *args: dd.wheel_centres(np.stack(np.broadcast_arrays(*args), -1), 0.16), (theta, r, L)),
        (lambda theta, L: dd.wheel_centre_velocities(theta, [1.0, 2.0, 3.0], L), (theta, L)),
        (lambda *args: dd.rolling_constraints(*args)[0], (theta, r, L)),
        (lambda *args: dd.rolling_constraints(*args)[1], (theta, r, L)),
        (lambda *args: np.stack(dd.body_to_wheel(*args), -1), (first, second, r, L)),
        (lambda *args: np.stack(dd.wheel_to_body(*args), -1), (first, second, r, L)),
    ]:
        at_once = function(*arguments)
        grid = np.broadcast_arrays(*arguments)
        looped = np.array(
            [function(*entry) for entry in zip(*(axis.flat for axis in grid), strict=True)]
        )
        assert at_once.shape == grid[0].shape + looped.shape[1:]
        np.testing.assert_allclose(at_once.reshape(looped.shape), looped, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    'bad', [0.0, -0.033, np.nan, np.inf, -np.inf, 0, [0.1, 0.0], np.array([np.nan, 1.0])]
)
@pytest.mark.parametrize('name', ['r', 'L'])
def test_a_length_that_is_not_positive_and_finite_is_named(name, bad):
    lengths = {'r': R, 'L': L, name: bad}
    for call in [
        dd.wheel_to_body_jacobian,
        dd.body_to_wheel_jacobian,
        lambda **lengths: dd.wheel_to_world_jacobian(0.0, **lengths),
        lambda **lengths: dd.rolling_constraints(0.0, **lengths),
        lambda **lengths: dd.body_to_wheel(1.0, 1.0, **lengths),
        lambda **lengths: dd.wheel_to_body(1.0, 1.0, **lengths),
    ]:
        with pytest.raises(ValueError, match=rf'^{name} must be positive and finite'):
            call(**lengths)


def test_both_results_have_the_shape_of_all_arguments():
    separations = np.array([[0.1], [0.2]])
    for result in (
        dd.wheel_to_body([1.0, 2.0], [3.0, 4.0], 0.033, separations),
        dd.wheel_to_body(1.0, 2.0, 0.033, separations),
        dd.body_to_wheel([1.0, 2.0], 3.0, 0.033, separations),
    ):
        first, second = result
        assert first.shape == second.shape == np.broadcast_shapes(first.shape, (2, 1))
    v, omega = dd.wheel_to_body([1.0, 2.0], [3.0, 4.0], 0.033, separations)
    for i, j in np.ndindex(2, 2):
        one = dd.wheel_to_body(1.0 + j, 3.0 + j, 0.033, float(separations[i, 0]))
        assert (v[i, j], omega[i, j]) == one
