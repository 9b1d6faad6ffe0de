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

"""Wheels that do not follow commands at once: acceleration limits, saturated motors, lag and delay.

A commanded twist `u = [v, omega]` passes

1. the delay, during which what was commanded before goes on;

2. the limits of the acceleration, those of diff_drive_controller, but with one time law s(t) from 0 to 1
   for both speeds, `u(t) = u_0 + (u_1 - u_0) s(t)`: from rest, to rest and between twists of equal
   curvature the path is one circle;

3. the largest speed of each motor, which the robot does not know: the curvature is not kept;

4. the lag of what step 3 leaves, `tau du/dt = u_reached - u`. Both wheels have the same tau, so v and
   omega, which are linear in the wheel speeds, lag alike.

So v and omega are `a + b t + c exp(-t / tau)` in each piece of time (`speeds`).

Source: doc/moments.md, "Acceleration, lag and delay".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple, Protocol, TypeAlias

from diffdrive_jacobian.numerics.checks import (
    Checked,
    NegativeOrInfinite,
    NotNegativeOrInfinite,
    PositiveOrInfinite,
    nanoseconds,
    not_negative,
    number,
    one_of,
    positive,
)
from diffdrive_jacobian.numerics.elementary import maximum, minimum, where
from diffdrive_jacobian.numerics.formula import Number, Vector
from diffdrive_jacobian.simulation.speeds import STANDSTILL as STANDSTILL
from diffdrive_jacobian.simulation.speeds import Course, Piece, Profile, Twist
from diffdrive_jacobian.time_units import NANOSECONDS

SHORTEST = 1e-9
"""Shortest duration of a part of a transition, the resolution of times (s)."""
WheelSpeeds: TypeAlias = tuple[float, float]
"""`(omega_R, omega_L)` (rad/s)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AxisLimits(Checked):
    """Limits of the rate of change of one speed, v (m/s^2) or omega (rad/s^2); infinite: none.

    | speed | rises | falls |
    |---|---|---|
    | positive | `max_acceleration` | `max_deceleration`, a negative number |
    | negative | `max_deceleration_reverse` | `max_acceleration_reverse`, a negative number |

    From zero it is `max_acceleration` or `max_acceleration_reverse`. A limit that is zero, NaN or of the
    wrong sign raises ValueError.
    """

    max_acceleration: PositiveOrInfinite = math.inf
    """Speeding up forwards, positive."""
    max_deceleration: NegativeOrInfinite = -math.inf
    """Slowing down forwards, negative."""
    max_acceleration_reverse: NegativeOrInfinite = -math.inf
    """Speeding up backwards, negative."""
    max_deceleration_reverse: PositiveOrInfinite = math.inf
    """Slowing down backwards, positive: the speed rises to zero."""

    def rate(self, speed: Number, change: Number) -> Number:
        """Return the largest rate, as a positive number, of a change with the sign of `change`."""
        rising = where(speed < 0.0, self.max_deceleration_reverse, self.max_acceleration)
        falling = where(speed > 0.0, -self.max_deceleration, -self.max_acceleration_reverse)
        return where(change > 0.0, rising, falling)

    @property
    def unlimited(self) -> bool:
        """Whether no limit is set."""
        return self == _NO_LIMITS


_NO_LIMITS = AxisLimits()


