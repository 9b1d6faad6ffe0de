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

"""Braking in time: commands from which a robot that takes time can still come to rest within a distance.

The commands under way and the limits of the acceleration give the twist that the motors demand, u_d(t),
linear in pieces (`actuators`). The twist u of the robot lags behind: `tau u' = u_d - u`. Integrated from
now to rest,

    integral of u dt = integral of u_d dt + tau u(0)

Here u(0) is measured by the odometry, and u_d is that of the transition which the robot really makes:
the slower one of v and omega also stretches the other one.

Source: doc/moments.md, "Acceleration, lag and delay".
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from diffdrive_jacobian.simulation.actuators import STANDSTILL, AccelerationLimits, Actuators
from diffdrive_jacobian.simulation.speeds import Twist
from diffdrive_jacobian.time_units import NANOSECONDS

HALVINGS = 20
"""Of the interval in which the share of a command is searched: it is found to 1e-6."""


class Braking:
    """The commands that were sent to a robot, and those from which it can still come to rest in time.

    The limit of the acceleration of the wheels is left out: whoever sends commands does not know the
    wheels.
    """

    def __init__(self, actuators: Actuators) -> None:
        """Start without commands.

        Args:
            actuators: How the robot follows commands.
        """
        self.actuators = actuators
        self._sent: deque[tuple[int, Twist]] = deque()
        """When each command takes effect (ns), and the command. The first one may have done so."""
        self._demanded: Twist | None = None
        """The demanded twist at the time `_stamp`; None: unknown."""
        self._stamp = 0

    def sent(self, stamp: int, command: Twist) -> None:
        """Add a command that is sent at a time (ns)."""
        self._sent.append((stamp + self.actuators.delay, command))

    def limited(
        self,
        stamp: int,
        twist: Twist,
        command: Twist,
        room: Callable[[float], Twist],
        period: float,
        *,
        offset: float = 0.0,
    ) -> Twist:
        """Return a command, scaled such that a stop one period later ends within a distance and a turn.

        Args:
            stamp: The time (ns).
            twist: Twist of the robot at that time, by its odometry (m/s, rad/s).
            command: The command `(v, omega)`.
            room: Returns the distance and the turn that are left, where the robot comes to rest after a
                turn; infinite: any (m, rad).
            period: Time from this command to the next one (s).
            offset: X coordinate in the body frame of the point for which the distance counts (m).
        """
        limits, tau = self.actuators.acceleration, self.actuators.lag
        if stamp < self._stamp:
            # The clock was set back.
            self._sent.clear()
            self._demanded = None
        self._advance(stamp)
        if self._demanded is None or not tau:
            # Without a lag the robot has the demanded twist.
            self._demanded = twist
        # From now until the command takes effect.
        then, coming, target = self._demanded, (tau * twist[0], tau * twist[1]), self._demanded
        now, effect = stamp, stamp + self.actuators.delay
        for at, following in (*self._sent, (effect, command)):
            if at > now:
                seconds = (at - now) / NANOSECONDS
                then, coming = _followed(then, target, limits, seconds, coming)
                now = at
            target = following

        def fits(share: float) -> bool:
            target = share * command[0], share * command[1]
            held, way = _followed(then, target, limits, period, coming)
            _, (distance, turn) = _followed(held, STANDSTILL, limits, math.inf, way)
            most, most_turn = room(turn)
            turn = abs(turn)
            return abs(distance) + abs(offset) * turn <= most and turn <= most_turn

        if fits(1.0):
            return command
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2.0
            low, high = (middle, high) if fits(middle) else (low, middle)
        return low * command[0], low * command[1]

    def _advance(self, stamp: int) -> None:
        """Let the demanded twist follow the commands until a time (ns)."""
        sent, limits = self._sent, self.actuators.acceleration
        while sent and sent[0][0] < stamp:
            at, target = sent[0]
            last = len(sent) == 1 or sent[1][0] > stamp
            end = stamp if last else sent[1][0]
            seconds = (end - max(at, self._stamp)) / NANOSECONDS
            if self._demanded is not None and seconds > 0.0:
                self._demanded, _ = _followed(self._demanded, target, limits, seconds, STANDSTILL)
            if last:
                break
            sent.popleft()
        self._stamp = stamp
        ended = len(sent) == 1 and sent[0][0] <= stamp and sent[0][1] == STANDSTILL
        if ended and self._demanded == STANDSTILL:
            # What moves the robot from now on, others command.
            sent.clear()
            self._demanded = None


def _followed(
    start: Twist, target: Twist, limits: AccelerationLimits, seconds: float, way: Twist
) -> tuple[Twist, Twist]:
    """Let a twist follow a target for a time; infinite: until it is reached.

    Returns:
        The twist at the end, and the distance and the turn, added to those before.
    """
    (v, omega), (distance, turn) = start, way
    for duration, (next_v, next_omega) in limits.transition(start, target):
        if duration > seconds:
            share, duration = seconds / duration, seconds
            next_v, next_omega = v + share * (next_v - v), omega + share * (next_omega - omega)
        distance += (v + next_v) / 2.0 * duration
        turn += (omega + next_omega) / 2.0 * duration
        v, omega, seconds = next_v, next_omega, seconds - duration
        if seconds <= 0.0:
            break
    if seconds < math.inf:
        distance, turn = distance + v * seconds, turn + omega * seconds
    return (v, omega), (distance, turn)
