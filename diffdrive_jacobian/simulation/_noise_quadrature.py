"""Exact moments of the error of odometry along a motion whose speeds change with time.

The equations are those of `exact_moments`, with v(t), omega(t) and the densities vv(t), vw(t), ww(t).
With the heading `z = exp(i theta)` since the start, `m(t)` half the variance of the error psi of the
heading, and `u = exp(i psi)`, the error gamma of the position, in the frame of the start, obeys

    d gamma = z ((v + i vw/2) u - v) dt + z u dB_v

Its expectations are integrals over t, computed by Gauss-Legendre quadrature. E[gamma^2] and E[|gamma|^2]
need E[gamma], E[gamma u] and E[gamma* u] at the nodes, which are integrals of the polynomial through the
nodes. The motion is split where a wheel changes its direction, because there the densities have a kink.

Source: doc/mathematics.md, "Acceleration, lag and delay".
"""

from __future__ import annotations

import math
from itertools import pairwise
from math import cos, exp, expm1, isfinite, sin

from diffdrive_jacobian.simulation._noise_moments import NoiseMoments, central
from diffdrive_jacobian.simulation.exact_moments import Entries, composed, propagated_moments
from diffdrive_jacobian.simulation.speeds import RULE, Piece, rolled, sign_changes, travelled

MAX_NOISE = 0.25
"""Largest m of a step of the quadrature."""


def _integration_matrix() -> list[list[float]]:
    """Return A with `sum_j A_ij f(t_j)` the integral of f from 0 to the node `t_i`.

    By the Legendre polynomials P_k: `integral of P_k = (P_k+1 - P_k-1) / (2 k + 1)`.
    """
    count = len(RULE)
    legendre = []
    for node, _ in RULE:
        x = 2.0 * node - 1.0
        values = [1.0, x]
        for k in range(1, count):
            values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
        legendre.append(values)
    rows = []
    for upper in legendre:
        integrals = [upper[1] + 1.0, *(upper[k + 1] - upper[k - 1] for k in range(1, count))]
        rows.append(
            [
                weight / 2.0 * sum(i * p for i, p in zip(integrals, at, strict=False))
                for (_, weight), at in zip(RULE, legendre, strict=True)
            ]
        )
    return rows


MATRIX = _integration_matrix()


def moments_along(
    moments: Entries, theta: float, piece: Piece, dt: float, L: float, k: float
) -> Entries | None:
    """Propagate the moments of the error along a step of a motion, exactly.

    Args:
        moments: Moments at the start.
        theta: Reported heading at the start (rad).
        piece: The twist as reported, at most a step of the quadrature.
        dt: Its duration (s).
        L: Wheel separation (m).
        k: Variance per distance travelled of each wheel (m).

    Returns:
        The moments. None: they overflow.
    """
    right, left = _rims(piece, L)
    turns = (*sign_changes(right, dt, piece.tau), *sign_changes(left, dt, piece.tau))
    knots = [0.0, *sorted(turns), dt]
    found: Entries | None = moments
    try:
        for begin, end in pairwise(knots):
            part = piece.part(begin, end)
            distance = sum(rolled(rim, part, part.seconds) for rim in _rims(part, L))
            count = max(1, math.ceil(k * distance / (2.0 * L * L) / MAX_NOISE))
            for number in range(count):
                step = part.part(part.seconds * number / count, part.seconds * (number + 1) / count)
                if found is None:
                    return None
                found = _after(
                    found, theta + piece.path(begin + part.seconds * number / count)[1], step, L, k
                )
    except (OverflowError, ValueError):
        return None
    return found if found is not None and all(map(isfinite, found)) else None


