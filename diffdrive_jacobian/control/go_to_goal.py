"""Document A's law that drives a unicycle to a position, and a turn in place.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: document A, equations (9)-(11); doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from math import isfinite
from typing import Any

from numpy.typing import ArrayLike

from diffdrive_jacobian.control.controller import Boundary, Controller, GainValues, ReferenceGains
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
from diffdrive_jacobian.kinematics.saturation import VelocityLimits


def go_to_goal(state: ArrayLike, goal: ArrayLike, Kp: Any, Kv: Any) -> tuple[Any, Any]:
    """Compute the twist that drives a unicycle to a position.

    `e = wrap(atan2(y_g - y, x_g - x) - theta)`, `omega = Kp e`, `v = Kv d cos(e)`, where d is the
    distance. In continuous time `d_dot = -Kv d cos^2(e) <= 0`, so the distance never grows. With
    `Kp < Kv` the heading error does not converge to zero and the robot spirals in.

    When the law is sampled, the robot arrives with `Kp < 2 rate` and `Kv < rate`, and if commands take
    effect up to one sample late, with `Kp + Kv < rate`. Half of that is recommended.

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
    # Tuples are unpacked here, because a call would take as long as the law.
    x, y, theta = (
        state if isinstance(state, tuple) and len(state) == 3 else components('state', state, 3)
    )
    x_goal, y_goal = goal if isinstance(goal, tuple) and len(goal) == 2 else components('goal', goal, 2)
    if (
        type(x) is type(y) is type(theta) is type(x_goal) is type(y_goal) is float
        and type(Kp) is type(Kv) is float
        and isfinite(x + y + theta + x_goal + y_goal + Kp + Kv)
    ):
        # Functions of floats, which need not look up the types of their arguments.
        v, omega = _law(x, y, theta, x_goal, y_goal, Kp, Kv, math.cos, math.sin, math.atan2)
        if isfinite(v + omega):
            return v, omega
    if isinstance(state, tuple):
        x, y, theta = components('state', state, 3)
    if isinstance(goal, tuple):
        x_goal, y_goal = components('goal', goal, 2)
    Kp, Kv = operand('Kp', Kp), operand('Kv', Kv)
    single = agree(state=x, goal=x_goal, Kp=Kp, Kv=Kv)
    v, omega = evaluated(single, 'state, goal, Kp and Kv', _law, x, y, theta, x_goal, y_goal, Kp, Kv)
    return v, omega


def _law(
    x: Any,
    y: Any,
    theta: Any,
    x_goal: Any,
    y_goal: Any,
    Kp: Any,
    Kv: Any,
    cos: Callable[[Any], Any] = cos,
    sin: Callable[[Any], Any] = sin,
    arctan2: Callable[[Any, Any], Any] = arctan2,
) -> tuple[Any, Any]:
    dx, dy = x_goal - x, y_goal - y
    c, s = cos(theta), sin(theta)
    # d cos(e) and d sin(e): the goal's position in the body frame. It needs no wrapping. Without
    # negative zeros the angle of (0, 0) is 0.
    x, y = c * dx + s * dy + 0.0, c * dy - s * dx + 0.0
    # As `steer`, whose call would take as long as the formula.
    return Kv * x, Kp * arctan2(y, x)


def steer(x: Any, y: Any, turn: Any, Kp: Any, Kv: Any) -> tuple[Any, Any]:
    """Compute the law for a goal at `[x, y]` in the body frame (m), unchecked; `turn` is ignored."""
    return Kv * x, Kp * arctan2(y, x)


def _advice(gains: GainValues, limits: VelocityLimits) -> Iterator[str]:
    if gains.kp <= gains.kv:
        yield (
            f'kp {gains.kp:g} is not larger than kv {gains.kv:g}: the robot approaches faster than it '
            'turns and spirals in; choose kp > kv'
        )


CONTROLLER = Controller(
    name='go_to_goal',
    law=go_to_goal,
    summary="document A's law, to a position",
    advice=_advice,
    slope=lambda gains: gains.kp + gains.kv,
    boundary=Boundary(ratio=1.0, beyond='with a larger kv the robot spirals in'),
    reference_gains=ReferenceGains(kp=3.0, kv=0.5, source="document A's gains"),
    steer=steer,
)


def turn_in_place(theta: Any, heading: Any, Kp: Any) -> tuple[Any, Any]:
    """Compute the twist that turns to a heading by the smaller angle.

    `v = 0`, `omega = Kp wrap(heading - theta)`.

    When the law is sampled, it converges with `Kp < 2 rate`. If commands take effect up to one sample
    late, it converges from rest with `Kp < rate`. Half of that is recommended.

    Args:
        theta: Heading of the robot, shape (...) (rad).
        heading: Desired heading, shape (...) (rad).
        Kp: Gain on the heading error, shape (...) (1/s).

    Returns:
        `(v, omega)`, each of shape (...) (m/s, rad/s).

    Raises:
        ValueError: Shapes do not broadcast, something is not finite, or the twist overflows.
    """
    if type(theta) is type(heading) is type(Kp) is float and isfinite(theta + heading + Kp):
        (omega,) = _turn(theta, heading, Kp)
        if isfinite(omega):
            return 0.0 * omega, omega
    theta, heading, Kp = operand('theta', theta), operand('heading', heading), operand('Kp', Kp)
    single = agree(theta=theta, heading=heading, Kp=Kp)
    (omega,) = evaluated(single, 'theta, heading and Kp', _turn, theta, heading, Kp)
    return 0.0 * omega, omega


def _turn(theta: Any, heading: Any, Kp: Any) -> tuple[Any]:
    return (Kp * wrapped(heading - theta),)
