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

"""Speeds that change with time: in each piece of time v and omega are `a + b t + c exp(-t / tau)`.

That is what acceleration limits and a first-order lag of the wheels make of commands. The last piece is
constant and has no end. The pose is computed by Gauss-Legendre quadrature in equal steps of each piece,
so that it depends on the pieces alone, not on the times at which it is computed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from itertools import pairwise
from math import cos, isfinite, sin, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np

from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.numerics.elementary import ceil, exp, expm1, maximum, wrap
from diffdrive_jacobian.numerics.formula import Number
from diffdrive_jacobian.time_units import NANOSECONDS

Pose: TypeAlias = tuple[float, float, float]
"""`(x, y, theta)` (m, m, rad)."""
Twist: TypeAlias = tuple[float, float]
"""`(v, omega)` (m/s, rad/s)."""
STANDSTILL = (0.0, 0.0)
MAX_TURN = 1.0
"""Largest turn of a step of the quadrature (rad)."""
MAX_DECAY = 1.0
"""Largest duration of a step of the quadrature, in time constants of the exponential function."""


class Quadrature(NamedTuple):
    """Gauss-Legendre quadrature on [0, 1]."""

    nodes: tuple[tuple[float, float], ...]
    """Nodes and weights."""
    partial: tuple[tuple[float, ...], ...]
    """Row i has the weights of the integral from 0 to node i: `sum_j partial[i][j] f(node_j)`."""

    @classmethod
    def of(cls, count: int) -> Quadrature:
        """Return the quadrature with a number of nodes.

        By the Legendre polynomials P_k: `integral of P_k = (P_k+1 - P_k-1) / (2 k + 1)`.
        """
        x, weights = np.polynomial.legendre.leggauss(count)
        P = np.polynomial.legendre.legvander(x, count).T
        integrals = np.array([P[1] + 1.0, *(P[k + 1] - P[k - 1] for k in range(1, count))])
        partial = (integrals.T @ P[:count]) * weights / 4.0
        nodes = np.stack([(x + 1.0) / 2.0, weights / 2.0], axis=-1)
        return cls(tuple(map(tuple, nodes.tolist())), tuple(map(tuple, partial.tolist())))


QUADRATURES = tuple(
    (size, Quadrature.of(nodes)) for size, nodes in ((0.02, 3), (0.12, 4), (0.4, 5), (math.inf, 8))
)
"""The size of a step, and the quadrature for steps of at most that size."""


class Course(NamedTuple):
    """A speed over time, `a + b t + c exp(-t / tau)`.

    That of one robot, of floats, or those of many, with arrays in their place.
    """

    a: Number
    b: Number = 0.0
    c: Number = 0.0
    tau: float = 0.0
    """Time constant (s); 0: there is none, and c is 0."""

    def at(self, t: Number) -> Number:
        """Return the speed after the time t."""
        a, b, c, tau = self
        # At the beginning it is the given speed, without rounding, also where that is zero.
        return (a + c) + (b * t + c * expm1(-t / tau)) if tau else a + b * t

    def travelled(self, t: Number) -> Number:
        """Return its integral over the time t."""
        a, b, c, tau = self
        line = (a + b * t / 2.0) * t
        return line - c * tau * expm1(-t / tau) if tau else line

    def later(self, t: Number) -> Course:
        """Return the course that begins at the time t."""
        a, b, c, tau = self
        return Course(a + b * t, b, c * exp(-t / tau), tau) if tau else Course(a + b * t, b)

    def plus(self, speed: Number) -> Course:
        """Return the course with a constant speed added."""
        return self._replace(a=self.a + speed)

    def sign_changes(self, seconds: float) -> list[float]:
        """Return the times within a duration at which the speed of one robot changes its sign, in
        order.
        """
        _, b, c, tau = self
        bounds = [0.0, seconds]
        if c and b and c / (b * tau) > 0.0:
            # At the extremum.
            extremum = tau * math.log(c / (b * tau))
            if 0.0 < extremum < seconds:
                bounds.insert(1, extremum)
        found = []
        for low, high in pairwise(bounds):
            first = self.at(low)
            if first * self.at(high) >= 0.0:
                continue
            if not c:
                found.append(low - first / b)
                continue
            while low < (middle := (low + high) / 2.0) < high:
                if (self.at(middle) > 0.0) == (first > 0.0):
                    low = middle
                else:
                    high = middle
            found.append(low)
        return found

    def rolled(self, seconds: float) -> float:
        """Return the integral of the absolute value of the speed of one robot over a time (s)."""
        times = [0.0, *self.sign_changes(seconds), seconds]
        return float(sum(abs(b - a) for a, b in pairwise(map(self.travelled, times))))


def combined(p: float, first: Course, q: float, second: Course) -> Course:
    """Return `p first + q second`, of courses with one time constant."""
    a, b, c = (p * one + q * other for one, other in zip(first[:3], second[:3], strict=True))
    return Course(a, b, c, first.tau)


class Piece(NamedTuple):
    """A twist over a time in which each of its speeds follows one course, with one time constant."""

    seconds: Number
    """Duration (s); the last piece: infinite."""
    v: Course
    omega: Course

    @property
    def constant(self) -> bool:
        """Whether both speeds of one robot are constant."""
        return not (self.v.b or self.v.c or self.omega.b or self.omega.c)

    def twist(self, t: Number) -> tuple[Number, Number]:
        """Return the twist after the time t."""
        return self.v.at(t), self.omega.at(t)

    def part(self, begin: Number, end: Number) -> Piece:
        """Return the piece from one time to another."""
        return Piece(end - begin, self.v.later(begin), self.omega.later(begin))

    def rims(self, L: float, m_R: float = 1.0, m_L: float = 1.0) -> tuple[Course, Course]:
        """Return the speeds of the rims of right and left wheel: `m_R (v + omega L/2)`, `m_L (v -
        ...)`.
        """
        right = combined(m_R, self.v, m_R * L / 2.0, self.omega)
        return right, combined(m_L, self.v, -m_L * L / 2.0, self.omega)

    @property
    def steps(self) -> Number:
        """Number of equal steps, at least 1, which turn by at most `MAX_TURN` and last at most
        `MAX_DECAY` time constants.
        """
        (a, b, c, tau), T = self.omega, self.seconds
        if tau:
            # omega lies between that at the beginning and those that it follows. (In a short piece with
            # a large b the terms of omega are much larger than their sum.)
            first = a + b * tau
            fastest = maximum(abs(a + c), abs(first), abs(first + b * T))
            return ceil(maximum(1.0, fastest * T / MAX_TURN, T / tau / MAX_DECAY))
        return ceil(maximum(1.0, (abs(a) + abs(b) * T / 2.0) * T / MAX_TURN))

    def quadrature(self, t: float) -> Quadrature:
        """Return the quadrature for the time t, at most a step.

        The error of the displacement is below 1e-13 of t times the largest |v|.
        """
        a, b, c, tau = self.omega
        # How far the integrand is from a polynomial: turn and decay, and sqrt(b) t for the turn b t^2 /
        # 2, with a factor for which the errors are alike.
        size = (abs(a) + abs(c) + 1.8 * sqrt(abs(b))) * t
        size += t / tau if tau else 0.0
        return next(quadrature for most, quadrature in QUADRATURES if size <= most)

    def displacement(self, t: float) -> Pose:
        """Compute `(dx, dy, dtheta)` in the body frame of the beginning, after at most a step."""
        x = y = 0.0
        for node, weight in self.quadrature(t).nodes:
            v, turn = self.v.at(node * t), self.omega.travelled(node * t)
            x += weight * v * cos(turn)
            y += weight * v * sin(turn)
        return x * t, y * t, self.omega.travelled(t)


class Profile:
    """The speeds from a time on: pieces one after the other. Immutable."""

    __slots__ = ('begins', 'pieces', 'start')

    def __init__(self, start: int, pieces: list[Piece]) -> None:
        """Take the time of the start (ns), and the pieces, the last one constant and without end."""
        self.start = start
        self.pieces = pieces
        self.begins = [0.0]
        for piece in pieces[:-1]:
            self.begins.append(self.begins[-1] + piece.seconds)
        if not isfinite(self.begins[-1]):
            raise ValueError('limits of the acceleration must be larger: a command is never reached')

    @property
    def final(self) -> Twist:
        """The twist in the end."""
        return self.pieces[-1].twist(0.0)

    @property
    def settled_at(self) -> int:
        """The time from which on the twist is constant (ns)."""
        return self.start + math.ceil(self.begins[-1] * NANOSECONDS)

    def seconds(self, stamp: int) -> float:
        """Return the time since the start (s) of a time (ns)."""
        return (stamp - self.start) / NANOSECONDS

    def twist(self, t: float) -> Twist:
        """Return the twist after a time (s)."""
        index = bisect_right(self.begins, t) - 1
        return self.pieces[index].twist(t - self.begins[index])

    def holds(self, twist: Twist, stamp: int) -> bool:
        """Return whether it is this twist from a time (ns) on."""
        return self.settled_at <= stamp and self.final == twist

    def between(self, begin: float, end: float) -> list[Piece]:
        """Return the pieces from one time to another (s)."""
        found = []
        for start, piece in zip(self.begins, self.pieces, strict=True):
            first, last = max(begin - start, 0.0), min(end - start, piece.seconds)
            if first < last:
                found.append(piece.part(first, last))
        return found

    def steps(self, begin: float, end: float) -> Iterator[tuple[Piece, float]]:
        """Yield the motion between two times (s) in steps that are short enough for one quadrature.

        Each is a piece that begins with the step and lasts as long, and the time at its end (s).
        """
        index, last = bisect_right(self.begins, begin) - 1, len(self.begins) - 1
        while begin < end:
            start, piece = self.begins[index], self.pieces[index]
            piece_end = limit = self.begins[index + 1] if index < last else math.inf
            if not piece.constant:
                step = piece.seconds / piece.steps
                number = int((begin - start) / step) + 1
                if start + number * step <= begin:
                    # The quotient rounds.
                    number += 1
                if start + (number + 0.5) * step < piece_end:
                    # Long after the start a step may be shorter than the resolution of its time.
                    limit = max(start + number * step, math.nextafter(begin, math.inf))
            limit = min(limit, end)
            if limit > begin:
                yield piece.part(begin - start, limit - start), limit
            if limit == piece_end:
                index += 1
            begin = limit


def moved(pose: Pose, piece: Piece) -> Pose:
    """Return the pose after a piece, in steps that are short enough for one quadrature."""
    if piece.constant:
        return arc_end(pose, piece.twist(0.0), piece.seconds)
    count = int(piece.steps)
    for number in range(count):
        step = piece.part(piece.seconds * number / count, piece.seconds * (number + 1) / count)
        pose = displaced(pose, step.displacement(step.seconds))
    return pose


def displaced(pose: Pose, displacement: Pose) -> Pose:
    """Return the pose after a displacement in its body frame; ValueError if it overflows."""
    (x, y, theta), (dx, dy, turn) = pose, displacement
    c, s = cos(theta), sin(theta)
    x, y = x + c * dx - s * dy, y + s * dx + c * dy
    if not (isfinite(x) and isfinite(y) and isfinite(turn)):
        raise ValueError('pose, twist and dt must give a finite result, but it overflows')
    return x, y, wrap(theta + turn)


def arc_end(pose: Pose, twist: Twist, dt: float) -> Pose:
    """Return `se2.integrate` of finite floats, for every message; ValueError if it overflows."""
    try:
        x, y, theta = integrate.floats(pose, twist, dt)
        if isfinite(x) and isfinite(y) and isfinite(theta):
            return x, y, theta
    except ValueError:
        # math.sin(inf)
        pass
    raise ValueError('pose, twist and dt must give a finite result, but it overflows')