def _rims(piece: Piece, L: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the speeds of the rims of the right and the left wheel."""
    mapped = piece.mapped(((1.0, L / 2.0), (1.0, -L / 2.0)))
    return mapped.v, mapped.omega


def _after(moments: Entries, theta: float, piece: Piece, L: float, k: float) -> Entries | None:
    """Return the moments after a step in which no wheel changes its direction."""
    if piece.constant:
        return propagated_moments(moments, theta, piece.twist(0.0), piece.seconds, L, k)
    cosine, sine = cos(theta), sin(theta)
    dx, dy, _ = piece.displacement(piece.seconds)
    gx, gy = cosine * dx - sine * dy, sine * dx + cosine * dy
    noise, m = _noise(piece, L, k)
    return composed(moments, cosine, sine, gx, gy, m, central(noise, m) if m else None)


def _noise(piece: Piece, L: float, k: float) -> tuple[NoiseMoments, float]:
    """Compute the moments of the noise of a step, in the frame of its start, and its m."""
    T, tau = piece.seconds, piece.tau
    v, omega = piece.twist(T / 2.0)
    right = math.copysign(k, v + omega * L / 2.0)
    left = math.copysign(k, v - omega * L / 2.0)
    # k |v_R| + k |v_L| = p v + q omega, and k |v_R| - k |v_L| = r v + s omega.
    p, q = right + left, (right - left) * L / 2.0
    r, s = right - left, (right + left) * L / 2.0
    nodes = []
    for node, weight in RULE:
        t = node * T
        v, omega = piece.twist(t)
        path, turn = travelled(piece.v, t, tau), travelled(piece.omega, t, tau)
        m = (p * path + q * turn) / (2.0 * L * L)
        vv, vw = (p * v + q * omega) / 4.0, (r * v + s * omega) / (2.0 * L)
        nodes.append((weight, v, turn, m, vv, vw))
    firsts, squares, products = [], [], []
    of_psi = 0j
    for weight, v, turn, m, _, vw in nodes:
        z = complex(cos(turn), sin(turn))
        loss, half = expm1(-m), 0.5j * vw
        decay = 1.0 + loss
        firsts.append(z * (v * loss + half * decay))
        squares.append(z * (v * expm1(-3.0 * m) + 3.0 * half * decay**3))
        products.append(z.conjugate() * (v * expm1(m) + half / decay))
        of_psi += weight * (z * decay * ((v + half) * 2j * m + vw))
    xx = xy = yy = 0.0
    first = square = product = 0j
    for row, (weight, v, turn, m, vv, vw), f, a, b in zip(
        MATRIX, nodes, firsts, squares, products, strict=True
    ):
        # E[gamma], E[gamma u] and E[gamma* u] at the node.
        mean = T * sum(map(_times, row, firsts))
        decay, drift = exp(-m), v + 0.5j * vw
        gamma_u, conjugate_u = (
            decay * T * sum(map(_times, row, squares)),
            decay * T * sum(map(_times, row, products)),
        )
        z = complex(cos(turn), sin(turn))
        with_conjugate = z * (drift * conjugate_u - v * mean.conjugate())
        with_gamma = z * (drift * gamma_u - v * mean)
        lost = expm1(-4.0 * m)
        double_c, double_s = z.real * z.real - z.imag * z.imag, 2.0 * z.real * z.imag
        xx += weight * ((with_conjugate + with_gamma).real + vv * (z.real**2 + lost * double_c / 2.0))
        yy += weight * ((with_conjugate - with_gamma).real + vv * (z.imag**2 - lost * double_c / 2.0))
        xy += weight * (with_gamma.imag + vv * (1.0 + lost) * double_s / 2.0)
        first, square, product = first + weight * f, square + weight * a, product + weight * b
    path, turn = piece.path(T)
    M = (p * path + q * turn) / (2.0 * L * L)
    first, of_psi, decay = first * T, of_psi * T, exp(-M)
    # E[gamma (exp(i psi) - 1)] and E[gamma* (exp(i psi) - 1)] at the end.
    a, b = decay * square * T - first, decay * product * T - first.conjugate()
    noise = NoiseMoments(
        *(first.real, first.imag, xx * T, xy * T, yy * T, of_psi.real, of_psi.imag),
        *((a.real + b.real) / 2.0, (a.imag + b.imag) / 2.0),
        *((a.imag - b.imag) / 2.0, (b.real - a.real) / 2.0),
    )
    return noise, M


def _times(factor: float, value: complex) -> complex:
    return factor * value
