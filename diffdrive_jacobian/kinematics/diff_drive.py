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

"""Velocity kinematics of the differential drive: its Jacobians, their chain and their constraints.

State: pose `q = [x, y, theta]` (m, m, rad). Inputs: wheel speeds `w = [omega_R, omega_L]` (rad/s,
positive drives forward) or the body twist `u = [v, omega]` (m/s, rad/s). Wheel radius `r` and wheel
separation `L` in m. **The order of wheels is right, left.** Documents B and E have left, right: their
columns, and the rows of E's inverse, are exchanged here.

    w --J_w--> u --S(theta)--> q_dot

`@formula('(),() -> (2,2)', r=positive, L=positive)` says that a function of two numbers, both positive,
returns a 2x2 matrix, an array; `(3)` is a vector, and `(),()` behind the arrow a pair of numbers;
`d=offset` requires a finite number that is not 0. `f.formula(...)` is the body as it is written: without
checks, and a matrix is a list of rows. So matrices are multiplied by `product`, not by `@`
(`numerics.formula`).

In docstrings cos and sin are those of theta, A(8) is equation (8) of document A, and A's script calls
`q_dot` `xi_dot` and `J_w` `J_wheel`.

Everything broadcasts over leading axes. A radius or separation that is not positive and finite, an
angle or speed that is not finite, shapes that do not broadcast, and terms or results that overflow raise
ValueError, in single and in batched calls.

Source: document A, on the mobile robot's Jacobian, equations (4)-(8); B, slides on mobile robots; E, on
a differential drive by rolling constraints (doc/documents.md); doc/mathematics.md, "Differential drive".
"""

from __future__ import annotations

from diffdrive_jacobian.numerics.checks import offset, positive
from diffdrive_jacobian.numerics.elementary import cos, product, sin
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, Scalar, Vector, formula

__all__ = [
    'body_to_wheel',
    'body_to_wheel_jacobian',
    'controllability_matrix',
    'lie_bracket',
    'no_lateral_slip_constraint',
    'offset_point',
    'offset_point_jacobian',
    'rolling_constraints',
    'single_wheel_jacobian',
    'unicycle_jacobian',
    'wheel_centre_velocities',
    'wheel_centres',
    'wheel_to_body',
    'wheel_to_body_jacobian',
    'wheel_to_position_jacobian',
    'wheel_to_world_jacobian',
]


@formula('() -> (3,2)')
def unicycle_jacobian(theta: Number) -> Rows:
    """Map the body twist to the velocity in the world: `q_dot = S(theta) u` (A(4)-(7)).

    S is the mobile robot's analog of the manipulator's Jacobian J(q), and has no singularities: for
    headings theta (rad), shape (...), its rank is 2 and its singular values are 1, 1. Shape (..., 3, 2).
    """
    return [
        [cos(theta), 0.0],
        [sin(theta), 0.0],
        [0.0, 1.0],
    ]


@formula('(),() -> (2,2)', r=positive, L=positive)
def wheel_to_body_jacobian(r: Number, L: Number) -> Rows:
    """Map wheel speeds to the body twist: `u = J_w w`, `J_w = [[r/2, r/2], [r/L, -r/L]]` (A(8), E).

    A constant of the robot: unlike a manipulator's Jacobian it does not depend on the configuration. For
    r and L (m), shape (...), the result over `[omega_R, omega_L]` has the shape (..., 2, 2).
    """
    return [
        [r / 2.0, r / 2.0],
        [r / L, -r / L],
    ]


@formula('(),() -> (2,2)', r=positive, L=positive)
def body_to_wheel_jacobian(r: Number, L: Number) -> Rows:
    """Map the body twist to wheel speeds: `w = J_w^-1 u`, `[[1/r, L/(2r)], [1/r, -L/(2r)]]` (A, E).

    The inverse of `wheel_to_body_jacobian`: for r and L (m), shape (...), it has the shape (..., 2, 2).
    """
    return [
        [1.0 / r, L / (2.0 * r)],
        [1.0 / r, -L / (2.0 * r)],
    ]


@formula('(),(),() -> (3,2)', r=positive, L=positive)
def wheel_to_world_jacobian(theta: Number, r: Number, L: Number) -> Rows:
    """Map wheel speeds to the velocity in the world: the whole chain `q_dot = S(theta) J_w w` (A, B, E).

    `S J_w = [[(r/2) cos, (r/2) cos], [(r/2) sin, (r/2) sin], [r/L, -r/L]]`. For headings theta (rad), r
    and L (m), each of shape (...), it has the shape (..., 3, 2) and rank 2.
    """
    S = unicycle_jacobian.formula(theta)
    J_w = wheel_to_body_jacobian.formula(r, L)
    return product(S, J_w)


