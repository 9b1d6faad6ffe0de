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

from diffdrive_jacobian.control.controller import Boundary, Controller, GainValues
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import positive
from diffdrive_jacobian.numerics.elementary import atan2, cos, hypot, minimum, sinc, where, wrap
from diffdrive_jacobian.numerics.formula import Number, Vector, formula

FASTER = 2.0
"""Ratio of the default rates at which heading and distance converge [-]."""
STEEPEST = 2.74
"""Largest slope of `phi cos(alpha) sin(alpha) / alpha` over alpha, with phi = pi [-]."""


@formula('(3),(3),(),(),() -> (),()', Kp=positive, Kv=positive, h=positive)
def go_to_pose(
    state: Vector, goal: Vector, Kp: Number, Kv: Number, h: Number = None
) -> tuple[Number, Number]:
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
    least = minimum(Kp, 2.0 * FASTER * Kv)
    # The parabola is continued by its tangent.
    return (least / (2.0 * Kv)) ** 2 + FASTER * (Kp - least) / Kv


def _slope(gains: GainValues) -> float:
    return float(gains.kp + gains.kv * (1.0 + STEEPEST * default_weight(gains.kp, gains.kv)))


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
)
