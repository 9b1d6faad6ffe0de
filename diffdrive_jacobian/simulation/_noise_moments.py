"""Exact moments of the error that the wheels' noise adds along one arc.

Reported, a twist `[v, omega]` held for the time t moves the robot along an arc. Truly, v and omega are
disturbed by white noise with the spectral densities vv, vw, ww, the entries of W. At the end let psi be
the error of the heading, unwrapped, and gamma = gamma_x + i gamma_y the error of the position in the
frame of the reported pose. psi is Gaussian with variance `ww t`, gamma is not.

Notation: `x = i omega t`, `m = ww t / 2`, `alpha = v t`, `beta = vw t`, `h = exp(i psi)`. The moments
obey a linear differential equation with constant coefficients. Its solution is written with divided
differences of the exponential function: `[a, b] = (exp(a) - exp(b)) / (a - b)`, and so on. Where the
points of those are close to each other, a power series is used, so that no digits cancel. For the arcs
between two messages its first terms suffice.

Source: doc/mathematics.md, "Odometry covariance".
"""

from __future__ import annotations

import cmath
import math
from bisect import bisect_left
from typing import NamedTuple

SMALL_TURN = 0.05
"""Turn below which the power series is used (rad)."""
RADIUS = 1.0
"""Largest argument of the power series, `2 |omega t| + 4 m`. Longer straight arcs are halved."""
SHORT_TURN, SHORT_NOISE = 0.02, 1e-5
"""Largest turn (rad) and largest m of an arc for which `short_arc` is precise: 20 ms at 1 rad/s."""

FIRST_ORDER, LAST_ORDER = 6, 21


def _largest_argument(order: int) -> float:
    """Return the argument up to which the terms after an order are negligible, 1e-13 of the leading
    terms, which are of third order.
    """
    return float((1e-13 * math.factorial(order + 1) / 6.0) ** (1.0 / (order - 2)))


_ORDERS = [_largest_argument(order) for order in range(FIRST_ORDER - 1, LAST_ORDER)]


class NoiseMoments(NamedTuple):
    """Expectations over the noise of one arc, in the frame of the reported pose at its end."""

    x: float
    """E[gamma_x] (m)."""
    y: float
    xx: float
    """E[gamma_x^2] (m^2)."""
    xy: float
    yy: float
    xt: float
    """E[gamma_x psi] (m rad)."""
    yt: float
    xc: float
    """E[gamma_x (cos psi - 1)] (m)."""
    xs: float
    """E[gamma_x sin psi] (m)."""
    yc: float
    ys: float


def short_arc(alpha: float, turn: float, nu: float, beta: float, m: float) -> tuple[float, ...]:
    """Compute the moments of an arc between two messages, by the first terms of their series.

    All terms above 2e-14 of the standard deviations of position and heading are there, for a turn and an
    m of at most `SHORT_TURN` and `SHORT_NOISE`. In the frame of the chord and about the mean there are
    half as many as in other frames.

    Args:
        alpha: v t (m).
        turn: omega t (rad).
        nu: vv t (m^2).
        beta: vw t (m rad), at most `sqrt(2 m nu)`.
        m: ww t / 2.

    Returns:
        The entries of `central` moments, but in the frame of the chord, turned by `turn / 2` from that
        of the reported pose at the start.
    """
    s, a, b = turn * turn, alpha * m, beta * turn
    at, bm, am = a * turn, b * m, a * m
    # sin(turn / 2) / (turn / 2), and what several moments share.
    chord = 1.0 - s * (1 / 24 - s / 1920)
    sixth = 1 / 6 - s * (1 / 240 - s / 26880)
    short = 1 / 6 - s / 240
    bent = alpha * b * (1 / 6 - s * (1 / 120 - s / 5040))
    shift = nu * (s * (1 / 12 - s / 240) + m * (1.0 - s / 6 - m * (4 / 3))) - bent
    return (
        am * (1 / 6 - s / 120 - m / 24) - 0.5 * a * chord + bm * (1 / 24 - s / 960 - m / 48),
        beta * (0.5 * chord - m * (0.25 - s / 96 - m / 12))
        - at * (0.5 * sixth - m * (1 / 24 - s / 960 - m / 80)),
        nu
        - shift
        - 2.0 * bent
        - beta * beta * (0.5 - s / 24 - m * (2 / 3))
        + alpha
        * (
            bm * (1 / 3 - s / 45 - m * (13 / 24))
            + a * (s * (1 / 60 - s / 1260) + m * (1 / 3 - s * (7 / 120) - m * (7 / 15)))
        ),
        alpha
        * (
            beta * (0.5 - s * (1 / 24 - s / 720) - m * (7 / 6 - s * (13 / 120) - m * (35 / 24)))
            - at * (1 / 12 - s * (1 / 180 - s / 6720) - m * (13 / 60 - s * (19 / 1260) - m * (97 / 360)))
        )
        - nu * turn * m * (1 / 3 - s / 30 - m * (2 / 3))
        + beta * bm * (5 / 48),
        shift
        - beta * beta * m / 3
        + alpha
        * (
            a * (2 / 3 - s * (0.05 - s / 630) - m * (5 / 6 - s * (31 / 360) - m * 0.7))
            - bm * (1 / 6 - s / 90 - m * (59 / 120))
        ),
        beta * (chord - m * (1.0 - s / 24 - 0.5 * m)) - at * (sixth - m * (short - m * 0.075)),
        a * (chord - m * (2 / 3 - s / 30 - 0.25 * m)) - bm * (short - m / 8),
        am * (2 / 3 - s / 30 - m * (7 / 6)) + bm * (short - m * (5 / 12)),
        beta * (chord - m * (2.0 - s / 12 - m * (8 / 3))) - at * (sixth - m * (2.0 * short - m * 0.425)),
        at * m * (short - m * (19 / 60)) - beta * m * (1.0 - s / 24 - 2.0 * m),
        a * (chord - m * (5 / 3 - s * 0.075 - 1.75 * m)) - bm * (short - m * (11 / 24)),
    )


