"""Document A's law that drives a unicycle to a position, and a turn in place.

State: pose `[x, y, theta]` (m, m, rad). Output: body twist `v, omega` (m/s, rad/s). Everything
broadcasts over leading axes, the gains too.

Source: document A, equations (9)-(11); doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from collections.abc import Iterator

from diffdrive_jacobian.control.controller import Boundary, Controller, GainValues
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.elementary import atan2, cos, hypot, where, wrap
from diffdrive_jacobian.numerics.formula import Number, Vector, formula


@formula('(3),(2),(),() -> (),()')
def go_to_goal(state: Vector, goal: Vector, Kp: Number, Kv: Number) -> tuple[Number, Number]:
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
    x, y, theta = state
    x_goal, y_goal = goal
    d = hypot(x_goal - x, y_goal - y)
    theta_d = atan2(y_goal - y, x_goal - x)
    e = wrap(theta_d - theta)
    v = Kv * d * cos(e)
    omega = Kp * e
    # On the goal there is no heading towards it.
    return v, where(d > 0.0, omega, 0.0)


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
)


@formula('(),(),() -> (),()')
def turn_in_place(theta: Number, heading: Number, Kp: Number) -> tuple[Number, Number]:
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
    return 0.0, Kp * wrap(heading - theta)
