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

"""Control laws that drive a unicycle to a goal, and a turn in place.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `(v, omega)`, each of shape (...) (m/s,
rad/s). Everything broadcasts over leading axes, the gains too. A last axis of a wrong length, values
that are not finite or out of their range, shapes that do not broadcast, and twists that overflow raise
ValueError.

Source: document A, equations (9)-(11); document B, "Let's add a control point offset"; M. Aicardi,
G. Casalino, A. Bicchi, A. Balestrino, "Closed loop steering of unicycle-like vehicles via Lyapunov
techniques", IEEE Robotics & Automation Magazine 2(1), 1995; doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from collections.abc import Iterator
from math import tau
from typing import Any

from diffdrive_jacobian.control.controller import KV, OFFSET, Boundary, Controller, GainValues
from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import offset, positive
from diffdrive_jacobian.numerics.elementary import atan2, cos, hypot, sin, sinc, where, wrap
from diffdrive_jacobian.numerics.formula import Number, Scalar, Vector, formula

# --- To a position


@formula('(3),(2),(),() -> (),()')
def go_to_goal(state: Vector, goal: Vector, Kp: Number, Kv: Number) -> tuple[Scalar, Scalar]:
    """Compute the twist that drives a unicycle to a position.

    `e = wrap(atan2(y_g - y, x_g - x) - theta)`, `omega = Kp e`, `v = Kv d cos(e)`, where d is the
    distance to the goal as in document A, rho in the other laws. Both gains should be positive; as in
    A's script others are not refused. In continuous time `d_dot = -Kv d cos^2(e) <= 0`, so the distance
    never grows. With `Kp < Kv` the heading error settles at one of the two e with `sin(2 e)/(2 e) =
    Kp/Kv`, and the robot spirals in; with `Kp = Kv` it goes to zero like 1/sqrt(t). Exactly on the goal,
    where the heading towards it is undefined, v and omega are zero.

    If commands are held for a sample, 1/rate, the robot arrives if `Kp < 2 rate` and `Kv < rate`. If
    they also take effect up to one sample late, it arrives if `Kp + Kv < rate`, slowly where Kp is far
    below Kv. Recommended: `Kp + Kv <= rate / 2` (doc/mathematics.md, "Sampling").

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Position `[x, y]`, shape (..., 2) (m).
        Kp: Gain on the heading error, shape (...) (1/s).
        Kv: Gain on the distance, shape (...) (1/s).
    """
    x, y, theta = state
    x_goal, y_goal = goal
    d = hypot(x_goal - x, y_goal - y)
    theta_d = atan2(y_goal - y, x_goal - x)
    e = wrap(theta_d - theta)
    v = Kv * d * cos(e)
    omega = Kp * e
    # On the goal there is no heading towards it.
    return v, where(d > 0.0, omega, 0.0)


def _go_to_goal_advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.kp <= gains.kv:
        yield (
            f'kp {gains.kp:g} is not larger than kv {gains.kv:g}: the robot approaches faster than it '
            'turns and spirals in; choose kp > kv'
        )


GO_TO_GOAL = Controller(
    name='go_to_goal',
    law=go_to_goal,
    summary="document A's law, to a position",
    advice=_go_to_goal_advice,
    # e_dot = -Kp e + Kv sin(e) cos(e): omega has the slope kp, and driving changes e by at most kv |e|
    # per second. With a command that is late the two add up.
    slope=lambda gains: gains.kp + gains.kv,
    boundary=Boundary(ratio=1.0, beyond='with a larger kv the robot spirals in'),
)


@formula('(),(),() -> (),()')
def turn_in_place(theta: Number, heading: Number, Kp: Number) -> tuple[Scalar, Scalar]:
    """Compute the twist that turns to a heading by the smaller angle.

    `v = 0`, `omega = Kp wrap(heading - theta)`, of headings (rad) and the gain Kp (1/s), each of shape
    (...); a negative gain, which is not refused, turns away. If commands are held for a sample, 1/rate,
    it converges if `Kp < 2 rate`; if they also take effect up to one sample late, if `Kp < rate` and the
    robot is at rest first. (One that turns may swing about the opposite heading for ever.) Recommended:
    `Kp <= rate / 2`.
    """
    return 0.0, Kp * wrap(heading - theta)


# --- With an offset point to a position


@formula('(3),(2),(),() -> (),()', d=offset)
def offset_point(state: Vector, goal: Vector, k: Number, d: Number) -> tuple[Scalar, Scalar]:
    """Compute the twist that drives the offset point along a straight line: `p_d_dot = k (goal - p_d)`.

    Unlike the axle centre, whose Jacobian has rank 1, a point at a distance in front of it (behind it,
    if d is negative) can be driven in every direction.

    As wheel speeds the law is `w = J_d^-1 k (goal - p_d)`. Here it is the body twist `u = J_w w`: `v = k
    a`, `omega = k b / d`, where `[a, b]` is the vector from the point to the goal in the body frame. The
    distance rho of the point from the goal decays as exp(-k t), whatever the heading. The point comes to
    rest on the goal, the axle centre at a distance |d| from it.

    If commands are held for a sample, 1/rate, the point arrives if `k rho < 2 |d| rate` with rho at the
    start, and `k < rate`; if they also take effect up to one sample late, if `k (1 + rho / |d|) < rate`.
    With a shorter offset the robot turns too far in one sample while the goal is far away.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Position for the point `[x, y]`, shape (..., 2) (m).
        k: Gain on the distance, shape (...) (1/s).
        d: X coordinate of the point in the body frame, not 0, shape (...) (m).
    """
    x_d, y_d = diff_drive.offset_point.formula(state, d)
    x_goal, y_goal = goal
    x_dot, y_dot = k * (x_goal - x_d), k * (y_goal - y_d)
    # J_d = R(theta) diag(1, d) J_w, so [v, omega] = diag(1, 1/d) R(theta)^T [x_dot, y_dot].
    _, _, theta = state
    v = cos(theta) * x_dot + sin(theta) * y_dot
    omega = (cos(theta) * y_dot - sin(theta) * x_dot) / d
    return v, omega


def _offset_point_advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if limits.min_v == 0.0:
        yield (
            'linear.x.min_velocity is 0: the robot may not back up, which controller offset_point does '
            'where the goal lies behind; it may come to rest before the goal'
        )


OFFSET_POINT = Controller(
    name='offset_point',
    law=offset_point,
    summary='input-output linearization at an offset point, document B',
    gains=(KV, OFFSET),  # k and d of the law
    offset='offset',
    advice=_offset_point_advice,
    # At the goal alone: at the distance rho, which is not known here, it is kv (1 + rho / |offset|).
    slope=lambda gains: gains.kv,
)


# --- To a position and a heading

STEEPEST = 2.741
"""Bound of `|phi d/dalpha (sin(2 alpha)/(2 alpha))|` for |phi| <= pi, 0.8724 pi [-]. Times `Kv h` it
bounds the part of `|d omega / d alpha|` in `go_to_pose` that depends on phi."""


@formula('(3),(3),(),(),() -> (),()', Kp=positive, Kv=positive, h=positive)
def go_to_pose(
    state: Vector, goal: Vector, Kp: Number, Kv: Number, h: Number = None
) -> tuple[Scalar, Scalar]:
    """Compute the twist that drives a unicycle to a position and a heading.

    rho is the distance to the goal, alpha its bearing as seen from the robot's heading, and phi the same
    bearing as seen from the goal's heading. The heading error `theta - theta_goal = phi - alpha` is zero
    where both are. A unicycle moves as

        rho_dot = -v cos(alpha),  alpha_dot = v sin(alpha) / rho - omega,  phi_dot = v sin(alpha) / rho

    The law is `v = Kv rho cos(alpha)`, as in document A's law, and `omega = Kp alpha + Kv cos(alpha)
    sin(alpha)/alpha (alpha + h phi)`, in which h weights phi. In continuous time `V = rho^2 + alpha^2 +
    h phi^2` never grows, as `V_dot = -2 Kv rho^2 cos^2(alpha) - 2 Kp alpha^2`, and all three converge to
    zero. Exactly on the goal's position, where there is no bearing, v and omega are zero, with any
    heading: then the node turns by `turn_in_place`.

    With alpha small, `rho_dot = -Kv rho`, `alpha_dot = -Kp alpha - Kv h phi` and `phi_dot = Kv alpha`:
    alpha and phi are an oscillator of the natural frequency `Kv sqrt(h)`, damped by Kp, with the default
    h critically or more. They converge before rho if both roots of `s^2 + Kp s + Kv^2 h` are left of
    -Kv: with `Kp > 2 Kv` and `h > Kp/Kv - 1`, which the default h is. A larger h leads to longer paths.
    If the goal lies behind, the robot backs up while it turns to it and then drives forwards; if it may
    not back up, it turns first.

    With `Kp > 2 Kv`, and commands that are held for a sample, 1/rate, the robot arrives if `K = Kp + Kv
    (1 + 2.741 h) < 2 rate`; if they also take effect up to one sample late, if `K < rate`. Recommended:
    `K <= rate / 2`. With the default h, K is then below `6.5 Kp`.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Desired pose `[x, y, theta]`, shape (..., 3).
        Kp: Gain on the bearing, positive, shape (...) (1/s).
        Kv: Gain on the distance, positive, shape (...) (1/s).
        h: Weight of the heading, positive, shape (...). None: `(Kp / (2 Kv))^2`, which is critical
            damping, or for `Kp > 4 Kv` the smaller `2 Kp / Kv - 4`, with which the heading decays like
            exp(-2 Kv t).
    """
    x, y, theta = state
    x_goal, y_goal, heading = goal
    if h is None:
        h = default_weight(Kp, Kv)
    rho = hypot(x_goal - x, y_goal - y)
    bearing = atan2(y_goal - y, x_goal - x)
    alpha, phi = wrap(bearing - theta), wrap(bearing - heading)
    v = Kv * rho * cos(alpha)
    omega = Kp * alpha + Kv * cos(alpha) * sinc(alpha) * (alpha + h * phi)
    # On the goal there is no bearing.
    return v, where(rho > 0.0, omega, 0.0)


def default_weight(Kp: Number, Kv: Number) -> Number:
    """Compute the weight of the heading that `go_to_pose` takes by default, unchecked."""
    # The parabola of critical damping, continued by its tangent.
    return where(Kp <= 4.0 * Kv, (Kp / (2.0 * Kv)) ** 2, 2.0 * Kp / Kv - 4.0)


def _pose_slope(gains: GainValues) -> float:
    return float(gains.kp + gains.kv * (1.0 + STEEPEST * default_weight(gains.kp, gains.kv)))


def _pose_advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.kp <= 2.0 * gains.kv:
        yield (
            f'kp {gains.kp:g} is not larger than twice kv {gains.kv:g}: the robot reaches the position '
            'before the heading, and turns in place there; choose kp > 2 kv'
        )


POSE = Controller(
    name='pose',
    law=go_to_pose,
    summary='to a position and a heading',
    takes_heading=True,
    advice=_pose_advice,
    slope=_pose_slope,
    boundary=Boundary(ratio=2.0, beyond='with a larger kv the robot turns on the spot at the goal'),
)

GOAL_CONTROLLERS = (GO_TO_GOAL, OFFSET_POINT, POSE)


# --- Sampling

LARGEST_TURN = 7.0 / 8.0 * tau
"""Largest turn per sample that is left as it is (rad). Larger ones lead back to about the start."""


def by_shorter_turn(omega: Any, rate: float) -> Any:
    """Return a yaw rate, with turns of more than 7/8 per sample replaced by the shorter way.

    For omega, shape (...) (rad/s), and the rate of the samples (Hz). The heading at the next sample is
    the same. The path differs, and that is the purpose: a robot that makes about a whole turn per sample
    drives a circle back to where it was, and never arrives.
    """
    return where(abs(omega) <= LARGEST_TURN * rate, omega, wrap(omega / rate) * rate)