@dataclass(frozen=True, kw_only=True, slots=True)
class AccelerationLimits(Checked):
    """Limits of the accelerations of a robot.

    Raises:
        ValueError: A field is of another class, or the limit of the wheels is not positive.
    """

    v: AxisLimits = _NO_LIMITS
    omega: AxisLimits = _NO_LIMITS
    max_wheel_acceleration: PositiveOrInfinite = math.inf
    """Largest angular acceleration of either wheel (rad/s^2)."""

    @property
    def unlimited(self) -> bool:
        """Whether no limit is set."""
        return self.v.unlimited and self.omega.unlimited and self.max_wheel_acceleration == math.inf

    def transition(
        self,
        start: Vector,
        target: Vector,
        wheel_speeds: Callable[[Number, Number], Vector] | None = None,
    ) -> Iterator[tuple[Number, Vector]]:
        """Yield the parts of `u(s) = start + (target - start) s`, s from 0 to 1, as fast as limits
        allow.

        s(t) is that of doc/mathematics.md. The limits change where v or omega changes its sign. So there
        are three parts: to the first such s, to the second, and to 1; some may be empty. In each, s is
        linear in time. From (1, 0) to (-1, 2), with v slowing down at 0.2 and speeding up at 1 m/s^2 and
        omega at 0.5 rad/s^2, they take 5 s, 2 s and nothing.

        Twists are those of one robot, of floats, or of many, of arrays. `wheel_speeds` maps a twist to
        the wheel speeds (rad/s), linearly; None: the limit of the wheels is left out.

        Yields:
            The duration of each part, and the twist at its end. A jump, where there is no limit, and
            what takes less than `SHORTEST` have no duration.
        """
        (v_0, omega_0), (v_1, omega_1) = start, target
        dv, domega = v_1 - v_0, omega_1 - omega_0
        wheel_change = maximum(*map(abs, wheel_speeds(dv, domega))) if wheel_speeds else 0.0
        v_zero, omega_zero = _zero(v_0, dv), _zero(omega_0, domega)
        s, (v, omega) = 0.0, start
        for s_end in (minimum(v_zero, omega_zero), maximum(v_zero, omega_zero), 1.0):
            v_end = _speed_at(s_end, v_zero, v_0, v_1)
            omega_end = _speed_at(s_end, omega_zero, omega_0, omega_1)
            # Seconds for s from 0 to 1 at the limits of this part: signs are taken in its middle, and
            # without a limit x / inf = 0.
            full_time = maximum(
                abs(dv) / self.v.rate((v + v_end) / 2.0, dv),
                abs(domega) / self.omega.rate((omega + omega_end) / 2.0, domega),
                wheel_change / self.max_wheel_acceleration,
            )
            duration = full_time * (s_end - s)
            yield where(duration >= SHORTEST, duration, 0.0), (v_end, omega_end)
            s, v, omega = s_end, v_end, omega_end


def _zero(speed: Number, change: Number) -> Number:
    """Return the s at which a speed changes its sign; 1.0, the end, if it does not."""
    end = speed + change
    crosses = (minimum(speed, end) < 0.0) & (maximum(speed, end) > 0.0)
    return where(crosses, -speed / where(crosses, change, 1.0), 1.0)


def _speed_at(s: Number, zero: Number, start: Number, target: Number) -> Number:
    """Return a speed at s, exactly zero or the target where it should be."""
    speed = where(s == zero, 0.0, start + (target - start) * s)
    return where(s == 1.0, target, speed)


SETTLING = 36.0
"""Time constants after which a lagging wheel has reached its speed: exp(-36) is 2e-16."""


class Wheels(Protocol):
    """The wheels of a robot, as `RobotModel` has them."""

    def wheel_speeds(self, v: float, omega: float) -> WheelSpeeds:
        """Return the wheel speeds of a twist."""

    def twist(self, omega_R: float, omega_L: float) -> Twist:
        """Return the twist of wheel speeds."""


def _duration(name: str, value: object) -> int:
    """Require a duration that is not negative (ns)."""
    duration = nanoseconds(name, value)
    if duration < 0:
        raise ValueError(f'{name} must be zero or positive (ns), got {duration}')
    return duration


Duration = Annotated[int, _duration]


def time_constant(name: str, value: object, words: str = '') -> float:
    """Require a time constant that is at least the resolution of times (s)."""
    seconds = number(name, value, positive)
    if seconds < SHORTEST:
        raise ValueError(f'{name} must be {words}at least {SHORTEST:g} s, got {seconds!r}')
    return seconds


def _lag(name: str, value: object) -> float:
    """Require zero or a time constant (s)."""
    seconds = number(name, value, not_negative)
    return time_constant(name, seconds, '0 or ') if seconds else seconds