@formula('(),() -> (3,2)', r=positive)
def single_wheel_jacobian(theta: Number, r: Number) -> Rows:
    """Map the speed of one driven wheel and the yaw rate to the velocity in the world (B, "Unicycle").

    For headings theta (rad) and r (m), shape (...), it is `[[r cos, 0], [r sin, 0], [0, 1]]`, shape
    (..., 3, 2), over `[omega_wheel, theta_dot]` (rad/s).
    """
    return [
        [r * cos(theta), 0.0],
        [r * sin(theta), 0.0],
        [0.0, 1.0],
    ]


@formula('(),(),() -> (2,2)', r=positive, L=positive)
def wheel_to_position_jacobian(theta: Number, r: Number, L: Number) -> Rows:
    """Map wheel speeds to the velocity of the axle centre alone: `[x_dot, y_dot] = S[:2] J_w w` (B).

    **It has rank 1 for every heading, radius and separation**: the axle centre moves along the heading
    only, for all wheel speeds. It has no inverse that could control the position. A point off the axle
    can be controlled, see `offset_point_jacobian`.

    For headings theta (rad), r and L (m), each of shape (...), the result over `[omega_R, omega_L]` has
    the shape (..., 2, 2). Its determinant is 0.
    """
    S = unicycle_jacobian.formula(theta)
    J_w = wheel_to_body_jacobian.formula(r, L)
    return product(S[:2], J_w)


@formula('(3),() -> (2)')
def offset_point(pose: Vector, d: Number) -> Entries:
    """Return the point at x = d in the body frame: `[x + d cos, y + d sin]` in the world (B).

    For poses, shape (..., 3), and coordinates d of the point in the body frame, negative behind the
    axle, 0 on it, shape (...) (m), the result has the shape (..., 2) (m).
    """
    x, y, theta = pose
    return [x + d * cos(theta), y + d * sin(theta)]


@formula('(),(),(),() -> (2,2)', r=positive, L=positive, d=offset)
def offset_point_jacobian(theta: Number, r: Number, L: Number, d: Number) -> Rows:
    """Map wheel speeds to the velocity of the offset point (B).

    `J_d = R(theta) [[r/2, r/2], [d r/L, -d r/L]]`. Its determinant is `-d r^2 / L`, so it is invertible
    for every heading if d is not 0; d = 0 raises ValueError.

    For headings theta (rad), r, L (m) and d, the x coordinate of the point in the body frame (m), each
    of shape (...), the result over `[omega_R, omega_L]` has the shape (..., 2, 2).
    """
    R = [
        [cos(theta), -sin(theta)],
        [sin(theta), cos(theta)],
    ]
    # The point has the velocity [v, d omega] in the body frame.
    in_body = [
        [r / 2.0, r / 2.0],
        [d * r / L, -d * r / L],
    ]
    return product(R, in_body)


@formula('(),(),(),() -> (),()', r=positive, L=positive)
def body_to_wheel(v: Number, omega: Number, r: Number, L: Number) -> tuple[Scalar, Scalar]:
    """Return the wheel speeds of a body twist, `J_w^-1 u` in scalar form (A, inverse of (8)).

    For v (m/s), omega (rad/s), r and L (m), the result is `(omega_R, omega_L)` (rad/s), each of shape
    (...).
    """
    omega_R = (v + omega * L / 2.0) / r
    omega_L = (v - omega * L / 2.0) / r
    return omega_R, omega_L


@formula('(),(),(),() -> (),()', r=positive, L=positive)
def wheel_to_body(omega_R: Number, omega_L: Number, r: Number, L: Number) -> tuple[Scalar, Scalar]:
    """Return the body twist of wheel speeds, `J_w w` in scalar form (A(8)).

    For omega_R and omega_L (rad/s), r and L (m), the result is `(v, omega)` (m/s, rad/s), each of shape
    (...).
    """
    v = r * (omega_R + omega_L) / 2.0
    omega = r * (omega_R - omega_L) / L
    return v, omega


@formula('(3),() -> (2,2)', L=positive)
def wheel_centres(pose: Vector, L: Number) -> Rows:
    """Return the centres of both wheels: `C_R = C + L/2 e_l`, `C_L = C - L/2 e_l` (E).

    C is the axle centre, the position of the pose, and `e_l = [sin, -cos]` document E's lateral unit
    vector, which points to the right. For poses, shape (..., 3), and L, shape (...) (m), the result is
    `[[x_R, y_R], [x_L, y_L]]`, shape (..., 2, 2) (m). Document E has them as `C_2` and `C_1`.
    """
    x, y, theta = pose
    return [
        [x + L / 2.0 * sin(theta), y - L / 2.0 * cos(theta)],
        [x - L / 2.0 * sin(theta), y + L / 2.0 * cos(theta)],
    ]


