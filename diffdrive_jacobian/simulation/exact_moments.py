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

"""Exact moments of the error of odometry about the reported pose, under the model of `odometry_noise`.

State: let delta be the error of the heading, unwrapped, and e the error of the position in the world
frame, both relative to the reported pose. `Moments` has their second moments, and the moments with
`C = cos(delta) - 1` and `S = sin(delta)` from which later second moments follow.

`NoiseMoments` are what one arc of the duration t adds: psi to the heading and gamma to the position, in
the frame of the reported pose. Notation: `x = i omega t`, `m = ww t / 2`, `alpha = v t`, `nu = vv t`,
`beta = vw t`, `h = exp(i psi)`, with the entries vv, vw, ww of W. They are a power series in time, and
longer arcs are halved. For the arcs between two messages the first terms are written out.

Source: doc/moments.md, "Odometry covariance".
"""

from __future__ import annotations

import math
from math import cos, exp, expm1, isfinite, sin
from operator import add
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.numerics.checks import not_negative, number, numbers, positive
from diffdrive_jacobian.simulation.odometry_noise import covariance_of_pose, spectral_densities

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
    m of at most `SHORT_TURN` and `SHORT_NOISE`. They are `central`, in the frame of the chord, turned by
    `turn / 2` from that of the reported pose at the start, where there are half as many as in others.
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
    """Return the mean, and the other moments about the mean, in the order of `NoiseMoments`."""
    x, y, xx, xy, yy, xt, yt, xc, xs, yc, ys = noise
    loss = math.expm1(-m)
    return x, y, xx - x * x, xy - x * y, yy - y * y, xt, yt, xc - x * loss, xs, yc - y * loss, ys


def series(alpha: float, turn: float, nu: float, beta: float, m: float) -> NoiseMoments:
    """Compute the moments by their power series in time, for an arc up to `RADIUS`."""
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
    # Half the sum and half the difference of E[gamma (h - 1)] and E[gamma* (h - 1)].
    a, b = a - first, b - first.conjugate()
    even, odd = 0.5 * (a + b), 0.5 * (a - b)
    xx, xy, yy = nu + 0.5 * (square - rest.real), -0.5 * rest.imag, 0.5 * (square + rest.real)
    return NoiseMoments(
        *(first.real, first.imag, xx, xy, yy, turned.real, turned.imag),
        *(even.real, even.imag, odd.imag, -odd.real),
    )


class Moments(NamedTuple):
    """Expectations of the error relative to the reported pose, in the world frame."""

    xx: float
    """E[e_x^2] (m^2)."""
    xy: float
    xt: float
    """E[e_x delta] (m rad)."""
    yy: float
    yt: float
    tt: float
    """E[delta^2] (rad^2). The error of the heading is Gaussian with mean zero."""
    x: float = 0.0
    """E[e_x], the mean error (m)."""
    y: float = 0.0
    xc: float = 0.0
    """E[e_x C] (m)."""
    xs: float = 0.0
    """E[e_x S] (m)."""
    yc: float = 0.0
    ys: float = 0.0

    @property
    def second_moment(self) -> NDArray[np.float64]:
        """Second moment of `[e_x, e_y, delta]`, shape (3, 3): the covariance that is published."""
        xx, xy, xt, yy, yt, tt = self[:6]
        return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])

    @property
    def mean(self) -> NDArray[np.float64]:
        """Mean of `[e_x, e_y, delta]`, shape (3,)."""
        return np.array([self.x, self.y, 0.0])


