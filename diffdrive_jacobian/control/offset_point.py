"""Document B's law that drives a point beside the axle straight to its goal.

The axle centre itself cannot be controlled by its position: the Jacobian has rank 1. A point at distance
d ahead of it (behind, if d is negative) can: its Jacobian inverts for every heading.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, gain and offset too.

Source: document B, "Let's add a control point offset"; MATH.md, "Differential drive".
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics._checks import offset
from diffdrive_jacobian.kinematics._elementary import agree, components, cos, evaluated, operand, sin


def offset_point(state: ArrayLike, goal: ArrayLike, k: Any, d: Any) -> tuple[Any, Any]:
    """Drive the offset point along a straight line: `p_d_dot = k (goal - p_d)`.

    With wheel speeds the law is `w = J_d^-1 k (goal - p_d)`; here as the body twist `u = J_w w`:
    `v = k a`, `omega = k b / d`, where `[a, b]` is the way from the point to the goal, seen from the
    robot. The distance of the point decays as exp(-k t), whatever the heading. The point comes to rest
    on the goal, the axle centre |d| away from it. Sampled at a rate, that holds while
    `k distance < 2 |d| rate`: far from the goal, a short offset makes the robot turn too far.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Position for the point `[x, y]`, shape (..., 2) (m).
        k: Gain on the distance, shape (...) (1/s).
        d: Distance of the point ahead of the axle centre, not 0, shape (...) (m).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: d is 0, the last axis of state or goal has a wrong length, shapes do not broadcast,
            something is not finite, or the twist overflows.
    """
    x, y, theta = components('state', state, 3)
    x_goal, y_goal = components('goal', goal, 2)
    k, d = operand('k', k), operand('d', d, offset)
    single = agree(state=x, goal=x_goal, k=k, d=d)
    v, omega = evaluated(single, 'state, goal, k and d', _law, x, y, theta, x_goal, y_goal, k, d)
    return v, omega


def _law(x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any, k: Any, d: Any) -> tuple[Any, Any]:
    dx, dy = x_goal - x, y_goal - y
    c, s = cos(theta), sin(theta)
    return steer(c * dx + s * dy, c * dy - s * dx, k, d)


def steer(ahead: Any, aside: Any, k: Any, d: Any) -> tuple[Any, Any]:
    """Give the law for a goal that lies `[ahead, aside]` of the robot (m), unchecked."""
    return k * (ahead - d), k * aside / d
