"""A law that drives a unicycle smoothly to a position and a heading.

In polar coordinates about the goal, with rho the distance to it, alpha the bearing of the goal relative
to the robot's heading, and phi the same bearing relative to the goal's heading, the unicycle moves as

    rho_dot = -v cos(alpha),  alpha_dot = v sin(alpha) / rho - omega,  phi_dot = v sin(alpha) / rho

Document A's law uses rho and alpha only. This law also uses phi, which curves the path.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: M. Aicardi, G. Casalino, A. Bicchi, A. Balestrino, "Closed loop steering of unicycle-like
vehicles via Lyapunov techniques", IEEE Robotics & Automation Magazine 2(1), 1995.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.control.controller import Boundary, Controller, GainValues
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
from diffdrive_jacobian.kinematics.saturation import VelocityLimits

FASTER = 2.0
"""Ratio of the default rates at which heading and distance converge [-]."""
STEEPEST = 2.74
"""Largest slope of `phi cos(alpha) sin(alpha) / alpha` over alpha, with phi = pi [-]."""


def go_to_pose(state: ArrayLike, goal: ArrayLike, Kp: Any, Kv: Any, h: Any = None) -> tuple[Any, Any]:
    """Compute the twist that drives a unicycle to a position and a heading.

    `v = Kv rho cos(alpha)`, as in document A's law, and
    `omega = Kp alpha + Kv cos(alpha) sin(alpha)/alpha (alpha + h phi)`. In continuous time
    `V = rho^2 + alpha^2 + h phi^2` never grows, and all three converge to zero.

    Near the goal, heading and bearing behave like an oscillator of frequency `Kv sqrt(h)` with damping
    Kp, and the distance decays like exp(-Kv t). For the heading to converge first, Kp should be above
    2 Kv. A weight larger than necessary leads to longer paths. If the goal lies behind, the robot backs
    up while it turns to it and then drives forwards. If it may not back up, it turns first.

    When the law is sampled with `Kp > 2 Kv`, the robot arrives with `K = Kp + Kv (1 + 2.74 h)` below
    twice the rate, and if commands take effect up to one sample late, with K below the rate. Half of
    that is recommended. With the default h, K is at most `6.5 Kp`.

    Args:
        state: Pose of the robot, shape (..., 3).
        goal: Desired pose `[x, y, theta]`, shape (..., 3).
        Kp: Gain on the bearing, positive, shape (...) (1/s).
        Kv: Gain on the distance, positive, shape (...) (1/s).
        h: Weight of the heading, positive, shape (...). None:
            `(Kp / (2 Kv))^2`, which is critical damping, or for `Kp > 4 Kv` the smaller `2 Kp / Kv - 4`,
            with which the heading decays like exp(-2 Kv t).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s). Exactly on the goal's position, where the bearing
        is undefined, both are zero.

    Raises:
        ValueError: A gain is not positive, the last axis of state or goal has a wrong length, shapes do
            not broadcast, something is not finite, or the twist overflows.
    """
    # Tuples are unpacked here, because a call would take as long as the law.
    x, y, theta = (
        state if isinstance(state, tuple) and len(state) == 3 else components('state', state, 3)
    )
    x_goal, y_goal, heading = (
        goal if isinstance(goal, tuple) and len(goal) == 3 else components('goal', goal, 3)
    )
    if (
        type(x) is type(y) is type(theta) is type(x_goal) is type(y_goal) is type(heading) is float
        and type(Kp) is type(Kv) is float
        and Kp > 0.0 < Kv
        and (h is None or (type(h) is float and h > 0.0))
        and isfinite(x + y + theta + x_goal + y_goal + heading + Kp + Kv + (h or 0.0))
    ):
        v, omega = _law(x, y, theta, x_goal, y_goal, heading, Kp, Kv, h)
        if isfinite(v + omega):
            return v, omega
    if isinstance(state, tuple):
        x, y, theta = components('state', state, 3)
    if isinstance(goal, tuple):
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


def steer(x: Any, y: Any, turn: Any, Kp: Any, Kv: Any, h: Any = None) -> tuple[Any, Any]:
    """Compute the law for a goal at `[x, y]` (m) with the heading `turn` (rad) in the body frame,
    unchecked.
    """
    weight = _default_weight(Kp, Kv) if h is None else h * Kv
    alpha = arctan2(y, x)
    # cos(alpha) sin(alpha) / alpha, defined at zero too.
    bend = cos(alpha) * sinc(alpha)
    away = (x != 0.0) | (y != 0.0)
    omega = Kp * alpha + bend * (Kv * alpha + weight * wrapped(alpha - turn))
    return Kv * x, omega * away


def _default_weight(Kp: Any, Kv: Any) -> Any:
    """Return h Kv, which cannot overflow, for the default h."""
    least = minimum(Kp, 2.0 * FASTER * Kv)
    # The parabola is continued by its tangent.
    return least / (4.0 * Kv) * least + FASTER * (Kp - least)


def _slope(gains: GainValues) -> float:
    return gains.kp + gains.kv + STEEPEST * float(_default_weight(gains.kp, gains.kv))


def _advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.kp <= 2.0 * gains.kv:
        yield (
            f'kp {gains.kp:g} is not larger than twice kv {gains.kv:g}: the robot reaches the position '
            'before the heading, and turns in place there; choose kp > 2 kv'
        )


CONTROLLER = Controller(
    name='pose',
    law=go_to_pose,
    summary='to a position and a heading',
    takes_heading=True,
    advice=_advice,
    slope=_slope,
    boundary=Boundary(ratio=2.0, beyond='with a larger kv the robot turns on the spot at the goal'),
    steer=steer,
)
