"""Exact moments of the error that the wheels' noise adds along one arc.

Reported, a twist `[v, omega]` held for the time t moves the robot along an arc. Truly, v and omega are
disturbed by white noise with the spectral densities vv, vw, ww, the entries of W. At the end let psi be
the error of the heading, unwrapped, and gamma = gamma_x + i gamma_y the error of the position in the
frame of the reported pose. psi is Gaussian with variance `ww t`, gamma is not.

Notation: `x = i omega t`, `m = ww t / 2`, `alpha = v t`, `beta = vw t`, `h = exp(i psi)`. The moments
obey a linear differential equation with constant coefficients. Its solution is a power series in time,
which converges fast for short arcs. Longer ones are halved and composed again (`exact_moments`). For the
arcs between two messages the first terms of the series are written out.

Source: doc/mathematics.md, "Odometry covariance".
"""

from __future__ import annotations

import math
from operator import add
from typing import NamedTuple

RADIUS = 1.0
"""Largest argument of the power series, `2 |omega t| + 4 m`. Longer arcs are halved."""
SHORT_TURN, SHORT_NOISE = 0.02, 1e-5
"""Largest turn (rad) and largest m of an arc for which `short_arc` is precise: 20 ms at 1 rad/s."""

NEGLIGIBLE = 1e-15
"""Bound of the terms of the series that are left out, relative to those of third order, which lead."""


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
    """Compute the moments by their power series in time, for an arc up to `RADIUS`.

    Args:
        alpha: v t (m).
        turn: omega t (rad).
        nu: vv t (m^2).
        beta: vw t (m rad).
        m: ww t / 2.
    """
    x, half = 1j * turn, 0.5j * beta
    drift, ahead = alpha + half, alpha + 3.0 * half
    # Terms of t^n: of exp(-m t) - 1 and exp(-4 m t) - 1, then of the moments E[gamma], E[gamma psi],
    # E[gamma h], E[gamma* h], E[|gamma|^2] - nu, and of nu - E[gamma^2]; and the sums of the latter.
    c, c4 = -m, -4.0 * m
    terms = half, complex(beta), 3.0 * half, half, 0.0, 0j
    sums = terms
    straight, n, bound = 2.0 * x * nu, 1, 1.0
    while bound > NEGLIGIBLE:
        n += 1
        if n > 3:
            bound *= (2.0 * abs(turn) + 4.0 * m) / n
        first, turned, a, b, _, rest = terms
        terms = (
            (drift * c - x * first) / n,
            ((beta - 2j * (n - 1) * drift) * c - x * turned) / n,
            (ahead * c4 - alpha * c - (x + m) * a) / n,
            ((x - m) * b - alpha * c) / n,
            2.0 * (drift * b - alpha * first).real / n,
            (straight - 2.0 * x * rest - nu * c4 - 2.0 * (drift * a - alpha * first)) / n,
        )
        sums = tuple(map(add, sums, terms))
        c, c4, straight = -m * c / n, -4.0 * m * c4 / n, 0j
    first, turned, a, b, square, rest = sums
    return _real(first, turned, a - first, b - first.conjugate(), square, nu, rest)


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