def central(noise: NoiseMoments, m: float) -> tuple[float, ...]:
    """Return the mean, and the other moments about the mean, in the order of `NoiseMoments`.

    Args:
        noise: The moments.
        m: ww t / 2, for which they were computed.
    """
    x, y, xx, xy, yy, xt, yt, xc, xs, yc, ys = noise
    loss = math.expm1(-m)
    return x, y, xx - x * x, xy - x * y, yy - y * y, xt, yt, xc - x * loss, xs, yc - y * loss, ys


def series(alpha: float, turn: float, nu: float, beta: float, m: float) -> NoiseMoments:
    """Compute the moments by their power series in time, for a short arc or a nearly straight one.

    Args:
        alpha: v t (m).
        turn: omega t (rad).
        nu: vv t (m^2).
        beta: vw t (m rad).
        m: ww t / 2.
    """
    # Straight on everything but E[gamma psi] is real, and floats are faster.
    x: complex = 1j * turn if turn else 0.0
    half: complex = 0.5j * beta if beta else 0.0
    drift, ahead, back, back_b, twice = alpha + half, alpha + 3.0 * half, x + m, x - m, 2.0 * x
    bent, by_m, by_4m = 2j * drift, -m, -4.0 * m
    # Coefficients of t^n, from n = 1 on: of exp(-m t) - 1 and exp(-4 m t) - 1, then of the moments
    # E[gamma], E[gamma psi], E[gamma h], E[gamma* h], E[|gamma|^2] - nu, and of nu - E[gamma^2].
    c, c4 = by_m, by_4m
    first, a, b = half, 3.0 * half, half
    turned: complex = complex(beta)
    rest: complex = 0.0
    straight: complex = twice * nu
    s_first, s_turned, s_a, s_b, s_square, s_rest = first, turned, a, b, 0.0, rest
    for n in range(2, FIRST_ORDER + bisect_left(_ORDERS, 2.0 * abs(turn) + 4.0 * m)):
        f = 1.0 / n
        short = alpha * first
        s_square += 2.0 * f * ((drift * b).real - short.real)
        rest = f * (straight - twice * rest - nu * c4 - 2.0 * (drift * a - short))
        turned = f * ((beta - (n - 1) * bent) * c - x * turned)
        first = f * (drift * c - x * first)
        behind = alpha * c
        a = f * (ahead * c4 - behind - back * a)
        b = f * (back_b * b - behind)
        c *= by_m * f
        c4 *= by_4m * f
        straight = 0.0
        s_rest += rest
        s_turned += turned
        s_first += first
        s_a += a
        s_b += b
    return _real(s_first, s_turned, s_a - s_first, s_b - s_first.conjugate(), s_square, nu, s_rest)


