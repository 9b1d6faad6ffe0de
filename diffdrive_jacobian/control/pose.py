"""A law that drives a unicycle to a position and a heading, smoothly, from wherever it stands.

In polar coordinates about the goal, with rho the distance to it, alpha the bearing of the goal seen from
the robot, and phi the same bearing seen from the goal's heading, the unicycle moves as

    rho_dot = -v cos(alpha),  alpha_dot = v sin(alpha) / rho - omega,  phi_dot = v sin(alpha) / rho

Document A's law knows rho and alpha only; here the heading that is left, phi, bends the way.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: M. Aicardi, G. Casalino, A. Bicchi, A. Balestrino, "Closed loop steering of unicycle-like
vehicles via Lyapunov techniques", IEEE Robotics & Automation Magazine 2(1), 1995.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics._checks import positive
from diffdrive_jacobian.kinematics._elementary import (
    agree,
    arctan2,
    components,
    cos,
    evaluated,
    minimum,
    operand,
    sin,
    sinc,
    wrapped,
)

FASTER = 2.0
"""How many times as fast as the distance the heading settles, if nothing else is asked for."""


def go_to_pose(state: ArrayLike, goal: ArrayLike, Kp: Any, Kv: Any, h: Any = None) -> tuple[Any, Any]:
    """Drive to a position and a heading.

    `v = Kv rho cos(alpha)`, as document A's law has it, and
    `omega = Kp alpha + Kv cos(alpha) sin(alpha)/alpha (alpha + h phi)`. Held continuously,
    `V = rho^2 + alpha^2 + h phi^2` never grows, and everything comes to rest on the goal. Near it,
    heading and bearing settle like an oscillator of frequency `Kv sqrt(h)` damped by Kp, the distance
    like exp(-Kv t): for the heading to be there first, Kp should be above 2 Kv. A weight that is larger
    than it needs to be makes long ways round. Where the goal lies behind, the robot backs up while it
    turns to it, then drives on forwards; where it may not back up, it turns first. Sampled, Kp should be
    below a quarter of the rate; with a weight h of your own also `Kv^2 h < Kp rate`: from about twice
    that on, heading and bearing oscillate ever more near the goal.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Pose to take `[x, y, theta]`, shape (..., 3).
        Kp: Gain on the bearing, positive, shape (...) (1/s).
        Kv: Gain on the distance, positive, shape (...) (1/s).
        h: Weight of the heading, positive, shape (...); sampled, below `Kp rate / Kv^2`. None:
            `(Kp / (2 Kv))^2`, which damps critically, or from `Kp = 4 Kv` on `2 Kp / Kv - 4`, with which
            the heading settles like exp(-2 Kv t).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s). Exactly on the goal's position, where the bearing
        is undefined, both are zero.

    Raises:
        ValueError: A gain is not positive, the last axis of state or goal has a wrong length, shapes do
            not broadcast, something is not finite, or the twist overflows.
    """
    x, y, theta = components('state', state, 3)
    x_goal, y_goal, heading = components('goal', goal, 3)
    Kp, Kv = operand('Kp', Kp, positive), operand('Kv', Kv, positive)
    names = 'state, goal, Kp and Kv'
    if h is None:
        single = agree(state=x, goal=x_goal, Kp=Kp, Kv=Kv)
    else:
        h, names = operand('h', h, positive), 'state, goal, Kp, Kv and h'
        single = agree(state=x, goal=x_goal, Kp=Kp, Kv=Kv, h=h)
    v, omega = evaluated(single, names, _law, x, y, theta, x_goal, y_goal, heading, Kp, Kv, h)
    return v, omega


def _law(
    x: Any, y: Any, theta: Any, x_goal: Any, y_goal: Any, heading: Any, Kp: Any, Kv: Any, h: Any
) -> tuple[Any, Any]:
    dx, dy = x_goal - x, y_goal - y
    c, s = cos(theta), sin(theta)
    # Without negative zeros the angle of (0, 0) is 0.
    return steer(c * dx + s * dy + 0.0, c * dy - s * dx + 0.0, heading - theta, Kp, Kv, h)


def steer(ahead: Any, aside: Any, turn: Any, Kp: Any, Kv: Any, h: Any = None) -> tuple[Any, Any]:
    """Give the law for a goal that lies `[ahead, aside]` of the robot (m) and looks `turn` further to
    the left (rad), unchecked.
    """
    if h is None:
        least = minimum(Kp, 2.0 * FASTER * Kv)
        # The tangent goes on where the parabola would rise steeply; either way h Kv cannot overflow.
        weight = least / (4.0 * Kv) * least + FASTER * (Kp - least)
    else:
        weight = h * Kv
    alpha = arctan2(aside, ahead)
    # cos(alpha) sin(alpha) / alpha, without a hole at zero.
    bend = cos(alpha) * sinc(alpha)
    away = (ahead != 0.0) | (aside != 0.0)
    omega = Kp * alpha + bend * (Kv * alpha + weight * wrapped(alpha - turn))
    return Kv * ahead, omega * away
