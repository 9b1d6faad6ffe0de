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

"""The model of the calibration, linearized about an estimate, and its most likely unknowns.

The unknowns are a small twist x_i of each pose of the body, in its own frame, and changes y of the
parameters. The residuals

    e_i + x_(i+1) - A_i x_i - D_i y   of the motion between two poses, with the covariance k Q_i
    z_i - J x_i - M y                 of a pose that the reference observes, with the covariance R_i

are Gaussian and independent. Source: doc/moments.md, "Calibration".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.block_tridiagonal import solve_block_tridiagonal
from diffdrive_jacobian.calibration.model import (
    LEVER_ARM,
    MULTIPLIERS,
    YAW_OFFSET,
    Array,
    CalibrationError,
    Estimate,
    Segment,
    prior_information,
)
from diffdrive_jacobian.calibration.motion import (
    Geometry,
    composed,
    increments,
    inverted,
    relative,
)
from diffdrive_jacobian.kinematics.se2 import adjoint
from diffdrive_jacobian.numerics.elementary import wrap


@dataclass(frozen=True, kw_only=True, slots=True)
class Reduced:
    """The normal equations of the free parameters alone, without their prior."""

    information: Array
    """Fisher information of the parameters: (C - G' H^-1 G), shape (p, p)."""
    gradient: Array
    """c - G' H^-1 h, shape (p,)."""
    by_parameters: Array
    """H^-1 G, shape (n, 3, p)."""
    by_residuals: Array
    """H^-1 h, shape (n, 3)."""
    log_det: float
    """log det H."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Solution:
    """The most likely unknowns."""

    x: Array
    """Twists of the poses, shape (n, 3)."""
    y: Array
    """Changes of the free parameters, shape (p,)."""
    covariance: Array
    """Of the free parameters, with their prior, shape (p, p)."""
    log_det: float
    """Logarithm of the determinant of the normal matrix."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearModel:
    """The residuals of n poses and their derivatives, as in the equations above.

    All motions follow each other. Between the last pose of one and the first of the next the inverse of
    Q is 0. The columns of D and M are those of all parameters, whether free or not.
    """

    e: Array
    """Motion of the estimated poses, seen from that of the wheels, shape (n - 1, 3)."""
    A: Array
    """Adjoints of SE(2): a twist of pose i, in the frame of pose i + 1, shape (n - 1, 3, 3)."""
    D: Array
    """Twist of the end of a step for each parameter, shape (n - 1, 3, parameters)."""
    Q_inverse: Array
    """Inverse covariances of the motion for the wheel travel variance k = 1 m, shape (n - 1, 3, 3)."""
    z: Array
    """Observed minus expected pose of the sensor, along the axes of the body, shape (n, 3)."""
    J: Array
    """Its derivative by the twist of the body, shape (3, 3)."""
    M: Array
    """Its derivative by each parameter, shape (3, parameters)."""
    samples: Array
    """Number of samples for which an observed pose counts, shape (n,)."""
    reading: Array
    """What the reading errors of the wheels add to R, shape (n, 3, 3)."""
    free: NDArray[np.bool_]
    """Which of the parameters are estimated, shape (parameters,)."""
    to_prior: Array
    """The prior minus the parameters, shape (parameters,)."""

    def reduced(self, variances: Array) -> Reduced:
        """Return the equations of the parameters for the variances of `Noise.variances`.

        The normal equations have the blocks H (of the poses, block-tridiagonal), G (of poses and
        parameters) and C (of the parameters), and the gradients h and c:

            [H  G] [x]     [h]
            [G' C] [y] = - [c]
        """
        D, M = self.D[:, :, self.free], self.M[:, self.free]
        P, W = self.Q_inverse / variances[0], np.linalg.inv(self.R(variances))
        PD, AP, JW = P @ D, np.swapaxes(self.A, 1, 2) @ P, self.J.T @ W
        H = JW @ self.J
        H[1:] += P
        H[:-1] += AP @ self.A
        G = JW @ M
        G[1:] -= PD
        G[:-1] += AP @ D
        h = -_times(JW, self.z)
        h[1:] += _times(P, self.e)
        h[:-1] -= _times(AP, self.e)
        C = np.tensordot(D, PD, ((0, 1), (0, 1))) + M.T @ W.sum(axis=0) @ M
        c = -np.tensordot(PD, self.e, ((0, 1), (0, 1))) - M.T @ _times(W, self.z).sum(axis=0)
        solved, log_det = solve_block_tridiagonal(H, -AP, np.concatenate([G, h[:, :, None]], axis=2))
        eliminated = np.tensordot(G, solved, ((0, 1), (0, 1)))
        information = C - eliminated[:, :-1]
        return Reduced(
            information=(information + information.T) / 2.0,
            gradient=c - eliminated[:, -1],
            by_parameters=solved[:, :, :-1],
            by_residuals=solved[:, :, -1],
            log_det=log_det,
        )

    def solved(self, variances: Array) -> Solution:
        """Return the most likely unknowns for the variances of `Noise.variances`, given the prior.

        Raises:
            CalibrationError: They are not finite.
        """
        reduced = self.reduced(variances)
        prior = prior_information(self.free)
        posterior = reduced.information + prior
        y = np.asarray(np.linalg.solve(posterior, prior @ self.to_prior[self.free] - reduced.gradient))
        x = -reduced.by_residuals - reduced.by_parameters @ y
        if not (np.isfinite(y).all() and np.isfinite(x).all()):
            raise CalibrationError(
                'the estimate diverges: the poses do not fit the motion of the wheels'
            )
        log_det = reduced.log_det + float(np.linalg.slogdet(posterior)[1])
        inverse = np.linalg.inv(posterior)
        return Solution(x=x, y=y, covariance=(inverse + inverse.T) / 2.0, log_det=log_det)

    def R(self, variances: Array) -> Array:
        """Return the covariances of the observed poses, shape (n, 3, 3)."""
        white = np.diag(variances[[1, 1, 2]])
        return np.asarray(white / self.samples[:, None, None] + self.reading)

    def squares_and_freedom(self, variances: Array, solution: Solution) -> tuple[Array, Array]:
        """Return the weighted squares and the degrees of freedom of each noise, shapes (3,).

        The noise is that of the motion, the positions and the headings. Both are equal where its
        variance is most likely: they are the terms of the derivative of the restricted likelihood. Where
        reading errors add to R, only the part of the noise in a residual counts.
        """
        y = np.zeros(len(self.free))
        y[self.free] = solution.y
        motion = self.e + solution.x[1:] - _times(self.A, solution.x[:-1]) - self.D @ y
        observed = self.z - solution.x @ self.J.T - self.M @ y
        W = np.linalg.inv(self.R(variances))
        white = variances[[1, 1, 2]] / self.samples[:, None]
        squares = white * _times(W, observed) ** 2
        counts = white * np.einsum('nii->ni', W)
        steps = 3.0 * np.count_nonzero(self.Q_inverse[:, 0, 0])
        of_motion = np.sum(motion * _times(self.Q_inverse, motion)) / variances[0]
        # The unknowns take from each what log det of the normal matrix changes with its weight.
        change = 1e-3
        heavier = variances * np.exp(-change * np.eye(3))
        taken = [(self.solved(one).log_det - solution.log_det) / change for one in heavier]
        total = np.array([steps, counts[:, :2].sum(), counts[:, 2].sum()])
        return (
            np.array([of_motion, squares[:, :2].sum(), squares[:, 2].sum()]),
            np.maximum(total - taken, 1e-3 * total),
        )


def _times(matrices: NDArray[np.floating], vectors: Array) -> Array:
    """Return the product of each matrix and its vector, shapes (n, 3, 3) and (n, 3)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def linearized(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
) -> LinearModel:
    """Return the model at an estimate."""
    sensor, count = estimate.sensor, len(estimate.parameters)
    poses = list(zip(segments, estimate.states, strict=True))
    c, s = np.cos(sensor[2]), np.sin(sensor[2])
    to_body = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    z = [relative(composed(states, sensor), one.poses) @ to_body.T for one, states in poses]
    J = np.array([[1.0, 0.0, -sensor[1]], [0.0, 1.0, sensor[0]], [0.0, 0.0, 1.0]])
    M = np.zeros((3, count))
    M[:2, LEVER_ARM], M[2, YAW_OFFSET] = np.eye(2), 1.0
    steps = [_motion(one, states, nominal, estimate) for one, states in poses]
    e, A, D, Q_inverse = (np.concatenate(parts)[:-1] for parts in zip(*steps, strict=True))
    geometry = estimate.geometry(nominal)
    errors = [
        [np.interp(one.at(estimate.parameters), one.wheel_time, side) for side in one.wheel_errors.T]
        for one in segments
    ]
    # Of both wheels on the rims, and the twists by which the body seems to move with them.
    rims = np.concatenate(errors, axis=1).T * geometry.radii
    L = geometry.separation
    seen = (J @ np.array([[0.5, 0.5], [0.0, 0.0], [1.0 / L, -1.0 / L]])) * rims[:, None, :]
    residual = np.concatenate(z)
    residual[:, 2] = wrap(residual[:, 2])
    return LinearModel(
        e=e,
        A=A,
        D=D,
        Q_inverse=Q_inverse,
        z=residual,
        J=J,
        M=M,
        samples=np.concatenate([one.samples for one in segments]),
        reading=seen @ np.swapaxes(seen, 1, 2),
        free=estimate.free,
        to_prior=estimate.prior - estimate.parameters,
    )


def _motion(
    segment: Segment, states: Array, nominal: Geometry, estimate: Estimate
) -> tuple[Array, Array, Array, Array]:
    """Return e, A, D and the inverse of Q of a motion, and zeros for the step to the next one."""
    at, geometry = segment.at(estimate.parameters), estimate.geometry(nominal)
    moved = increments(segment.wheel_time, segment.wheel_angles, at, geometry)
    between = relative(states[:-1], states[1:])
    e = relative(moved.steps, between)
    e[:, 2] = wrap(e[:, 2])
    A = adjoint(inverted(between))
    D = np.zeros((len(e), 3, len(estimate.parameters)))
    D[:, :, MULTIPLIERS] = moved.jacobian
    # The clock moves both ends of a step.
    first, last = moved.rates[:-1], moved.rates[1:]
    age = (segment.time - segment.epoch)[:, None]
    by_drift = age[1:] * last - _times(A, age[:-1] * first)
    D[:, :, segment.clock] = np.stack([last - _times(A, first), by_drift], axis=2)
    parts = e, A, D, np.linalg.inv(moved.covariance)
    e, A, D, Q_inverse = (np.concatenate([one, np.zeros((1, *one.shape[1:]))]) for one in parts)
    return e, A, D, Q_inverse