@dataclass(frozen=True, kw_only=True, slots=True)
class Actuators(Checked):
    """How a robot carries out the twists that are commanded.

    Raises:
        ValueError: A value is negative or NaN, the lag is infinite or below `SHORTEST` but not zero, the
            delay is no integer, or the limits are of another class.
    """

    max_right_speed: NotNegativeOrInfinite = math.inf
    """Largest speed of the right wheel (rad/s); 0: its motor is dead, and the wheel stands still. The
    robot does not know it: unlike its velocity limits it does not keep the curvature of the path."""
    max_left_speed: NotNegativeOrInfinite = math.inf
    """Largest speed of the left wheel (rad/s)."""
    lag: Annotated[float, _lag] = 0.0
    """Time constant tau of both wheels (s): 0 or at least `SHORTEST`."""
    acceleration: AccelerationLimits = field(default_factory=AccelerationLimits)
    """Limits of the acceleration."""
    delay: Duration = 0
    """Time from a command to its effect on the motors (ns)."""
    immediate: bool = field(init=False, repr=False, compare=False)
    """Whether a command takes no time: a weak motor may still not reach it."""
    weak: bool = field(init=False, repr=False, compare=False)
    """Whether a motor has a largest speed."""

    def __post_init__(self) -> None:
        """Check every value."""
        Checked.__post_init__(self)
        immediate = not self.lag and not self.delay and self.acceleration.unlimited
        object.__setattr__(self, 'immediate', immediate)
        weak = min(self.max_right_speed, self.max_left_speed) < math.inf
        object.__setattr__(self, 'weak', weak)

    def lagging(self, seconds: float) -> Actuators:
        """Return actuators whose lag is at least a time constant (s)."""
        return replace(self, lag=max(self.lag, seconds))

    def weakened(self, wheel: str, speed: float) -> Actuators:
        """Return actuators that turn the 'right' or 'left' wheel at most at a speed (rad/s)."""
        one_of('right', 'left')('wheel', wheel)
        name = f'max_{wheel}_speed'
        return replace(self, **{name: min(speed, getattr(self, name))})

    def limited(self, speeds: WheelSpeeds) -> WheelSpeeds:
        """Return the speeds that the motors can reach."""
        (right, left), most_right, most_left = speeds, self.max_right_speed, self.max_left_speed
        # `+ 0.0` makes 0.0 of the -0.0 of a motor that does not turn.
        return (
            max(-most_right, min(most_right, right)) + 0.0,
            max(-most_left, min(most_left, left)) + 0.0,
        )

    def stopping_distance(self, twist: Twist, wheels: Wheels | None = None) -> tuple[float, float]:
        """Return how far a robot with a held twist rolls and turns after zero is commanded (m, rad).

        Without `wheels` the limit of their acceleration is left out, so the robot may roll farther. The
        largest speeds of the motors are left out, too: the twist must be one that they reach.
        """
        wheel_speeds = None if wheels is None else wheels.wheel_speeds
        parts = self.acceleration.transition(twist, STANDSTILL, wheel_speeds)
        # To zero no speed changes its sign, so both fall linearly: their mean is half.
        seconds = self.reaction + sum(duration for duration, _ in parts) / 2.0
        v, omega = twist
        return v * seconds, omega * seconds

    @property
    def reaction(self) -> float:
        """Delay plus lag (s): a robot that stops rolls on as far as it moved in this time before."""
        return self.delay / NANOSECONDS + self.lag

    def reached(self, twist: Twist, wheels: Wheels) -> Twist:
        """Return the twist that the motors reach when one is demanded."""
        if not self.weak:
            return twist
        demanded = wheels.wheel_speeds(*twist)
        reached = self.limited(demanded)
        return twist if reached == demanded else wheels.twist(*reached)


IDEAL = Actuators()
"""They follow every command at once."""


