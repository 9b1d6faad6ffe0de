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

"""References for the moments of odometry's error: a matrix exponential, and noisy runs."""

from __future__ import annotations

import numpy as np

from diffdrive_jacobian.kinematics.se2 import integrate

DRIVES = {
    'straight': lambda duration: [((0.22, 0.0), duration)],
    'arc': lambda duration: [((0.22, 0.5), duration)],
    'in place': lambda duration: [((0.0, 1.0), duration)],
    'stop and go': lambda duration: (
        [
            *(((0.22, 0.3), duration / 12.0), ((0.0, 0.0), duration / 12.0)),
            ((0.22, -0.3), duration / 12.0),
        ]
        * 4
    ),
}
"""Twists and how long each is held, for a given duration of the drive (s)."""
REAL, COMPLEX = np.longdouble, np.clongdouble
I = COMPLEX(1j)  # noqa: E741
NAMES = ('one', 'U', 'U2', 's', 'W', 'm', 'm*', 'A', 'A*', 'B', 'B*', 'D', 'D*', 'N', 'Q', 'Q*')
"""1, E[u], E[u^2], E[delta^2], E[u delta] / i for u = exp(i delta). With the error eta of the position,
in the frame of the reported pose, E[eta], E[eta u], E[eta* u], E[eta delta], E[|eta|^2], E[eta^2]."""


def generator(v, omega, L, k):
    """The matrix F of the linear differential equation d moments / dt = F moments."""
    right, left = k * abs(v + omega * L / 2.0), k * abs(v - omega * L / 2.0)
    vv, vw, ww = REAL(right + left) / 4, REAL(right - left) / (2 * L), REAL(right + left) / (L * L)
    v, omega = REAL(v), REAL(omega)
    F = np.zeros((len(NAMES), len(NAMES)), dtype=COMPLEX)

    def add(row, column, value):
        F[NAMES.index(row), NAMES.index(column)] += value

    add('U', 'U', -ww / 2)
    add('U2', 'U2', -2 * ww)
    add('s', 'one', ww)
    add('W', 'W', -ww / 2)
    add('W', 'U', ww)
    for star, i in (('', I), ('*', -I)):
        drift = v + i * vw / 2
        add('m' + star, 'm' + star, -i * omega)
        add('m' + star, 'U', drift)
        add('m' + star, 'one', -v)
        add('A' + star, 'A' + star, -i * omega - ww / 2)
        add('A' + star, 'U2', v + 3 * i * vw / 2)
        add('A' + star, 'U', -v)
        add('B' + star, 'B' + star, i * omega - ww / 2)
        add('B' + star, 'one', drift)
        add('B' + star, 'U', -v)
        add('D' + star, 'D' + star, -i * omega)
        add('D' + star, 'W', i * drift)
        add('D' + star, 'U', vw)
        add('N', 'B' + star, drift)
        add('N', 'm' + star, -v)
        add('Q' + star, 'Q' + star, -2 * i * omega)
        add('Q' + star, 'A' + star, 2 * drift)
        add('Q' + star, 'm' + star, -2 * v)
        add('Q' + star, 'U2', vv)
    add('N', 'one', vv)
    return F


def exponential(X):
    """The exponential of a matrix in extended precision, by scaling and squaring."""
    squarings = max(0, int(np.ceil(np.log2(max(1e-30, float(np.abs(X).sum(axis=1).max())) * 4.0))))
    X = X / REAL(2) ** squarings
    total = term = np.eye(len(X), dtype=COMPLEX)
    for n in range(1, 30):
        term = term @ X / REAL(n)
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


