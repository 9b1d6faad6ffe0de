"""Limits of the speed and of the acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.publisher import Publisher

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import NotNegative, NotNegativeOrInfinite
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.properties._messages import Twist, read_twist
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

    v: NotNegativeOrInfinite
    omega: NotNegativeOrInfinite
    topic: Name = field(default='cmd_vel', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _SpeedWatch(self, world)


class _SpeedWatch(Watch):
    def __init__(self, limit: NeverFasterThan, world: Lockstep) -> None:
        super().__init__(world)
        self._limit = limit
        self._v, self._omega = limit.v * (1.0 + MARGIN), limit.omega * (1.0 + MARGIN)
        world.expect(limit.resolved(limit.topic))
        self._topic = world.on_published(limit.resolved(limit.topic), self._on_message)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        twist = read_twist(publisher.msg_type, message)
        if twist is None:
            self.found(f'{self._topic}: bytes that are no {publisher.msg_type.__name__}')
        elif not (abs(twist.v) <= self._v and abs(twist.omega) <= self._omega):
            self.found(
                f'{self._topic}: {twist}; allowed: |v| <= {self._limit.v:g} m/s, '
                f'|omega| <= {self._limit.omega:g} rad/s'
            )
        self.note(self._topic, ': ', twist)


@dataclass(frozen=True, repr=False)
class AccelerationWithin(Property):
    """The twists on a topic change at limited rates: by `v` m/s and `omega` rad/s per second.

    The changes (added without signs) within any time t must not exceed `v * (t + slack)` and
    `omega * (t + slack)`. So one message may change by `v * slack`, whatever time has passed since the
    one before: the motors got that one until then. `slack` must be at least the period of the messages,
    and more if they may leave late. Time is what the clock of the nodes or world time advances,
    whichever is more. Each publisher is checked on its own, its first message compared with standstill.
    Messages with values that are not finite are violations.

    Attributes:
        v: Largest rate of change of linear.x (m/s^2); infinite: no limit.
        omega: Largest rate of change of angular.z (rad/s^2); infinite: no limit.
        topic: Topic of type Twist, TwistStamped or Odometry, of which the twist counts (default:
            'cmd_vel').
        slack: Time for which changes may be early (s) (default: 0.1).
        stops: Whether a twist of exactly zero is allowed at any time, as when a robot is stopped because
            its odometry is lost (default: True).
    """

    v: NotNegativeOrInfinite
    omega: NotNegativeOrInfinite
    topic: Name = field(default='cmd_vel', kw_only=True)
    slack: NotNegative = field(default=0.1, kw_only=True)
    stops: bool = field(default=True, kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _AccelerationWatch(self, world)


class _AccelerationWatch(Watch):
    def __init__(self, limit: AccelerationWithin, world: Lockstep) -> None:
        super().__init__(world)
        self._limit = limit
        self._start = _Last(Twist(0.0, 0.0), self.seconds, world.now, limit.slack, limit.slack)
        self._last: dict[Publisher, _Last] = {}
        world.expect(limit.resolved(limit.topic))
        self._topic = world.on_published(limit.resolved(limit.topic), self._on_message)

    def _on_message(self, publisher: Publisher, message: Any) -> None:
        limit, last = self._limit, self._last.get(publisher, self._start)
        twist = read_twist(publisher.msg_type, message)
        if twist is None or not math.isfinite(twist.v + twist.omega):
            self.found(f'{self._topic}: {twist or "invalid bytes"}; allowed: finite values')
            return
        passed = max(self.seconds - last.seconds, (self.world.now - last.now) / NANOSECONDS)
        left_v = min(last.left_v + passed, limit.slack)
        left_omega = min(last.left_omega + passed, limit.slack)
        if not (limit.stops and twist.is_zero):
            left_v = _left(left_v, twist.v - last.twist.v, limit.v)
            left_omega = _left(left_omega, twist.omega - last.twist.omega, limit.omega)
            if min(left_v, left_omega) < -MARGIN:
                self.found(
                    f'{self._topic}: {twist}, after {last.twist} {passed:g} s before; allowed: changes '
                    f'of {limit.v:g} m/s and {limit.omega:g} rad/s per second, early by '
                    f'{limit.slack:g} s'
                )
        self._last[publisher] = _Last(twist, self.seconds, self.world.now, left_v, left_omega)
        self.note(self._topic, ': ', twist)


class _Last(NamedTuple):
    """The last message of a publisher."""

    twist: Twist
    seconds: float
    """World time (s)."""
    now: int
    """Time of the clock of the nodes (ns)."""
    left_v: float
    """What is left of the slack (s): the change that is allowed at once, in seconds of the limit."""
    left_omega: float


def _left(left: float, change: float, rate: float) -> float:
    """Return what is left of a time after a change with a rate of change; negative: less than needed."""
    if change == 0.0:
        return left
    return left - abs(change) / rate if rate > 0.0 else -math.inf