class Drive(NamedTuple):
    """How the speeds of a robot go on from an event, if there are no further ones."""

    demanded: Profile
    """The twist after the delay and the limits of the acceleration, before the largest speeds."""
    motion: Profile
    """The twist of the robot."""

    @classmethod
    def at(cls, stamp: int, twist: Twist) -> Drive:
        """Return a constant twist."""
        constant = Profile(stamp, [held(twist)])
        return cls(constant, constant)

    def followed(self, stamp: int, target: Twist, actuators: Actuators, wheels: Wheels) -> Drive:
        """Return how the speeds go on from a time (ns) when another target is commanded.

        During the delay the old plan goes on, with its ramps and the commands under way. Then the new
        ramp begins; what would have acted later is dropped. With a delay of 0.3 s, A commanded at 0 and
        B at 0.2 s, the ramp to A acts from 0.3 s to 0.5 s, and then that to B. The motors may differ
        from those so far: their largest speeds and their lag are the new ones at once, the limits of the
        acceleration after the delay.
        """
        now = self.demanded.seconds(stamp)
        acts = self.demanded.seconds(stamp + actuators.delay)
        old_plan = self.demanded.between(now, acts)
        rise = ramp(self.demanded.twist(acts), target, actuators.acceleration, wheels)
        demanded = [*old_plan, *rise]
        motion = demanded
        if actuators.weak:
            motion = list(_saturated(demanded, actuators, wheels))
        if actuators.lag:
            start = self.motion.twist(self.motion.seconds(stamp))
            motion = list(_lagging(start, motion, actuators.lag))
        return Drive(Profile(stamp, demanded), Profile(stamp, motion))


def held(twist: Twist) -> Piece:
    """Return a twist that is held for ever."""
    v, omega = twist
    return Piece(math.inf, Course(v), Course(omega))


def ramp(start: Twist, target: Twist, limits: AccelerationLimits, wheels: Wheels) -> Iterator[Piece]:
    """Return the transition from one twist to another, which is then held for ever."""
    for seconds, end in limits.transition(start, target, wheels.wheel_speeds):
        if seconds > 0.0:
            yield _line(start, end, seconds)
        start = end
    yield held(target)


def _line(start: Twist, end: Twist, seconds: float) -> Piece:
    v, omega = (Course(a, (b - a) / seconds) for a, b in zip(start, end, strict=True))
    return Piece(seconds, v, omega)


def _saturated(pieces: Iterable[Piece], actuators: Actuators, wheels: Wheels) -> Iterator[Piece]:
    """Return what the motors reach of speeds that are linear in each piece.

    Between the times at which a wheel reaches its limit each wheel is linear or at its limit, so v and
    omega are linear.
    """
    limits = actuators.max_right_speed, actuators.max_left_speed
    for piece in pieces:
        if piece.seconds == math.inf:
            yield held(actuators.reached(piece.twist(0.0), wheels))
            continue
        starts = wheels.wheel_speeds(*piece.twist(0.0))
        ends = wheels.wheel_speeds(*piece.twist(piece.seconds))
        knots = {0.0, piece.seconds}
        for start, end, limit in zip(starts, ends, limits, strict=True):
            for bound in (-limit, limit):
                if min(start, end) < bound < max(start, end):
                    knots.add(piece.seconds * (bound - start) / (end - start))
        times = sorted(knots)
        twists = [actuators.reached(piece.twist(time), wheels) for time in times]
        for index in range(len(times) - 1):
            yield _line(twists[index], twists[index + 1], times[index + 1] - times[index])


def _lagging(start: Twist, pieces: Iterable[Piece], tau: float) -> Iterator[Piece]:
    """Return how speeds that begin at `start` lag behind others, which are `a + b t` in each piece.

    The solution of `tau du/dt = a + b t - u` is `(a - b tau) + b t + (u(0) - (a - b tau)) exp(-t /
    tau)`. After `SETTLING` time constants the exponential function is left out.
    """
    for piece in pieces:
        v = _lag_behind(piece.v, start[0], tau)
        omega = _lag_behind(piece.omega, start[1], tau)
        begin = 0.0
        if v.c or omega.c:
            transient = Piece(min(piece.seconds, SETTLING * tau), v, omega)
            yield transient
            begin, start = transient.seconds, transient.twist(transient.seconds)
        if begin < piece.seconds:
            # Then the straight line is left.
            settled = Piece(math.inf, Course(v.a, v.b), Course(omega.a, omega.b))
            settled = settled.part(begin, piece.seconds)
            yield settled
            if piece.seconds < math.inf:
                start = settled.twist(settled.seconds)


def _lag_behind(target: Course, u: float, tau: float) -> Course:
    """Return how a speed u follows another one, as above; a c that is a rounding error is left out."""
    a = target.a - target.b * tau
    c = 0.0 if math.isclose(u, a, rel_tol=1e-15, abs_tol=1e-16) else u - a
    return Course(a, target.b, c, tau)
