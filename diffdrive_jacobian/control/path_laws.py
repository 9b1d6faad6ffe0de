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

"""Control laws that drive a unicycle along a path.

State: pose `[x, y, theta]`, shape (..., 3) (m, m, rad). Reference: a `path.Reference`, shape (..., 8),
the place on the path that the law drives to, with the speeds and the acceleration there. Output: body
twist `(v, omega)`, each of shape (...) (m/s, rad/s). Everything broadcasts over leading axes, the gains
too. A last axis of a wrong length, values that are not finite or out of their range, shapes that do not
broadcast, and twists that overflow raise ValueError.

Source: Coulter 1992; Kanayama, Kimura, Miyazaki, Noguchi 1990; document B; Oriolo, De Luca, Vendittelli
2002; doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from collections.abc import Iterator

from diffdrive_jacobian.control.controller import (
    LARGEST_GAIN,
    OFFSET,
    Gain,
    GainValues,
    PathController,
)
from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import not_negative, offset, positive
from diffdrive_jacobian.numerics.elementary import cos, hypot, maximum, sin, where, wrap
from diffdrive_jacobian.numerics.formula import Number, Scalar, Vector, formula


def _gain(name: str, label: str, default: float, unit: str, description: str) -> Gain:
    return Gain(
        name=name,
        default=default,
        unit=unit,
        description=description,
        bounds=(0.0, LARGEST_GAIN),
        label=label,
    )


# --- Pure pursuit


@formula('(3),(8),() -> (),()', l_d=positive)
def pure_pursuit(state: Vector, reference: Vector, l_d: Number) -> tuple[Scalar, Scalar]:
    """Compute the twist along the circle through a point of the path at the look-ahead distance.

    `omega = 2 v y / l_d^2`, where y is the coordinate of the point to the left in the body frame
    (Coulter 1992). The circle is tangent to the heading. A robot that is farther than l_d from the path
    drives along the circle through the point, too, with its distance in place of l_d. The look-ahead
    distance l_d is positive (m).
    """
    x, y, theta = state
    x_r, y_r, _, v_r, *_ = reference
    left = cos(theta) * (y_r - y) - sin(theta) * (x_r - x)
    l_d = maximum(l_d, hypot(x_r - x, y_r - y))
    return v_r, 2.0 * v_r * (left / l_d) / l_d


LOOKAHEAD = Gain(
    name='lookahead_distance',
    default=0.2,
    unit='m',
    description='Distance from the robot of the point of the path that pure_pursuit drives to',
    bounds=(1e-3, 100.0),
    label='Look-ahead l_d',
    usual=(0.05, 1.0),
)
PURE_PURSUIT = PathController(
    name='pure_pursuit',
    law=pure_pursuit,
    summary='along the circle through the point at the look-ahead distance, Coulter 1992',
    gains=(LOOKAHEAD,),
    lookahead='lookahead_distance',
)


# --- Kanayama


@formula('(3),(8),(),(),() -> (),()', K_x=not_negative, K_y=not_negative, K_theta=not_negative)
def kanayama(
    state: Vector, reference: Vector, K_x: Number, K_y: Number, K_theta: Number
) -> tuple[Scalar, Scalar]:
    """Compute the twist of the tracking control of Kanayama, Kimura, Miyazaki and Noguchi 1990.

    With the errors in the body frame, `e = R(theta)^T (p_r - p)`, `e_theta = wrap(theta_r - theta)`: `v
    = v_r cos(e_theta) + K_x e_x`, `omega = omega_r + v_r (K_y e_y + K_theta sin(e_theta))`. `V = (e_x^2
    + e_y^2)/2 + (1 - cos(e_theta))/K_y` does not grow while v_r >= 0. The errors are critically damped
    with `K_theta^2 = 4 K_y`. No gain is negative: K_x (1/s), K_y (1/m^2), K_theta (1/m).
    """
    x, y, theta = state
    x_r, y_r, theta_r, v_r, omega_r, *_ = reference
    e_x = cos(theta) * (x_r - x) + sin(theta) * (y_r - y)
    e_y = cos(theta) * (y_r - y) - sin(theta) * (x_r - x)
    e_theta = wrap(theta_r - theta)
    v = v_r * cos(e_theta) + K_x * e_x
    omega = omega_r + v_r * (K_y * e_y + K_theta * sin(e_theta))
    return v, omega


def _kanayama_advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.k_theta**2 < gains.k_y:
        yield (
            f'k_theta {gains.k_theta:g} is less than half of what damps k_y {gains.k_y:g} critically: '
            'the robot weaves about the path; choose k_theta = 2 sqrt(k_y)'
        )


KANAYAMA = PathController(
    name='kanayama',
    law=kanayama,
    summary='Kanayama et al. 1990',
    gains=(
        _gain('k_x', 'k_x', 2.0, '1/s', 'Gain of kanayama on the error ahead'),
        _gain('k_y', 'k_y', 25.0, '1/m^2', 'Gain of kanayama on the error to the left'),
        _gain('k_theta', 'k_{θ}', 10.0, '1/m', 'Gain of kanayama on the heading error'),
    ),
    advice=_kanayama_advice,
)


# --- Offset point with feed-forward


@formula('(3),(8),(),() -> (),()', d=offset)
def offset_point_tracking(
    state: Vector, reference: Vector, k: Number, d: Number
) -> tuple[Scalar, Scalar]:
    """Compute the twist that lets the offset point track another: `p_d_dot = p_dot_r + k (p_r - p_d)`.

    `p_r` is the offset point of a robot that is where the reference is, so that the axle centre, not the
    offset point, comes to lie on the path. The error of the offset point decays as exp(-k t), with the
    gain k (1/s), whatever the heading. With d > 0 the heading follows along the path; the x coordinate d
    of the point in the body frame (m) must not be 0.
    """
    _, _, theta = state
    x_r, y_r, theta_r, v_r, omega_r, *_ = reference
    x_d, y_d = diff_drive.offset_point.formula(state, d)
    x_rd, y_rd = diff_drive.offset_point.formula((x_r, y_r, theta_r), d)
    x_dot = v_r * cos(theta_r) - d * omega_r * sin(theta_r) + k * (x_rd - x_d)
    y_dot = v_r * sin(theta_r) + d * omega_r * cos(theta_r) + k * (y_rd - y_d)
    # The inverse of [x_dot, y_dot] = R(theta) [[1, 0], [0, d]] [v, omega], which is J_d without J_w.
    v = cos(theta) * x_dot + sin(theta) * y_dot
    omega = (cos(theta) * y_dot - sin(theta) * x_dot) / d
    return v, omega


def _offset_advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.offset < 0.0:
        yield (
            f'offset {gains.offset:g} is negative: a robot that drives forwards pushes the point ahead '
            'of it, turns round and follows the path backwards; choose offset > 0'
        )


OFFSET_POINT = PathController(
    name='offset_point',
    law=offset_point_tracking,
    summary='input-output linearization at an offset point with feed-forward, document B',
    gains=(_gain('k_point', 'k', 1.5, '1/s', 'Gain of offset_point on the error along a path'), OFFSET),
    advice=_offset_advice,
)


# --- Dynamic feedback linearization

LEAST_SPEED = 0.02
"""Smallest state xi of the dynamic feedback linearization (m/s), which divides by it."""


@formula('(3),(8),(),(),(1),() -> (),(),(1)')
def dynamic_feedback_linearization(
    pose: Vector,
    reference: Vector,
    K_p: Number,
    K_d: Number,
    *,
    state: Vector,
    dt: Number,
) -> tuple[Number, Number, Vector]:
    """Compute the twist by dynamic feedback linearization (Oriolo, De Luca, Vendittelli 2002).

    The speed is a state, `xi = v`: `xi_dot = u_1 cos + u_2 sin`, `omega = (u_2 cos - u_1 sin)/xi`. Then
    `p_ddot = u`, and with `u = p_ddot_r + K_d (p_dot_r - p_dot) + K_p (p_r - p)` the error obeys the
    linear equation `e_ddot + K_d e_dot + K_p e = 0`, with K_p (1/s^2) and K_d (1/s). Critically damped
    with `K_d^2 = 4 K_p`.

    At xi = 0 the law is singular: a robot at rest cannot accelerate sideways. As the paper proposes, xi
    is reset there, to the speed of the reference, but at least to `LEAST_SPEED`: the robot never backs
    up.

    The state is xi, shape (..., 1) (m/s), and dt the time since the call before, shape (...) (s).
    Returns `(v, omega, state)`.
    """
    x, y, theta = pose
    x_r, y_r, theta_r, v_r, _, ax_r, ay_r, _ = reference
    (xi,) = state
    xi = where(xi < LEAST_SPEED, maximum(v_r, LEAST_SPEED), xi)
    u_1 = ax_r + K_d * (v_r * cos(theta_r) - xi * cos(theta)) + K_p * (x_r - x)
    u_2 = ay_r + K_d * (v_r * sin(theta_r) - xi * sin(theta)) + K_p * (y_r - y)
    xi = maximum(xi + dt * (u_1 * cos(theta) + u_2 * sin(theta)), LEAST_SPEED)
    omega = (u_2 * cos(theta) - u_1 * sin(theta)) / xi
    return xi, omega, [xi]


DYNAMIC_FEEDBACK = PathController(
    name='dynamic_feedback',
    law=dynamic_feedback_linearization,
    summary='dynamic feedback linearization, Oriolo et al. 2002',
    gains=(
        _gain('k_position', 'k_p', 4.0, '1/s^2', 'Gain of dynamic_feedback on the error'),
        _gain(
            'k_velocity', 'k_d', 4.0, '1/s', 'Gain of dynamic_feedback on the derivative of the error'
        ),
    ),
    state=(0.0,),
)

PATH_CONTROLLERS = (PURE_PURSUIT, KANAYAMA, OFFSET_POINT, DYNAMIC_FEEDBACK)
