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

Course: TypeAlias = tuple[Number, Number, Number]
"""a, b and c of a speed."""
Pose: TypeAlias = tuple[float, float, float]
"""`(x, y, theta)` (m, m, rad)."""
Twist: TypeAlias = tuple[float, float]
"""`(v, omega)` (m/s, rad/s)."""
STANDSTILL = (0.0, 0.0)
MAX_TURN = 1.0
"""Largest turn of a step of the quadrature (rad)."""
MAX_DECAY = 2.0
"""Largest duration of a step of the quadrature, in time constants of the exponential function."""


class Quadrature(NamedTuple):
    """Gauss-Legendre quadrature on [0, 1]."""

    nodes: tuple[tuple[float, float], ...]
    """Nodes and weights."""
    partial: tuple[tuple[float, ...], ...]
    """Weights of the integrals from 0 to each node, of the polynomial through the nodes."""

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


QUADRATURES = (0.05, Quadrature.of(3)), (0.25, Quadrature.of(4)), (math.inf, Quadrature.of(8))
"""The size of a step, and the quadrature for steps of at most that size."""


def speed_at(course: Course, t: Number, tau: float) -> Number:
    """Return a speed after the time t."""
    a, b, c = course
    # At the beginning it is the given speed, without rounding, also where that is zero.
    return (a + c) + (b * t + c * expm1(-t / tau)) if tau else a + b * t


def travelled(course: Course, t: Number, tau: float) -> Number:
    """Return the integral of a speed over the time t."""
    a, b, c = course
    line = (a + b * t / 2.0) * t
    return line - c * tau * expm1(-t / tau) if tau else line


class Piece(NamedTuple):
    """A twist over a time in which each of its speeds follows one course.

    Of one robot, with floats, or of many, with arrays in their place.
    """

    seconds: Number
    """Duration (s); the last piece: infinite."""
    v: Course
    omega: Course
    tau: float = 0.0
    """Time constant of the exponential function (s); 0: there is none, and c is 0."""

    @property
    def constant(self) -> bool:
        """Whether both speeds are constant."""
        return not (any(self.v[1:]) or any(self.omega[1:]))

    def twist(self, t: Number) -> tuple[Number, Number]:
        """Return the twist after the time t."""
        return speed_at(self.v, t, self.tau), speed_at(self.omega, t, self.tau)

    def part(self, begin: Number, end: Number) -> Piece:
        """Return the piece from one time to another."""
        decay = exp(-begin / self.tau) if self.tau else 1.0
        v, omega = ((a + b * begin, b, c * decay) for a, b, c in (self.v, self.omega))
        return Piece(end - begin, v, omega, self.tau)

    def mapped(self, rows: tuple[Twist, Twist]) -> Piece:
        """Return the piece with its twist multiplied by a matrix."""
        v, omega = (
            (
                p * self.v[0] + q * self.omega[0],
                p * self.v[1] + q * self.omega[1],
                p * self.v[2] + q * self.omega[2],
            )
            for p, q in rows
        )
        return Piece(self.seconds, v, omega, self.tau)

    def faster(self, v: float, omega: float) -> Piece:
        """Return the piece with constant speeds added."""
        (a, b, c), (d, e, f) = self.v, self.omega
        return self._replace(v=(a + v, b, c), omega=(d + omega, e, f))

    @property
    def step(self) -> float:
        """Duration of the steps of the quadrature (s)."""
        return float(self.seconds if self.constant else self.seconds / self.steps)

    @property
    def steps(self) -> Number:
        """Number of steps of the quadrature."""
        a, b, c = self.omega
        steps = (abs(a) + abs(b) * self.seconds / 2.0) * self.seconds / MAX_TURN
        if self.tau:
            # The speed lies between that at the beginning and those that it follows. (In a short piece
            # with a large b the terms of the speed are much larger than their sum.)
            first = a + b * self.tau
            fastest = maximum(abs(a + c), abs(first), abs(first + b * self.seconds))
            steps = fastest * self.seconds / MAX_TURN
            steps = maximum(steps, self.seconds / self.tau / MAX_DECAY)
        return maximum(1.0, ceil(steps))

    def state(self, t: Number) -> tuple[Number, Number, Number, Number]:
        """Return the twist after the time t, and the path and the turn until then."""
        (a, b, c), (d, e, f), tau = self.v, self.omega, self.tau
        path, turn = (a + b * t / 2.0) * t, (d + e * t / 2.0) * t
        if tau:
            loss = expm1(-t / tau)
            v, omega = (a + c) + (b * t + c * loss), (d + f) + (e * t + f * loss)
            path, turn = path - c * tau * loss, turn - f * tau * loss
            return v, omega, path, turn
        return a + b * t, d + e * t, path, turn

    def quadrature(self, t: float) -> Quadrature:
        """Return the quadrature for the time t, at most a step: with more nodes if it turns or decays
        more.

        The error of the displacement is below 1e-14 of the path, with a lag below 1e-12.
        """
        d, e, f = self.omega
        # With the derivative of order n of exp(i e t^2 / 2), up to n!! sqrt(e)^n.
        size = (abs(d) + abs(f) + 1.8 * sqrt(abs(e))) * t
        if self.tau:
            size = max(size, t / self.tau)
        return next(quadrature for most, quadrature in QUADRATURES if size <= most)

    def displacement(self, t: float) -> Pose:
        """Compute `(dx, dy, dtheta)` in the body frame of the beginning, after at most a step."""
        x = y = 0.0
        for node, weight in self.quadrature(t).nodes:
            v, _, _, turn = self.state(node * t)
            x += weight * v * cos(turn)
            y += weight * v * sin(turn)
        return x * t, y * t, travelled(self.omega, t, self.tau)


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
        index = bisect_right(self.begins, begin) - 1
        while begin < end:
            start, piece = self.begins[index], self.pieces[index]
            limit = self.begins[index + 1] if index + 1 < len(self.begins) else math.inf
            step = piece.step
            if step < math.inf:
                number = int((begin - start) / step) + 1
                # The quotient rounds.
                number += start + number * step <= begin
                if start + (number + 0.5) * step < limit:
                    # Long after the start a step may be shorter than the resolution of its time.
                    limit = max(start + number * step, math.nextafter(begin, math.inf))
            limit = min(limit, end)
            if limit > begin:
                yield piece.part(begin - start, limit - start), limit
            index += index + 1 < len(self.begins) and limit == self.begins[index + 1]
            begin = limit


