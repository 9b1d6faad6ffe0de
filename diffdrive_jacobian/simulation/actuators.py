"""Wheels that do not follow commands at once: acceleration limits, saturated motors, lag and delay.

A command passes, in this order: the delay; the limits of the acceleration, as diff_drive_controller has
them, but with one time law s(t) for v and omega, `u(t) = u_0 + (u_1 - u_0) s(t)`; the largest speed of
each motor, which the robot does not know; and the lag, `tau d omega / dt = omega_demanded - omega`, the
same for both wheels. So each speed is `a + b t + c exp(-t / tau)` in each piece (`speeds`).

Source: doc/mathematics.md, "Acceleration, lag and delay".
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
    positive,
)
from diffdrive_jacobian.numerics.elementary import maximum, minimum, where
from diffdrive_jacobian.numerics.formula import Number, Vector
from diffdrive_jacobian.simulation.speeds import STANDSTILL as STANDSTILL
from diffdrive_jacobian.simulation.speeds import Piece, Profile, Twist
from diffdrive_jacobian.time_units import NANOSECONDS

SHORTEST = 1e-9
"""Shortest duration of a part of a transition, the resolution of times (s)."""
Speeds: TypeAlias = tuple[float, float]
"""`(omega_R, omega_L)` (rad/s)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AxisLimits(Checked):
    """Limits of the rate of change of one speed, v (m/s^2) or omega (rad/s^2); infinite: none.

    Raises:
        ValueError: A limit is zero, NaN or has the wrong sign.
    """

    max_acceleration: PositiveOrInfinite = math.inf
    """Of a speed that is zero or positive and grows."""
    max_deceleration: NegativeOrInfinite = -math.inf
    """Of a positive speed that falls, negative."""
    max_acceleration_reverse: NegativeOrInfinite = -math.inf
    """Of a speed that is zero or negative and falls, negative."""
    max_deceleration_reverse: PositiveOrInfinite = math.inf
    """Of a negative speed that rises, positive."""

    def rate(self, speed: Number, change: Number) -> Number:
        """Return the largest rate, not negative, of a change in the direction of `change`."""
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
        self, start: Vector, target: Vector, wheel_speeds: Callable[[Number, Number], Vector]
    ) -> Iterator[tuple[Number, Vector]]:
        """Yield the parts of the fastest transition along the straight line from one twist to another.

        `wheel_speeds` maps a twist to the wheel speeds (rad/s), linearly. Twists are those of one robot,
        of floats, or of many, of arrays.

        Yields:
            The duration of each part, and the twist at its end. Within a part both speeds are linear in
            time. A jump, where there is no limit, and what takes less than `SHORTEST` have no duration.
        """
        (v, omega), (v_target, omega_target) = start, target
        dv, domega = v_target - v, omega_target - omega
        wheels = maximum(*map(abs, wheel_speeds(dv, domega)))
        # Where v or omega changes its sign, as a share of the transition.
        v_zero, omega_zero = _zero(v, dv), _zero(omega, domega)
        share, here = 0.0, start
        for end in (minimum(v_zero, omega_zero), maximum(v_zero, omega_zero), 1.0):
            there = (
                where(end == 1.0, v_target, where(end == v_zero, 0.0, v + dv * end)),
                where(end == 1.0, omega_target, where(end == omega_zero, 0.0, omega + domega * end)),
            )
            # The time for the whole transition at the rates of this part; at no limit zero.
            seconds = maximum(
                abs(dv) / self.v.rate((here[0] + there[0]) / 2.0, dv),
                abs(domega) / self.omega.rate((here[1] + there[1]) / 2.0, domega),
                wheels / self.max_wheel_acceleration,
            )
            duration = seconds * (end - share)
            yield where(duration >= SHORTEST, duration, 0.0), there
            share, here = end, there


def _zero(speed: Number, change: Number) -> Number:
    """Return the share of a change after which a speed is zero; 1.0 if it is not on the way."""
    end = speed + change
    crosses = (minimum(speed, end) < 0.0) & (maximum(speed, end) > 0.0)
    return where(crosses, -speed / where(crosses, change, 1.0), 1.0)


SETTLING = 36.0
"""Time constants after which a lagging wheel has reached its speed: exp(-36) is 2e-16."""


class Wheels(Protocol):
    """The wheels of a robot, as `RobotModel` has them."""

    def wheel_speeds(self, v: float, omega: float) -> Speeds:
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
    return seconds and time_constant(name, seconds, '0 or ')


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

    def lagging(self, seconds: float) -> Actuators:
        """Return actuators whose lag is at least a time constant (s)."""
        return replace(self, lag=max(self.lag, seconds))

    def weakened(self, wheel: str, speed: float) -> Actuators:
        """Return actuators that turn the 'right' or 'left' wheel at most at a speed (rad/s)."""
        name = f'max_{wheel}_speed'
        return replace(self, **{name: min(speed, getattr(self, name))})

    @property
    def immediate(self) -> bool:
        """Whether a command is followed at once."""
        return not self.lag and not self.delay and self.acceleration.unlimited

    def limited(self, speeds: Speeds) -> Speeds:
        """Return the speeds that the motors can reach."""
        (right, left), most_right, most_left = speeds, self.max_right_speed, self.max_left_speed
        # Of a dead motor not -0.0.
        return (
            max(-most_right, min(most_right, right)) + 0.0,
            max(-most_left, min(most_left, left)) + 0.0,
        )

    def rolled(self, twist: Twist, wheels: Wheels | None = None) -> Twist:
        """Return the distance and the turn from when zero is commanded, after a held twist, to rest.

        Without `wheels` the limit of their acceleration is left out.
        """
        wheel_speeds = (lambda *_: STANDSTILL) if wheels is None else wheels.wheel_speeds
        parts = self.acceleration.transition(twist, STANDSTILL, wheel_speeds)
        seconds = self.reaction + sum(duration for duration, _ in parts) / 2.0
        v, omega = twist
        return v * seconds, omega * seconds

    @property
    def reaction(self) -> float:
        """Time by which a stop is later than without lag and delay (s)."""
        return self.delay / NANOSECONDS + self.lag

    def reached(self, twist: Twist, wheels: Wheels) -> Twist:
        """Return the twist that the motors reach when one is demanded."""
        demanded = wheels.wheel_speeds(*twist)
        reached = self.limited(demanded)
        return twist if reached == demanded else wheels.twist(*reached)


