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

"""Exact moments of the error of odometry along motions whose speeds change, by quadrature.

With the heading `z = exp(i theta)` since the start, `m(t)` half the variance of the error psi of the
heading, and `u = exp(i psi)`, the error gamma of the position obeys

    d gamma = z ((v + i vw/2) u - v) dt + z u dB_v

Its expectations are integrals over t, by Gauss-Legendre quadrature. The motion is split where a wheel
changes its direction. Source: doc/moments.md, "Acceleration, lag and delay".
"""

from __future__ import annotations

import math
from itertools import pairwise
from math import cos, exp, expm1, isfinite, sin
from operator import mul

from diffdrive_jacobian.simulation.exact_moments import (
    Entries,
    NoiseMoments,
    central,
    composed,
    propagated_moments,
)
from diffdrive_jacobian.simulation.odometry_noise import spectral_densities
from diffdrive_jacobian.simulation.speeds import Course, Piece

MAX_NOISE = 0.25
"""Largest m of a step of the quadrature."""
MOST_STEPS = 32
"""Most steps of a piece for its noise. With more the standard deviation of the heading exceeds 4 rad."""


def moments_along(
    moments: Entries, theta: float, piece: Piece, dt: float, L: float, k: float
) -> Entries | None:
    """Return the moments of the error after a step of the quadrature of a duration; None: they overflow.

    `theta` is the heading at the start (rad), L the wheel separation (m), k as of `odometry_noise` (m).
    """
    right, left = piece.rims(L)
    knots = [0.0, *sorted([*right.sign_changes(dt), *left.sign_changes(dt)]), dt]
    found: Entries | None = moments
    try:
        for begin, end in pairwise(knots):
            distance = sum(abs(rim.travelled(end) - rim.travelled(begin)) for rim in (right, left))
            count = max(1, min(math.ceil(k * distance / (2.0 * L * L) / MAX_NOISE), MOST_STEPS))
            lost = k * distance / (2.0 * L * L) > MOST_STEPS * MAX_NOISE
            for number in range(count):
                if found is None:
                    return None
                first = begin + (end - begin) * number / count
                step = piece.part(first, begin + (end - begin) * (number + 1) / count)
                if lost:
                    # The heading is not known any more, however it was driven.
                    step = _evenly(step)
                found = _after(found, theta + piece.omega.travelled(first), step, L, k)
    except (OverflowError, ValueError):
        return None
    return found if found is not None and all(map(isfinite, found)) else None


def _evenly(piece: Piece) -> Piece:
    """Return a piece with the same path and turn at constant speeds."""
    v, omega = (one.travelled(piece.seconds) / piece.seconds for one in (piece.v, piece.omega))
    return Piece(piece.seconds, Course(v), Course(omega))


def _after(moments: Entries, theta: float, piece: Piece, L: float, k: float) -> Entries | None:
    """Return the moments after a step in which no wheel changes its direction."""
    T = piece.seconds
    if piece.constant:
        twist = piece.twist(0.0)
        return propagated_moments(moments, theta, twist, spectral_densities(*twist, L, k), T)
    v, omega = piece.twist(T / 2.0)
    right = math.copysign(k, v + omega * L / 2.0)
    left = math.copysign(k, v - omega * L / 2.0)
    # k |v_R| + k |v_L| = p v + q omega, and k |v_R| - k |v_L| = r v + s omega.
    p, q = right + left, (right - left) * L / 2.0
    r, s = right - left, (right + left) * L / 2.0
    nodes, partial = piece.quadrature(T)
    # At the nodes: weight, heading, v, v + i vw/2, vv, m, exp(-m).
    at: list[tuple[float, complex, float, complex, float, float, float]] = []
    firsts, squares, products = [], [], []
    displacement = first = of_psi = 0j
    for node, weight in nodes:
        v, omega = piece.twist(node * T)
        path, turn = piece.v.travelled(node * T), piece.omega.travelled(node * T)
        m = max(p * path + q * turn, 0.0) / (2.0 * L * L)
        vw = (r * v + s * omega) / (2.0 * L)
        half, loss = 0.5j * vw, expm1(-m)
        z, decay = complex(cos(turn), sin(turn)), 1.0 + loss
        # Integrands of E[gamma], E[gamma u] / exp(-m) and E[gamma* u] / exp(-m).
        inner = z * (v * loss + half * decay)
        firsts.append(inner)
        squares.append(z * (v * expm1(-3.0 * m) + 3.0 * half * decay**3))
        products.append(z.conjugate() * (v * expm1(m) + half / decay))
        displacement += weight * v * z
        first += weight * inner
        of_psi += weight * (z * decay * ((v + half) * 2j * m + vw))
        # Near a standstill a wheel may turn the other way by rounding.
        vv = max(p * v + q * omega, 0.0) / 4.0
        at.append((weight, z, v, v + half, vv, m, decay))
    xx = xy = yy = 0.0
    square = product = 0j
    for row, (weight, z, v, drift, vv, m, decay), a, b in zip(
        partial, at, squares, products, strict=True
    ):
        # E[gamma], E[gamma u] and E[gamma* u] at the node.
        mean = T * sum(map(mul, row, firsts))
        gamma_u = decay * T * sum(map(mul, row, squares))
        conjugate_u = decay * T * sum(map(mul, row, products))
        with_conjugate = z * (drift * conjugate_u - v * mean.conjugate())
        with_gamma = z * (drift * gamma_u - v * mean)
        loss4, double = expm1(-4.0 * m), z * z
        xx += weight * (
            (with_conjugate + with_gamma).real + vv * (z.real**2 + loss4 * double.real / 2.0)
        )
        yy += weight * (
            (with_conjugate - with_gamma).real + vv * (z.imag**2 - loss4 * double.real / 2.0)
        )
        xy += weight * (with_gamma.imag + vv * (1.0 + loss4) * double.imag / 2.0)
        square, product = square + weight * a, product + weight * b
    path, turn = piece.v.travelled(T), piece.omega.travelled(T)
    m = max(p * path + q * turn, 0.0) / (2.0 * L * L)
    first, of_psi, decay = first * T, of_psi * T, exp(-m)
    # E[gamma (exp(i psi) - 1)] and E[gamma* (exp(i psi) - 1)] at the end.
    a, b = decay * square * T - first, decay * product * T - first.conjugate()
    noise = NoiseMoments(
        x=first.real,
        y=first.imag,
        xx=max(xx, 0.0) * T,
        xy=xy * T,
        yy=max(yy, 0.0) * T,
        xt=of_psi.real,
        yt=of_psi.imag,
        xc=(a.real + b.real) / 2.0,
        xs=(a.imag + b.imag) / 2.0,
        yc=(a.imag - b.imag) / 2.0,
        ys=(b.real - a.real) / 2.0,
    )
    cosine, sine = cos(theta), sin(theta)
    g = complex(cosine, sine) * displacement * T
    return composed(moments, cosine, sine, g.real, g.imag, m, central(noise, m) if m else None)
