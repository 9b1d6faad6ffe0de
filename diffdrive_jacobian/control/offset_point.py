"""Input-output linearization at an offset point (document B).

The position of the axle centre cannot be controlled by inverting its Jacobian, which has rank 1. A point
at a distance d in front of it (behind it, if d is negative) can, because its Jacobian is invertible for
every heading.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, gain and offset too.

Source: document B, "Let's add a control point offset"; doc/mathematics.md, "Differential drive".
"""

from __future__ import annotations

from collections.abc import Iterator

from diffdrive_jacobian.control.controller import KV, OFFSET, Controller, GainValues
from diffdrive_jacobian.kinematics import diff_drive
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import offset
from diffdrive_jacobian.numerics.elementary import cos, sin
from diffdrive_jacobian.numerics.formula import Number, Vector, formula


@formula('(3),(2),(),() -> (),()', d=offset)
def offset_point(state: Vector, goal: Vector, k: Number, d: Number) -> tuple[Number, Number]:
    """Compute the twist that drives the offset point along a straight line: `p_d_dot = k (goal - p_d)`.

    As wheel speeds the law is `w = J_d^-1 k (goal - p_d)`. Here it is the body twist `u = J_w w`:
    `v = k a`, `omega = k b / d`, where `[a, b]` is the vector from the point to the goal in the body
    frame. The distance of the point decays as exp(-k t), whatever the heading. The point comes to rest
    on the goal, the axle centre at a distance |d| from it. When the law is sampled, this requires
    `k distance < 2 |d| rate` and `k < rate`, and if commands take effect up to one sample late,
    `k (1 + distance / |d|) < rate`. With a shorter offset the robot turns too far when the goal is far
    away.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Position for the point `[x, y]`, shape (..., 2) (m).
        k: Gain on the distance, shape (...) (1/s).
        d: X coordinate of the point in the body frame, not 0, shape (...) (m).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: d is 0, the last axis of state or goal has a wrong length, shapes do not broadcast,
            something is not finite, or the twist overflows.
    """
    x_d, y_d = diff_drive.offset_point.formula(state, d)
    x_goal, y_goal = goal
    x_dot, y_dot = k * (x_goal - x_d), k * (y_goal - y_d)
    # The inverse of [x_dot, y_dot] = R(theta) [[1, 0], [0, d]] [v, omega], which is J_d without J_w.
    _, _, theta = state
    v = cos(theta) * x_dot + sin(theta) * y_dot
    omega = (cos(theta) * y_dot - sin(theta) * x_dot) / d
    return v, omega


def _advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if limits.min_v == 0.0:
        yield (
            'linear.x.min_velocity is 0: the robot may not back up, which controller offset_point does '
            'where the goal lies behind; it may come to rest before the goal'
        )


CONTROLLER = Controller(
    name='offset_point',
    law=offset_point,
    summary='input-output linearization at an offset point, document B',
    gains=(KV, OFFSET),
    offset='offset',
    advice=_advice,
    # At the goal. At a distance it is larger by kv distance / |offset|.
    slope=lambda gains: gains.kv,
)
