"""Document A's law that drives a unicycle to a position, and the turn in place that may follow it.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: document A, equations (9)-(11); MATH.md, "Control laws".
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics._elementary import (
    agree,
    arctan2,
    components,
    cos,
    evaluated,
    operand,
    sin,
    wrapped,
)


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
        ValueError: The last axis of state or goal has a wrong length, shapes do not broadcast,
            something is not finite, or the twist overflows.
    """
    x, y, theta = components('state', state, 3)
    x_goal, y_goal = components('goal', goal, 2)
    Kp, Kv = operand('Kp', Kp), operand('Kv', Kv)
    single = agree(state=x, goal=x_goal, Kp=Kp, Kv=Kv)
    v, omega = evaluated(single, 'state, goal, Kp and Kv', _law, x, y, theta, x_goal, y_goal, Kp, Kv)
    return v, omega


def _law(x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any, Kp: Any, Kv: Any) -> tuple[Any, Any]:
    dx, dy = x_goal - x, y_goal - y
    c, s = cos(theta), sin(theta)
    # d cos(e) and d sin(e): the goal's position in the body frame. It needs no wrapping. Without
    # negative zeros the angle of (0, 0) is 0.
    return steer(c * dx + s * dy + 0.0, c * dy - s * dx + 0.0, Kp, Kv)


def steer(ahead: Any, aside: Any, Kp: Any, Kv: Any) -> tuple[Any, Any]:
    """Give the law for a goal that lies `[ahead, aside]` of the robot (m), unchecked."""
    return Kv * ahead, Kp * arctan2(aside, ahead)


def turn_in_place(theta: Any, heading: Any, Kp: Any) -> tuple[Any, Any]:
    """Turn to a heading the short way round: `v = 0`, `omega = Kp wrap(heading - theta)`.

    Args:
        theta: Heading of the robot, shape (...) (rad).
        heading: Heading to take, shape (...) (rad).
        Kp: Gain on the heading error, shape (...) (1/s).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: Shapes do not broadcast, something is not finite, or the twist overflows.
    """
    theta, heading, Kp = operand('theta', theta), operand('heading', heading), operand('Kp', Kp)
    single = agree(theta=theta, heading=heading, Kp=Kp)
    (omega,) = evaluated(
        single,
        'theta, heading and Kp',
        lambda theta, heading, Kp: (Kp * wrapped(heading - theta),),
        theta,
        heading,
        Kp,
    )
    return 0.0 * omega, omega