def moved(pose: Pose, piece: Piece) -> Pose:
    """Return the pose after a piece, in steps that are short enough for one quadrature."""
    if piece.constant:
        return arc_end(pose, piece.twist(0.0), piece.seconds)
    begin, step = 0.0, piece.step
    for number in range(1, round(piece.seconds / step) + 1):
        part = piece.part(begin, number * step)
        pose = displaced(pose, part.displacement(part.seconds))
        begin = number * step
    return pose


def displaced(pose: Pose, displacement: Pose) -> Pose:
    """Return the pose after a displacement in its body frame; ValueError if it overflows."""
    (x, y, theta), (dx, dy, turn) = pose, displacement
    c, s = cos(theta), sin(theta)
    x, y = x + c * dx - s * dy, y + s * dx + c * dy
    if not (isfinite(x) and isfinite(y) and isfinite(turn)):
        raise ValueError('pose, twist and dt must give a finite result, but it overflows')
    return x, y, wrap(theta + turn)


def sign_changes(course: Course, seconds: float, tau: float) -> list[float]:
    """Return the times within a duration at which a speed changes its sign, in their order."""
    _, b, c = course
    bounds = [0.0, seconds]
    if c and b and c / (b * tau) > 0.0:
        # At the extremum.
        extremum = tau * math.log(c / (b * tau))
        if 0.0 < extremum < seconds:
            bounds.insert(1, extremum)
    found = []
    for low, high in pairwise(bounds):
        first, last = speed_at(course, low, tau), speed_at(course, high, tau)
        if first * last >= 0.0:
            continue
        if not c:
            found.append(low - first / b)
            continue
        while True:
            middle = (low + high) / 2.0
            if not low < middle < high:
                break
            if (speed_at(course, middle, tau) > 0.0) == (first > 0.0):
                low = middle
            else:
                high = middle
        found.append(low)
    return found


def rolled(course: Course, piece: Piece, seconds: float) -> float:
    """Return the integral of the absolute value of a speed of a piece over a time (s)."""
    times = [0.0, *sign_changes(course, seconds, piece.tau), seconds]
    places = [travelled(course, time, piece.tau) for time in times]
    return float(sum(abs(end - begin) for begin, end in pairwise(places)))


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
