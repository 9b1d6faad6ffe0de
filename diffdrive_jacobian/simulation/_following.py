"""Robots of a batch that take time to follow commands: `actuators` for many robots at once.

From one sample to the next a robot follows at most two commands, because each has an effect after a
delay. Twists are arrays of shape (2, n): v (m/s) and omega (rad/s) of n robots.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.numerics.elementary import sinc
from diffdrive_jacobian.simulation.actuators import SETTLING, SHORTEST, Actuators, AxisLimits
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

AT_REST = 1e-9
"""Speed below which a robot counts as being at rest (m/s, rad/s)."""
ROUNDING = 1e-9
"""By how much a delay may differ from a multiple of the period, in periods."""

RULES = {4: 0.25, 8: 1.0}
"""Numbers of nodes, and the largest step with each: its turn (rad), or half its duration (time
constants). The error of a step is then below 1e-12 of its length."""


class Follower:
    """The twists of some robots, and the commands that they have yet to follow."""

    def __init__(self, actuators: Actuators, count: int, rate: float) -> None:
        """Start at rest."""
        self.acceleration, self.lag = actuators.acceleration, actuators.lag
        delay = actuators.delay / NANOSECONDS * rate
        periods = int(delay + ROUNDING)
        late = delay - periods if delay - periods > ROUNDING else 0.0
        # More nodes pay where a decay needs many steps.
        nodes = 8 if self.lag else 4
        x, weights = np.polynomial.legendre.leggauss(nodes)
        self.rule = [*zip((1.0 + x) / 2.0, weights / 2.0, strict=True)]
        self.largest = RULES[nodes]
        # How long the oldest command still counts after a sample, and how long the next one (s).
        self.shares = late / rate, (1.0 - late) / rate
        rest: Array = np.zeros((2, count))
        self.targets: deque[Array] = deque([rest] * (periods + 1))
        self._take(np.zeros((2, count)), np.zeros((2, count)))

    def _take(self, demanded: Array, twist: Array) -> None:
        # Without a lag they are the same.
        self.demanded, self.twist = demanded, twist if self.lag else demanded

    def at_rest(self) -> Mask:
        """Return which robots rest and have nothing to follow, shape (n,)."""
        moving: Mask = np.abs(self.twist).max(axis=0) > AT_REST
        for twist in (self.demanded, *self.targets):
            moving |= twist.any(axis=0)
        return np.logical_not(moving)

    def shrink(self, going: Rows) -> None:
        """Remove the robots that are finished."""
        self.targets = deque(target[:, going] for target in self.targets)
        self._take(self.demanded[:, going], self.twist[:, going])

    def steps(self, r: Any, L: Any, command: Array) -> Iterator[tuple[Rows, Array, Array]]:
        """Let the robots, of wheel radii r and separations L, drive until the next sample.

        Yields:
            For some of the robots what one step adds: the displacement in the body frame,
            `[dx, dy, dtheta]`, shape (3, k), and the integrals of |v|, v^2 and omega^2, shape (3, k).
        """
        self.targets.append(command)
        late, rest = self.shares
        if late:
            yield from self._follow(r, L, late)
        self.targets.popleft()
        yield from self._follow(r, L, rest)

    def _follow(self, r: Any, L: Any, seconds: float) -> Iterator[tuple[Rows, Array, Array]]:
        left = np.full(self.demanded.shape[1], seconds)
        for end, duration in self._transition(r, L, self.targets[0]):
            going = np.flatnonzero(left > 0.0)
            if not len(going):
                return
            begin, whole, end = self.demanded[:, going], duration[going], end[:, going]
            time = np.minimum(left[going], whole)
            left[going] -= time
            slope = np.divide(end - begin, whole, out=np.zeros_like(begin), where=whole > 0.0)
            self.demanded[:, going] = np.where(time < whole, begin + slope * time, end)
            moving = time > 0.0
            if moving.any():
                course = begin[:, moving], slope[:, moving]
                yield from self._piece(going[moving], time[moving], *course)

    def _transition(self, r: Any, L: Any, target: Array) -> Iterator[tuple[Array, Array]]:
        """Yield the ends and the durations of the parts of `AccelerationLimits.transition`."""
        start, limits = self.demanded.copy(), self.acceleration
        change = target - start
        crosses = np.minimum(start, target) * np.maximum(start, target) < 0.0
        zero = np.divide(-start, change, out=np.ones_like(start), where=crosses)
        wheels = np.abs(body_to_wheel.formula(*change, r, L)).max(axis=0)
        slowest = wheels / limits.max_wheel_acceleration
        share, here = np.zeros(start.shape[1]), start
        for upto in (*np.sort(zero, axis=0), np.ones_like(share)):
            if np.array_equal(upto, share):
                continue
            end = np.where(zero == upto, 0.0, start + change * upto)
            end = np.where(upto < 1.0, end, target)
            middle = (here + end) / 2.0
            seconds = slowest
            for limit, speed, by in zip((limits.v, limits.omega), middle, change, strict=True):
                seconds = np.maximum(seconds, np.abs(by) / _rate(limit, speed, by))
            duration = seconds * (upto - share)
            yield end, np.where(duration >= SHORTEST, duration, 0.0)
            share, here = upto, end
        yield target, np.full_like(share, np.inf)

    def _piece(
        self, rows: Rows, seconds: Array, speed: Array, slope: Array
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Yield the steps of a piece in which the demanded twists are linear."""
        tau = self.lag
        if not tau:
            yield from self._steps(rows, seconds, speed, slope, None)
            return
        speed = speed - slope * tau
        rest = self.twist[:, rows] - speed
        self.twist[:, rows] = speed + slope * seconds + rest * np.exp(-seconds / tau)
        decaying = np.minimum(seconds, SETTLING * tau)
        yield from self._steps(rows, decaying, speed, slope, rest)
        long = seconds > decaying
        if long.any():
            speed, slope = (speed + slope * decaying)[:, long], slope[:, long]
            yield from self._steps(rows[long], (seconds - decaying)[long], speed, slope, None)

    def _steps(
        self, rows: Rows, seconds: Array, speed: Array, slope: Array, rest: Array | None
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Yield the steps of the twists `speed + slope t + rest exp(-t / tau)`."""
        tau = self.lag
        # The turn is at most that with the fastest speed, which is one at an end.
        ends = [speed[1], speed[1] + slope[1] * seconds]
        if rest is not None:
            ends.append(speed[1] + rest[1])
        steps = seconds * np.max(np.abs(ends), axis=0)
        if rest is not None:
            steps = np.maximum(steps, seconds / tau / 2.0)
        elif not slope.any():
            steps = np.zeros_like(seconds)
        steps = np.maximum(np.ceil(steps / self.largest), 1.0)
        step = seconds / steps
        for number in range(int(steps.max())):
            some = steps > number
            begin = number * step[some]
            begins = speed[:, some] + slope[:, some] * begin
            decaying = None if rest is None else rest[:, some] * np.exp(-begin / tau)
            yield rows[some], *_integrals(self.rule, step[some], begins, slope[:, some], decaying, tau)


def _rate(limit: AxisLimits, speed: Array, change: Array) -> Array:
    """Return `AxisLimits.rate` of arrays."""
    rising = np.where(speed < 0.0, limit.max_deceleration_reverse, limit.max_acceleration)
    falling = np.where(speed > 0.0, -limit.max_deceleration, -limit.max_acceleration_reverse)
    return np.where(change > 0.0, rising, falling)


def _integrals(
    rule: list[tuple[float, float]],
    seconds: Array,
    speed: Array,
    slope: Array,
    rest: Array | None,
    tau: float,
) -> tuple[Array, Array]:
    """Integrate `speed + slope t + rest exp(-t / tau)` over a step, as `Follower.steps` yields it."""
    dx, dy = np.zeros_like(seconds), np.zeros_like(seconds)
    sums: Array = np.zeros((3, len(seconds)))

    def turned(t: Array) -> Array:
        turn: Array = (speed[1] + slope[1] * t / 2.0) * t
        if rest is not None:
            turn -= rest[1] * tau * np.expm1(-t / tau)
        return turn

    if rest is None and not slope.any():
        # An arc, as in `se2.integrate`.
        v, omega = speed
        half = omega * seconds / 2.0
        chord = v * seconds * sinc(half)
        sums += np.array([np.abs(v), v * v, omega * omega]) * seconds
        return np.array([chord * np.cos(half), chord * np.sin(half), omega * seconds]), sums
    for node, weight in rule:
        t = node * seconds
        v, omega = speed + slope * t + (0.0 if rest is None else rest * np.exp(-t / tau))
        turn = turned(t)
        dx += weight * v * np.cos(turn)
        dy += weight * v * np.sin(turn)
        sums += weight * np.array([np.abs(v), v * v, omega * omega])
    return np.array([dx * seconds, dy * seconds, turned(seconds)]), sums * seconds