SURE = Moments(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The moments of no error."""


Entries: TypeAlias = tuple[float, ...]
"""The entries of `Moments` as a plain tuple, which is created in a fifth of the time."""


def gaussian(covariance: ArrayLike) -> Moments:
    """Return the moments of a Gaussian error about the reported pose.

    Args:
        covariance: Covariance of `[x, y, theta]`, shape (3, 3).

    Raises:
        ValueError: It has another shape, is not finite, or is not symmetric and positive semidefinite.
    """
    P = covariance_of_pose('covariance', covariance)
    xx, xy, xt, yy, yt, tt = P[np.triu_indices(3)].tolist()
    # Stein's lemma: E[e f(delta)] = E[e delta] E[f'(delta)].
    decay = exp(-tt / 2.0)
    return Moments(xx, xy, xt, yy, yt, tt, 0.0, 0.0, 0.0, xt * decay, 0.0, yt * decay)


def propagate_moments(
    moments: Moments,
    pose: ArrayLike,
    twist: ArrayLike,
    dt: float,
    L: float,
    wheel_travel_variance: float,
) -> Moments:
    """Propagate the moments of the error along an arc, exactly.

    Args:
        moments: Moments at the start.
        pose: Reported pose at the start, shape (3,) (m, m, rad).
        twist: The constant twist as reported, `[v, omega]`, shape (2,) (m/s, rad/s).
        dt: Duration, zero or positive (s).
        L: Wheel separation, positive (m).
        wheel_travel_variance: k, variance per distance travelled of each wheel, zero or positive (m).

    Returns:
        Moments of the error relative to the reported pose at the end. They do not depend on the number
        of pieces in which the arc is propagated.

    Raises:
        ValueError: An argument has a wrong shape or sign, is not finite, or the result overflows.
    """
    _, _, theta = numbers('pose', pose, 3)
    v, omega = numbers('twist', twist, 2)
    dt, L = number('dt', dt, not_negative), number('L', L, positive)
    k = number('wheel_travel_variance', wheel_travel_variance, not_negative)
    entries = tuple(numbers('moments', moments, 12))
    densities = spectral_densities(v, omega, L, k)
    propagated = propagated_moments(entries, theta, (v, omega), densities, dt)
    if propagated is None:
        raise ValueError(
            'moments, pose, twist, dt, L and wheel_travel_variance must give a finite result, '
            'but it overflows'
        )
    return Moments(*propagated)


def propagated_moments(
    moments: Entries,
    theta: float,
    twist: tuple[float, float],
    densities: tuple[float, float, float],
    dt: float,
) -> Entries | None:
    """Return `propagate_moments` of values that were checked; None: they overflow.

    `densities` are the `spectral_densities` of the twist.
    """
    (v, omega), (vv, vw, ww) = twist, densities
    try:
        alpha, turn, nu, beta, m = v * dt, omega * dt, vv * dt, vw * dt, ww * dt / 2.0
        if m <= SHORT_NOISE and -SHORT_TURN <= turn <= SHORT_TURN:
            # Nearly every arc of a robot: all in the frame of the chord.
            half = turn / 2.0
            chord = alpha * (sin(half) / half if half else 1.0)
            cosine, sine = cos(theta + half), sin(theta + half)
            noise = short_arc(alpha, turn, nu, beta, m) if m else None
            end = composed(moments, cosine, sine, chord * cosine, chord * sine, m, noise)
        else:
            end = _extended(moments, theta, alpha, turn, m, _noise(alpha, turn, nu, beta, m))
    except (OverflowError, ValueError, ZeroDivisionError):
        return None
    # A finite sum has finite terms.
    return end if isfinite(sum(end)) or all(map(isfinite, end)) else None


def _noise(alpha: float, turn: float, nu: float, beta: float, m: float) -> NoiseMoments | None:
    """Compute the moments of the noise of one arc; None: there is no noise."""
    if not m:
        return None
    size = 2.0 * abs(turn) + 4.0 * m
    if not isfinite(size):
        # The series would have no end.
        raise OverflowError(f'the arc must be finite, got {size}')
    halvings = max(0, math.frexp(size / RADIUS)[1])
    alpha, turn, nu, beta, m = (part * 2.0**-halvings for part in (alpha, turn, nu, beta, m))
    noise = series(alpha, turn, nu, beta, m)
    for _ in range(halvings):
        first = _extended(tuple(SURE), -2.0 * turn, alpha, turn, m, noise)
        xx, xy, xt, yy, yt, _, *others = _extended(first, -turn, alpha, turn, m, noise)
        x, y, *trigonometric = others
        noise = NoiseMoments(x, y, xx, xy, yy, xt, yt, *trigonometric)
        alpha, turn, m = 2.0 * alpha, 2.0 * turn, 2.0 * m
    return noise


def _extended(
    moments: Entries, theta: float, alpha: float, turn: float, m: float, noise: NoiseMoments | None
) -> Entries:
    """Compute the moments after an arc whose noise is given in the frame of the pose at its end."""
    cosine, sine = cos(theta + turn), sin(theta + turn)
    half = turn / 2.0
    sinc = sin(half) / half if half else 1.0
    along, across = alpha * (sin(turn) / turn if turn else 1.0), -alpha * sinc * sin(half)
    gx, gy = cosine * along - sine * across, sine * along + cosine * across
    return composed(moments, cosine, sine, gx, gy, m, None if noise is None else central(noise, m))


def composed(
    moments: Entries,
    cosine: float,
    sine: float,
    gx: float,
    gy: float,
    m: float,
    noise: tuple[float, ...] | None,
) -> Entries:
    """Compute the moments after an arc that starts with an error and adds its noise.

    With the reported displacement g and the noise gamma, both in the world, and `u = exp(i delta)`,
    the error becomes `e + (u - 1) g + u gamma`. The noise is independent of e and delta. Its mean p
    lengthens the displacement: with `h = g + p` the error is `e + p + (u - 1) h + u (gamma - p)`.

    `cosine` and `sine` are the direction in the world of the x axis of the frame of the noise, of which
    there are `central` moments, or None.
    """
    xx, xy, xt, yy, yt, tt, x, y, xc, xs, yc, ys = moments
    # E[C], E[cos delta], E[C^2], E[S^2], E[cos delta C]; E[S], E[C S] are zero.
    c = expm1(-tt / 2.0)
    u = 1.0 + c
    cc = c * c * (u * (u + 2.0) + 3.0) / 2.0
    ss = -c * (1.0 + u) * (1.0 + u * u) / 2.0
    loss = expm1(-m)
    decay = 1.0 + loss
    px = py = 0.0
    if noise is not None:
        nx, ny, nxx, nxy, nyy, nxt, nyt, nxc, nxs, nyc, nys = noise
        px, py = cosine * nx - sine * ny, sine * nx + cosine * ny
    hx, hy = gx + px, gy + py
    # Of e + p + (u - 1) h.
    shifted_x, shifted_y = x + c * hx, y + c * hy
    end_x, end_y = shifted_x + px, shifted_y + py
    hxx, hyy, tu = hx * hx, hy * hy, tt * u
    end_xx = xx + 2.0 * (xc * hx - xs * hy) + cc * hxx + ss * hyy + px * (shifted_x + end_x)
    end_xy = xy + (xc - ys) * hy + (xs + yc) * hx + (cc - ss) * hx * hy + px * shifted_y + py * end_x
    end_yy = yy + 2.0 * (yc * hy + ys * hx) + cc * hyy + ss * hxx + py * (shifted_y + end_y)
    end_xt, end_yt = xt - tu * hy, yt + tu * hx
    end_xc, end_xs = (xc + c * px + cc * hx) * decay + end_x * loss, (xs - ss * hy) * decay
    end_yc, end_ys = (yc + c * py + cc * hy) * decay + end_y * loss, (ys + ss * hx) * decay
    if noise is None:
        position = end_x, end_y, end_xc, end_xs, end_yc, end_ys
        return end_xx, end_xy, end_xt, end_yy, end_yt, tt, *position
    # Of u (gamma - p): E[cos^2 delta] = 1 - ss.
    ux, product = 1.0 - ss, cosine * sine
    square_c, square_s, cross = cosine * cosine, sine * sine, 2.0 * product * nxy
    pxx = square_c * nxx - cross + square_s * nyy
    pyy = square_s * nxx + cross + square_c * nyy
    pxy = product * (nxx - nyy) + (square_c - square_s) * nxy
    pxc, pyc = cosine * nxc - sine * nyc, sine * nxc + cosine * nyc
    pxs, pys = cosine * nxs - sine * nys, sine * nxs + cosine * nys
    spread = ss * (pxx - pyy)
    return (
        end_xx + pxx - spread,
        end_xy + (ux - ss) * pxy,
        end_xt + u * (cosine * nxt - sine * nyt),
        end_yy + pyy + spread,
        end_yt + u * (sine * nxt + cosine * nyt),
        tt + 2.0 * m,
        end_x,
        end_y,
        end_xc + ux * pxc + ss * pys,
        end_xs + ux * pxs - ss * pyc,
        end_yc + ux * pyc - ss * pxs,
        end_ys + ux * pys + ss * pxc,
    )