class Drive(NamedTuple):
    """How the speeds of a robot go on from an event, if there are no further ones."""

    demanded: Profile
    """The twist within the limits of the acceleration."""
    motion: Profile
    """The twist of the robot."""

    @classmethod
    def at(cls, stamp: int, twist: Twist) -> Drive:
        """Return a constant twist."""
        constant = Profile(stamp, [held(twist)])
        return cls(constant, constant)

    def followed(self, stamp: int, target: Twist, actuators: Actuators, wheels: Wheels) -> Drive:
        """Return how the speeds go on from a time (ns) when another target is to be reached.

        The motors may differ from those so far: their largest speeds and their lag are the new ones at
        once, the limits of the acceleration after the delay, with the target.
        """
        now = self.demanded.seconds(stamp)
        then = self.demanded.seconds(stamp + actuators.delay)
        rise = ramp(self.demanded.twist(then), target, actuators.acceleration, wheels)
        demanded = [*self.demanded.between(now, then), *rise]
        motion = demanded
        if actuators.max_right_speed < math.inf or actuators.max_left_speed < math.inf:
            motion = list(_saturated(demanded, actuators, wheels))
        if actuators.lag:
            here = self.motion.twist(self.motion.seconds(stamp))
            motion = list(_lagging(here, motion, actuators.lag))
        return Drive(Profile(stamp, demanded), Profile(stamp, motion))


def held(twist: Twist) -> Piece:
    """Return a twist that is held for ever."""
    v, omega = twist
    return Piece(math.inf, (v, 0.0, 0.0), (omega, 0.0, 0.0))


def ramp(start: Twist, target: Twist, limits: AccelerationLimits, wheels: Wheels) -> Iterator[Piece]:
    """Return the transition from one twist to another, which is then held for ever."""
    for seconds, end in limits.transition(start, target, wheels.wheel_speeds):
        if seconds > 0.0:
            yield _line(start, end, seconds)
        start = end
    yield held(target)


def _line(start: Twist, end: Twist, seconds: float) -> Piece:
    v, omega = ((a, (b - a) / seconds, 0.0) for a, b in zip(start, end, strict=True))
    return Piece(seconds, v, omega)


def _saturated(pieces: Iterable[Piece], actuators: Actuators, wheels: Wheels) -> Iterator[Piece]:
    """Return what the motors reach of speeds that are linear in each piece."""
    most = actuators.max_right_speed, actuators.max_left_speed
    for piece in pieces:
        if piece.seconds == math.inf:
            yield held(actuators.reached(piece.twist(0.0), wheels))
            continue
        ends = wheels.wheel_speeds(*piece.twist(0.0)), wheels.wheel_speeds(*piece.twist(piece.seconds))
        # Where a wheel reaches its limit.
        knots = {0.0, piece.seconds}
        for first, last, bound in zip(*ends, most, strict=True):
            for limit in (-bound, bound):
                if min(first, last) < limit < max(first, last):
                    knots.add(piece.seconds * (limit - first) / (last - first))
        times = sorted(knots)
        twists = [actuators.reached(piece.twist(time), wheels) for time in times]
        for index in range(len(times) - 1):
            yield _line(twists[index], twists[index + 1], times[index + 1] - times[index])


def _lagging(here: Twist, pieces: Iterable[Piece], tau: float) -> Iterator[Piece]:
    """Return how speeds follow others, which are linear in each piece, with first order."""
    settling = SETTLING * tau
    for piece in pieces:
        v, omega = (
            (a - b * tau, b, _rest(speed, a - b * tau))
            for (a, b, _), speed in zip(piece[1:3], here, strict=True)
        )
        begin = 0.0
        if v[2] or omega[2]:
            lagging = Piece(min(piece.seconds, settling), v, omega, tau)
            yield lagging
            begin, here = lagging.seconds, lagging.twist(lagging.seconds)
        if begin < piece.seconds:
            line = Piece(math.inf, (*v[:2], 0.0), (*omega[:2], 0.0)).part(begin, piece.seconds)
            yield line
            if piece.seconds < math.inf:
                here = line.twist(line.seconds)


def _rest(speed: float, asymptote: float) -> float:
    """Return by how much a lagging speed differs, zero if by its rounding error alone."""
    reached = math.isclose(speed, asymptote, rel_tol=1e-15, abs_tol=1e-16)
    return 0.0 if reached else speed - asymptote
