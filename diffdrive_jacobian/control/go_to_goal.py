"""Document A's law that drives a unicycle to a position, and the turn in place that may follow it.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: document A, equations (9)-(11); MATH.md, "Control laws".
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics._elementary import arctan2, components, cos, hypot, operand
from diffdrive_jacobian.kinematics.se2 import wrap_angle


def go_to_goal(state: ArrayLike, goal: ArrayLike, Kp: Any, Kv: Any) -> tuple[Any, Any]:
    """Turn towards the goal, and drive as far as the robot looks at it.

    `e = wrap(atan2(y_g - y, x_g - x) - theta)`, `omega = Kp e`, `v = Kv d cos(e)`, d the distance.
    Held continuously, `d_dot = -Kv d cos^2(e) <= 0`: the distance never grows. With `Kp < Kv` the
    heading error settles away from zero and the robot spirals in.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Position `[x, y]`, shape (..., 2) (m).
        Kp: Gain on the heading error, shape (...) (1/s).
        Kv: Gain on the distance, shape (...) (1/s).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s). Exactly on the goal, where the heading
        towards it is undefined, both are zero.

    Raises:
        ValueError: The last axis of state or goal has a wrong length.
    """
    x, y, theta = components('state', state, 3)
    x_goal, y_goal = components('goal', goal, 2)
    Kp, Kv = operand(Kp), operand(Kv)
    dx, dy = x_goal - x, y_goal - y
    distance = hypot(dx, dy)
    heading_error = wrap_angle(arctan2(dy, dx) - theta)
    return Kv * distance * cos(heading_error), Kp * heading_error * (distance > 0.0)


def turn_in_place(theta: ArrayLike, heading: ArrayLike, Kp: Any) -> tuple[Any, Any]:
    """Turn to a heading the short way round: `v = 0`, `omega = Kp wrap(heading - theta)`.

    Args:
        theta: Heading of the robot, shape (...) (rad).
        heading: Heading to take, shape (...) (rad).
        Kp: Gain on the heading error, shape (...) (1/s).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).
    """
    omega = operand(Kp) * wrap_angle(operand(heading) - operand(theta))
    return 0.0 * omega, omega
