"""Limits of the speed and of the acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep import Lockstep
from diffdrive_jacobian.properties._messages import Twist, twist_reader
from diffdrive_jacobian.properties.base import Property, Watch
from diffdrive_jacobian.time_units import NANOSECONDS

MARGIN = 1e-9
"""Relative margin for rounding."""


@dataclass(frozen=True, repr=False)
class NeverFasterThan(Property):
    """No twist on a topic is faster than a limit: `|linear.x| <= v` and `|angular.z| <= omega`.

    Each published message counts, whoever publishes it, and whether or not it is delivered. NaN is a
    violation, and so are bytes that are not a message. The limits have a relative margin of 1e-9 for
    rounding.

    Attributes:
        v: Largest speed (m/s); infinite: no limit.
        omega: Largest yaw rate (rad/s); infinite: no limit.
        topic: Topic of type Twist, TwistStamped or Odometry, of which the twist counts (default:
            'cmd_vel').
    """

    v: float
    omega: float
    topic: str = field(default='cmd_vel', kw_only=True)

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._number('v')
        self._number('omega')
        self._text('topic')

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _SpeedWatch(self, world)


class _SpeedWatch(Watch):
    def __init__(self, limit: NeverFasterThan, world: Lockstep) -> None:
        super().__init__(world)
        self._limit = limit
        self._v, self._omega = limit.v * (1.0 + MARGIN), limit.omega * (1.0 + MARGIN)
        self._read = twist_reader()
        world.expect(limit.resolved(limit.topic))
        self._topic = world.on_published(limit.resolved(limit.topic), self._on_message)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        twist = self._read(publisher.msg_type, message)
        if twist is None:
            self.found(f'{self._topic}: bytes that are no {publisher.msg_type.__name__}')
        elif not (abs(twist.v) <= self._v and abs(twist.omega) <= self._omega):
            self.found(
                f'{self._topic}: {twist}; allowed: |v| <= {self._limit.v:g} m/s, '
                f'|omega| <= {self._limit.omega:g} rad/s'
            )
        self.note(f'{self._topic}: {twist}')


@dataclass(frozen=True, repr=False)
class AccelerationWithin(Property):
    """The twists on a topic change at limited rates: by `v` m/s and `omega` rad/s per second.

    Messages leave and arrive early or late, and clocks jump. So a change of `v * slack` and
    `omega * slack` is allowed at once, and is then used up: it recovers at the rates of the limits. A
    sequence of messages violates this property if its changes (added without signs) exceed
    `v * (t + slack)` within some time t. Time is what the clock of the nodes or world time advances,
    whichever is more. The first message is compared with standstill. Messages with values that are not
    finite are violations.

    Attributes:
        v: Largest rate of change of linear.x (m/s^2); infinite: no limit.
        omega: Largest rate of change of angular.z (rad/s^2); infinite: no limit.
        topic: Topic of type Twist, TwistStamped or Odometry, of which the twist counts (default:
            'cmd_vel').
        slack: Time for which a change may be early (s) (default: 0.1).
        stops: Whether a twist of exactly zero is allowed at any time, as when a robot is stopped because
            its odometry is lost (default: True).
    """

    v: float
    omega: float
    topic: str = field(default='cmd_vel', kw_only=True)
    slack: float = field(default=0.1, kw_only=True)
    stops: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        """Check the fields."""
        super().__post_init__()
        self._number('v')
        self._number('omega')
        self._number('slack', infinite=False)
        self._text('topic')

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _AccelerationWatch(self, world)


class _AccelerationWatch(Watch):
    def __init__(self, limit: AccelerationWithin, world: Lockstep) -> None:
        super().__init__(world)
        self._limit = limit
        self._read = twist_reader()
        self._last = Twist(0.0, 0.0)
        self._at = self.seconds, world.now
        # What is left of the slack (s): the change that is allowed at once, in seconds of the limit.
        self._left_v = self._left_omega = limit.slack
        world.expect(limit.resolved(limit.topic))
        self._topic = world.on_published(limit.resolved(limit.topic), self._on_message)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        limit, last, (seconds, now) = self._limit, self._last, self._at
        twist = self._read(publisher.msg_type, message)
        if twist is None or not math.isfinite(twist.v + twist.omega):
            self.found(f'{self._topic}: {twist or "invalid bytes"}; allowed: finite values')
            return
        self._last, self._at = twist, (self.seconds, self.world.now)
        passed = max(self._at[0] - seconds, (self._at[1] - now) / NANOSECONDS)
        if limit.stops and twist.is_zero:
            self._left_v = min(self._left_v + passed, limit.slack)
            self._left_omega = min(self._left_omega + passed, limit.slack)
        else:
            self._left_v = _left(self._left_v + passed, twist.v - last.v, limit.v)
            self._left_omega = _left(self._left_omega + passed, twist.omega - last.omega, limit.omega)
            if min(self._left_v, self._left_omega) < -MARGIN:
                self.found(
                    f'{self._topic}: {twist}, after {last} {passed:g} s before; allowed: changes of '
                    f'{limit.v:g} m/s and {limit.omega:g} rad/s per second'
                )
            self._left_v = min(self._left_v, limit.slack)
            self._left_omega = min(self._left_omega, limit.slack)
        self.note(f'{self._topic}: {twist}')


def _left(left: float, change: float, rate: float) -> float:
    """Return what is left of a time after a change with a rate of change; negative: less than needed."""
    if change == 0.0:
        return left
    return left - abs(change) / rate if rate > 0.0 else -math.inf