def closed_form(alpha: float, turn: float, nu: float, beta: float, m: float) -> NoiseMoments:
    """Compute the moments by divided differences, for a turn of at least `SMALL_TURN`.

    Arguments as for `series`.
    """
    x = 1j * turn
    y, x2, z, w, u = x - m, 2.0 * x - m, 2.0 * x - 4.0 * m, x - 3.0 * m, x + m
    e_x, e_m = cmath.exp(x), math.exp(-m)
    e_y, e_2x, e_4m = e_x * e_m, e_x * e_x, e_m**4
    # [0, -m], [0, 0, -m], [0, -3 m]
    h1, h2, h3 = _mean_decay(m), _mean_defect(m), _mean_decay(3.0 * m)
    p, r, q = (e_x - 1.0) / x, (e_y - 1.0) / y, e_m * (e_x - 1.0) / x  # [0, x], [0, y], [-m, y]
    back, back_2, half = e_x.conjugate(), e_2x.conjugate(), 0.5j * beta
    drift = alpha + half
    x_y_0 = (e_x * h1 - r) / x  # [0, x, y]
    first = half * r - alpha * m * x_y_0
    turned = 2j * m * drift * (e_y - r) / y + beta * r
    m_y_4 = (e_y * h3 - q) / w  # [-m, y, x - 4 m]
    m_4 = (e_x * e_4m - e_m) / w  # [-m, x - 4 m]
    a = alpha * m * (x_y_0 - 3.0 * m_y_4) + half * (3.0 * m_4 - r)
    b_conjugate = alpha * m * ((e_x * h1 - q) / u + x_y_0) - half * ((e_x - e_m) / u + r)
    y_0_m = ((q - h1) / y - h2) / y  # [0, 0, -m, y]
    x_0_m = ((p - 1.0) / x - h2) / u  # [0, 0, -m, x]
    y_0 = (r - 1.0) / y  # [0, 0, y]
    square = (
        2.0
        * (
            alpha * (alpha * m * (y_0_m + x_0_m) + half * (y_0 + (p - h1) / u + m * y_0_m))
            + half * half * y_0
        ).real
    )
    y_z = ((e_2x * e_4m - e_y) / w - r) / z  # [0, y, 2 x - 4 m]
    y_2_z = ((e_2x * e_m * h3 - e_y * p) / w - (e_y * p - r) / x2) / z  # [0, y, 2 x - m, 2 x - 4 m]
    x_2 = ((e_2x * e_m - e_x) / y - p) / x2  # [0, x, 2 x - m]
    x_2_2 = ((e_2x * h1 - e_x * p) / y - 0.5 * p * p) / x2  # [0, x, 2 x, 2 x - m]
    of_a = 3.0 * (half * y_z - alpha * m * y_2_z)
    pseudo = 2.0 * (alpha * (of_a + alpha * m * x_2_2 - half * x_2) + half * of_a)
    rest = nu * (1.0 - back_2 * (e_2x * e_4m - 1.0) / z)
    return _real(
        back * first,
        back * turned,
        back * a,
        (back * b_conjugate).conjugate(),
        square,
        nu,
        rest - back_2 * pseudo,
    )


def _real(
    first: complex,
    turned: complex,
    a: complex,
    b: complex,
    square: float,
    nu: float,
    rest: complex,
) -> NoiseMoments:
    """Return the real moments of complex ones; `a` is E[gamma (h - 1)], `b` is E[gamma* (h - 1)]."""
    return NoiseMoments(
        first.real,
        first.imag,
        nu + 0.5 * (square - rest.real),
        -0.5 * rest.imag,
        0.5 * (square + rest.real),
        turned.real,
        turned.imag,
        0.5 * (a.real + b.real),
        0.5 * (a.imag + b.imag),
        0.5 * (a.imag - b.imag),
        0.5 * (b.real - a.real),
    )


def _mean_decay(m: float) -> float:
    """Compute (1 - exp(-m)) / m, which is 1 at zero."""
    return -math.expm1(-m) / m if m else 1.0


def _mean_defect(m: float) -> float:
    """Compute (1 - (1 - exp(-m)) / m) / m, which is 1/2 at zero."""
    if m > 0.5:
        return (1.0 - _mean_decay(m)) / m
    total, term, n = 0.0, 0.5, 2
    while abs(term) > 1e-17:
        total += term
        n += 1
        term *= -m / n
    return total
