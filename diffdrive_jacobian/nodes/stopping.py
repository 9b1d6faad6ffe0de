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

"""What a robot that takes time to stop means for those who stop it, in words.

Source: doc/moments.md, "Acceleration, lag and delay".
"""

from __future__ import annotations

import math

from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.simulation.actuators import Actuators, Wheels

NEGLIGIBLE = 5e-4
"""Motion that is not described (m, rad)."""
LEAST_SHARE = 0.02
"""A gain that is a smaller share of the present one is not recommended."""


def rolls_on(actuators: Actuators, twist: tuple[float, float], wheels: Wheels | None = None) -> str:
    """Describe how far a robot rolls after a zero command, to be appended to a sentence.

    Args:
        actuators: How it follows commands, as far as that is known.
        twist: Its twist `(v, omega)` (m/s, rad/s).
        wheels: Its wheels; None: the limit of their acceleration is left out.

    Returns:
        The description. Empty: it stops at once, or nothing is known.
    """
    if actuators.immediate or not math.isfinite(sum(twist)):
        return ''
    distance, turn = actuators.stopping_distance(twist, wheels)
    if max(abs(distance), abs(turn)) < NEGLIGIBLE:
        return ''
    return f'; the robot rolls on for about {abs(distance):.3f} m and turns by {turn:.3f} rad'


def overshoot_warnings(
    kv: float | None, kp: float | None, limits: VelocityLimits, actuators: Actuators
) -> list[str]:
    """Return warnings about gains that ask for more deceleration than a robot has.

    A law whose speed is `gain` times what is left, up to a limit, is too fast to stop where

        speed (reaction + speed / (2 deceleration)) > speed / gain

    Args:
        kv: Gain on the distance (1/s); None: the law has none.
        kp: Gain on the heading error (1/s); None: the law has none.
        limits: The velocity limits.
        actuators: How the robot follows commands, as far as that is known.
    """
    if actuators.immediate:
        return []
    v, omega = actuators.acceleration.v, actuators.acceleration.omega
    slowing_turns = min(-omega.max_deceleration, omega.max_deceleration_reverse)
    fastest_turn = max(-limits.min_omega, limits.max_omega)
    found = [
        _overshoots('kv', kv, limits.max_v, -v.max_deceleration, actuators.reaction, math.inf),
        _overshoots('kp', kp, fastest_turn, slowing_turns, actuators.reaction, math.pi),
    ]
    return [warning for warning in found if warning]


def _overshoots(
    name: str,
    gain: float | None,
    speed: float,
    deceleration: float,
    reaction: float,
    farthest: float,
) -> str:
    """Return the warning about one gain; '': it asks for no more than the robot can do.

    Args:
        name: 'kv', a gain on a distance (m), or 'kp', one on a turn (rad).
        gain: Its value (1/s); None: the law has none.
        speed: Largest speed (m/s or rad/s).
        deceleration: Largest deceleration (m/s^2 or rad/s^2).
        reaction: Time until a command has an effect (s).
        farthest: What is left at most (m or rad).
    """
    if gain is None:
        return ''
    fastest = 2.0 * deceleration * max(1.0 / gain - reaction, 0.0)
    if math.isnan(fastest):
        # No limit of the acceleration, and no time to react.
        fastest = 0.0
    begin, speed = fastest / gain, min(speed, gain * farthest)
    if speed <= fastest or begin >= farthest:
        return ''
    best = 1.0 / (reaction + speed / (2.0 * deceleration))
    what, further, unit = ('goals', 'further away', 'm') if name == 'kv' else ('turns', 'by more', 'rad')
    which = f'{what} {further} than {begin:.3g} {unit}' if begin else f'all {what}'
    # Without a limit of the velocity there are always goals that are too far away.
    lower = f'{name} below {best:.3g}, ' if best > LEAST_SHARE * gain else ''
    return (
        f'{name} {gain:g} lets the robot drive too fast to stop, as it takes time to follow commands: '
        f'{which} may be overshot; choose {lower}a lower limit of the velocity, or stop_in_time'
    )