@formula('(),(3),() -> (2,2)', L=positive)
def wheel_centre_velocities(theta: Number, q_dot: Vector, L: Number) -> Rows:
    """Return the velocities of the centres of both wheels (E).

    Right `v_C + L/2 theta_dot e_f`, left `v_C - L/2 theta_dot e_f`, with `e_f = [cos, sin]`: the rule
    `v_Q = v_P + omega × PQ` from the axle centre C to each wheel. Their mean is the velocity of C. Of
    wheels that roll without slip they are `r omega_R e_f` and `r omega_L e_f`, r the wheel radius.

    For headings theta, shape (...) (rad), velocities `q_dot = [x_dot, y_dot, theta_dot]` in the world,
    shape (..., 3) (m/s, m/s, rad/s), and L, shape (...) (m), the result has the shape (..., 2, 2) (m/s):
    in the world, the right wheel's first.
    """
    x_dot, y_dot, theta_dot = q_dot
    turning = L / 2.0 * theta_dot
    return [
        [x_dot + turning * cos(theta), y_dot + turning * sin(theta)],
        [x_dot - turning * cos(theta), y_dot - turning * sin(theta)],
    ]


@formula('() -> (1,3)')
def no_lateral_slip_constraint(theta: Number) -> Rows:
    """Return the row `[sin, -cos, 0]` with `row q_dot = 0`: no lateral slip (documents A and E).

    For headings theta, shape (...) (rad), the result has the shape (..., 1, 3). Its null space is the
    range of S(theta). In the body frame it is `[0, -1, 0]` for every heading.
    """
    return [[sin(theta), -cos(theta), 0.0]]


@formula('() -> (3)')
def lie_bracket(theta: Number) -> Entries:
    """Return the Lie bracket of the columns of S(theta): `[g_1, g_2] = [sin, -cos, 0]`.

    `g_1 = [cos, sin, 0]` drives, `g_2 = [0, 0, 1]` turns, and `[g_1, g_2] = dg_2/dq g_1 - dg_1/dq g_2`.
    Driving a distance a forward, turning by b, driving back and turning back moves the robot by `a b
    [g_1, g_2]` to second order, as in parallel parking (A, 3.2.2): along the direction that
    `no_lateral_slip_constraint` forbids. For headings theta, shape (...) (rad), it has the shape (...,
    3).

    Source: doc/mathematics.md, "Controllability".
    """
    # dg_2/dq is zero, and dg_1/dq g_2 is the derivative of g_1 = [cos, sin, 0] by theta.
    return [sin(theta), -cos(theta), 0.0]


@formula('() -> (3,3)')
def controllability_matrix(theta: Number) -> Rows:
    """Return the columns `g_1, g_2, [g_1, g_2]`, of which g_1 and g_2 are those of S(theta).

    (Not Kalman's matrix `[B, AB, ...]` of linear systems.) Its determinant is 1 for every heading theta,
    shape (...) (rad): three independent directions. So a robot that may drive both ways reaches every
    pose, by Chow's theorem (A, 3.2.2: controllability is preserved). Shape (..., 3, 3).

    Source: W.-L. Chow, "Über Systeme von linearen partiellen Differentialgleichungen erster Ordnung",
    1939; doc/mathematics.md, "Controllability".
    """
    S = unicycle_jacobian.formula(theta)
    bracket = lie_bracket.formula(theta)
    return [[*row, entry] for row, entry in zip(S, bracket, strict=True)]


@formula('(),(),() -> (3,3),(3,2)', r=positive, L=positive)
def rolling_constraints(theta: Number, r: Number, L: Number) -> tuple[Rows, Rows]:
    """Return the constraints of two rolling wheels, a pair with `A_q q_dot = A_w w` (E).

    Rows: no lateral slip, `x_dot sin - y_dot cos = 0`, and pure rolling of the right wheel, `x_dot cos +
    y_dot sin + L/2 theta_dot = r omega_R`, and of the left one, with `-L/2` and omega_L. `A_q` is
    invertible, its determinant is -L, and `A_q^-1 A_w` is the chain `S(theta) J_w`. For headings theta
    (rad), r and L (m), each of shape (...), they have the shapes (..., 3, 3) and (..., 3, 2).
    """
    A_q = [
        [sin(theta), -cos(theta), 0.0],
        [cos(theta), sin(theta), L / 2.0],
        [cos(theta), sin(theta), -L / 2.0],
    ]
    A_w = [
        [0.0, 0.0],
        [r, 0.0],
        [0.0, r],
    ]
    return A_q, A_w
