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

"""Robots of a batch that take time to follow commands: the motion of `actuators` for many at once.

From one sample to the next a robot follows at most two commands, because each has an effect after a
delay. Twists are arrays of shape (2, n): v (m/s) and omega (rad/s) of n robots.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.kinematics.se2 import exp
from diffdrive_jacobian.simulation.actuators import SETTLING, Actuators
from diffdrive_jacobian.simulation.speeds import QUADRATURES, Course, Piece
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

AT_REST = 1e-9
"""Speed below which a robot counts as being at rest (m/s, rad/s)."""
ROUNDING = 1e-9
"""By how much a delay may differ from a multiple of the period, in periods."""
_, QUADRATURE = QUADRATURES[-1]
"""That of the largest steps: which other robots there are must not matter."""


class Follower:
    """The twists of some robots, and the commands that they have yet to follow."""

    def __init__(self, actuators: Actuators, count: int, rate: float, samples: int) -> None:
        """Start at rest. There is a command at each of so many samples."""
        self.acceleration, self.lag = actuators.acceleration, actuators.lag
        delay = actuators.delay / NANOSECONDS * rate
        periods = int(delay + ROUNDING)
        late = delay - periods if delay - periods > ROUNDING else 0.0
        # How long the oldest command still counts after a sample, and how long the next one (s).
        self.shares = late / rate, (1.0 - late) / rate
        rest: Array = np.zeros((2, count))
        # What would act after the last sample need not be kept apart.
        self.targets: deque[Array] = deque([rest] * (min(periods, samples) + 1))
        # Samples since each robot was last commanded to move.
        self.idle = np.full(count, len(self.targets))
        # Without a lag they are the same.
        self.demanded = self.twist = rest

    def at_rest(self) -> Mask:
        """Return which robots rest and have nothing to follow, shape (n,)."""
        moving: Mask = np.abs(self.twist).max(axis=0) > AT_REST
        moving |= self.demanded.any(axis=0) | (self.idle < len(self.targets))
        return np.logical_not(moving)

    def shrink(self, going: Rows) -> None:
        """Remove the robots that are finished."""
        self.targets = deque(target[:, going] for target in self.targets)
        self.idle = self.idle[going]
        self.demanded, self.twist = self.demanded[:, going], self.twist[:, going]

    def advance(
        self, wheel_speeds: Callable[[Array, Array], Any], command: Array
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Let the robots drive until the next sample. `wheel_speeds` are those of a twist.

        Yields:
            For some of the robots what one step adds: the displacement in the body frame,
            `[dx, dy, dtheta]`, shape (3, k), and the integrals of |v|, v^2 and omega^2, shape (3, k).
        """
        self.targets.append(command)
        self.idle = np.where(command.any(axis=0), 0, self.idle + 1)
        late, rest = self.shares
        if late:
            yield from self._follow(wheel_speeds, late)
        self.targets.popleft()
        yield from self._follow(wheel_speeds, rest)

    def _follow(
        self, wheel_speeds: Callable[[Array, Array], Any], seconds: float
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Follow the present target for a time (s), with each robot's own parts of the transition."""
        target = self.targets[0]
        left = np.full(target.shape[1], seconds)
        transition = self.acceleration.transition(self.demanded, target, wheel_speeds)
        for duration, end in [*transition, (math.inf, target)]:
            time, begin = np.minimum(left, duration), self.demanded
            moving = np.isfinite(duration) & (duration > 0.0)
            slope = np.divide(end - begin, duration, out=np.zeros_like(begin), where=moving)
            reached = np.where(time < duration, begin + slope * time, end)
            self.demanded = np.where(left > 0.0, reached, begin)
            left = left - time
            rows = np.flatnonzero(time > 0.0)
            if len(rows):
                yield from self._piece(rows, time[rows], begin[:, rows], slope[:, rows])
        if not self.lag:
            self.twist = self.demanded

    def _piece(
        self, rows: Rows, seconds: Array, speed: Array, slope: Array
    ) -> Iterator[tuple[Rows, Array, Array]]:
        """Yield the steps of a piece in which the demanded twists are linear."""
        tau = self.lag
        if not tau:
            yield from _steps(rows, _of(seconds, speed, slope))
            return
        speed = speed - slope * tau
        piece = _of(seconds, speed, slope, self.twist[:, rows] - speed, tau)
        self.twist = self.twist.copy()
        self.twist[:, rows] = piece.twist(seconds)
        decaying = np.minimum(seconds, SETTLING * tau)
        yield from _steps(rows, piece._replace(seconds=decaying))
        long = seconds > decaying
        if long.any():
            begin, slope = (speed + slope * decaying)[:, long], slope[:, long]
            yield from _steps(rows[long], _of((seconds - decaying)[long], begin, slope))


def _of(
    seconds: Array, speed: Array, slope: Array, rest: Array | float = 0.0, tau: float = 0.0
) -> Piece:
    """Return the pieces with the twists `speed + slope t + rest exp(-t / tau)`."""
    rests = np.broadcast_to(rest, speed.shape)
    v, omega = (Course(*terms, tau) for terms in zip(speed, slope, rests, strict=True))
    return Piece(seconds, v, omega)


def _steps(rows: Rows, pieces: Piece) -> Iterator[tuple[Rows, Array, Array]]:
    """Yield what steps of pieces add that are short enough for the quadrature."""
    count = pieces.steps
    step = pieces.seconds / count
    for number in range(int(count.max())):
        some = count > number
        v, omega = (Course(a[some], b[some], c[some], tau) for a, b, c, tau in (pieces.v, pieces.omega))
        begin = number * step[some]
        part = Piece(step[some], v, omega).part(begin, begin + step[some])
        yield rows[some], *_integrals(part)


def _integrals(pieces: Piece) -> tuple[Array, Array]:
    """Integrate a step of each piece, as `Follower.advance` yields it."""
    (seconds, v, omega), nodes = pieces, QUADRATURE.nodes
    sums: Array = np.zeros((3, len(seconds)))
    if not v.tau and not np.any([v.b, omega.b]):
        sums += np.array([np.abs(v.a), v.a * v.a, omega.a * omega.a]) * seconds
        return np.array(exp.formula((v.a * seconds, 0.0, omega.a * seconds))), sums
    displacement: Array = np.zeros((2, len(seconds)))
    for node, weight in nodes:
        (speed, rate), turn = pieces.twist(node * seconds), omega.travelled(node * seconds)
        displacement += weight * speed * np.array([np.cos(turn), np.sin(turn)])
        sums += weight * np.array([np.abs(speed), speed * speed, rate * rate])
    return np.array([*(displacement * seconds), omega.travelled(seconds)]), sums * seconds