def reference(moments, theta, twist, duration, L, k):
    """The moments after an arc, in the order of `Moments`."""
    xx, xy, xt, yy, yt, tt, x, y, xc, xs, yc, ys = (REAL(entry) for entry in moments)
    turn = np.exp(-I * REAL(theta))
    eta = (x + I * y) * turn
    a = ((xc - ys) + I * (xs + yc)) * turn + eta
    b = ((xc + ys) + I * (xs - yc)) * np.conj(turn) + np.conj(eta)
    d, q = (xt + I * yt) * turn, (xx - yy + 2 * I * xy) * turn * turn
    u = np.exp(-tt / 2)
    start = {'one': 1, 'U': u, 'U2': u**4, 's': tt, 'W': tt * u, 'N': xx + yy}
    start |= {'m': eta, 'A': a, 'B': b, 'D': d, 'Q': q}
    start |= {name + '*': np.conj(start[name]) for name in 'mABDQ'}
    vector = np.array([start[name] for name in NAMES], dtype=COMPLEX)
    vector = exponential(generator(*twist, L, k) * REAL(duration)) @ vector
    end = dict(zip(NAMES, vector, strict=True))
    turn = np.exp(I * (REAL(theta) + REAL(twist[1]) * REAL(duration)))
    eta, d, q, n = end['m'] * turn, end['D'] * turn, end['Q'] * turn * turn, end['N'].real
    a, b = (end['A'] - end['m']) * turn, (end['B'] - end['m*']) * np.conj(turn)
    return np.array(
        [
            *((n + q.real) / 2, q.imag / 2, d.real, (n - q.real) / 2, d.imag, end['s'].real),
            *(eta.real, eta.imag, (a + b).real / 2, (a + b).imag / 2),
            *((a - b).imag / 2, (b - a).real / 2),
        ],
        dtype=np.float64,
    )


def reported_path(drive, L, k, start=(0.0, 0.0, 0.0)):
    """The reported poses in small pieces, shape (n, 3), and the noise between them, shape (n - 1, 3)."""
    poses, noise = [np.array(start)], []
    for (v, omega), duration in drive:
        pieces = max(20, int(abs(omega) * duration / 0.2) + 1)
        dt = duration / pieces
        right, left = (k * abs(v + sign * omega * L / 2.0) * dt for sign in (1.0, -1.0))
        for _ in range(pieces):
            poses.append(integrate(poses[-1], (v, omega), dt))
            noise.append([(right + left) / 4.0, (right - left) / (2.0 * L), (right + left) / L**2])
    return np.array(poses), np.array(noise)


def noisy_runs(rng, drive, covariance, count, L, k, step=0.2):
    """Drive with noisy wheels. Returns the errors about the reported pose, shape (count, 3).

    Each wheel's travel has an independent Gaussian error of variance k times its distance in every step,
    and the body moves along the arc of both travels. The heading is unwrapped.
    """
    values, vectors = np.linalg.eigh(covariance)
    x, y, theta = vectors * np.sqrt(np.maximum(values, 0.0)) @ rng.normal(size=(3, count))
    true_x, true_y, true_theta = 0.0, 0.0, 0.0
    for (v, omega), duration in drive:
        steps = max(1, round(duration / step))
        dt = duration / steps
        right, left = (v + omega * L / 2.0) * dt, (v - omega * L / 2.0) * dt
        for _ in range(steps):
            if not right == left == 0.0:
                noise = np.sqrt(k * np.abs([[right], [left]])) * rng.normal(size=(2, count))
                way, turn = (
                    right / 2 + left / 2 + noise.sum(0) / 2,
                    (right - left + noise[0] - noise[1]) / L,
                )
                chord, heading = way * np.sinc(turn / 2.0 / np.pi), theta + turn / 2.0
                x, y, theta = x + chord * np.cos(heading), y + chord * np.sin(heading), theta + turn
            chord, heading = v * dt * np.sinc(omega * dt / 2.0 / np.pi), true_theta + omega * dt / 2.0
            true_x, true_y = true_x + chord * np.cos(heading), true_y + chord * np.sin(heading)
            true_theta += omega * dt
    return np.stack([x - true_x, y - true_y, theta - true_theta], axis=-1)
