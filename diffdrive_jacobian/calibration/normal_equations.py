"""Symmetric positive definite block-tridiagonal systems, solved by cyclic reduction.

Each level eliminates every other block, all of them at once as NumPy arrays, so that a chain of n blocks
takes log2(n) steps of Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.estimate import (
    LEVER_ARM,
    MULTIPLIERS,
    TIME_OFFSETS,
    YAW_OFFSET,
    Estimate,
)
from diffdrive_jacobian.calibration.measurements import Array, Segment
from diffdrive_jacobian.calibration.motion import (
    Geometry,
    Increments,
    composed,
    increments,
    inverted,
    relative,
)
from diffdrive_jacobian.kinematics.se2 import adjoint
from diffdrive_jacobian.numerics.elementary import wrap


def solve_block_tridiagonal(diagonal: Array, upper: Array, right: Array) -> tuple[Array, float]:
    """Solve `A x = b` and compute log det A.

    Args:
        diagonal: Blocks A[i, i], shape (n, 3, 3).
        upper: Blocks A[i, i + 1], shape (n - 1, 3, 3).
        right: b, shape (n, 3, m); m may be 0.

    Returns:
        x, shape (n, 3, m), and log det A. It is infinite or NaN where A is singular.

    Raises:
        numpy.linalg.LinAlgError: A block is exactly singular.
    """
    levels = []
    logarithm = 0.0
    while len(diagonal) > 1:
        count = len(diagonal)
        if count % 2 == 0:
            # An uncoupled block at the end, which is dropped below, gives each odd block two neighbours.
            diagonal = np.concatenate([diagonal, np.eye(3)[None]])
            upper = np.concatenate([upper, np.zeros((1, 3, 3))])
            right = np.concatenate([right, np.zeros((1, *right.shape[1:]))])
        before, after = np.swapaxes(upper[0::2], 1, 2), upper[1::2]
        odd = diagonal[1::2]
        logarithm += float(np.linalg.slogdet(odd)[1].sum())
        inverse = np.linalg.inv(odd)
        to_before, to_after = inverse @ before, inverse @ after
        value = inverse @ right[1::2]
        levels.append((count, to_before, to_after, value))
        next_diagonal, next_right = diagonal[0::2].copy(), right[0::2].copy()
        before_t, after_t = upper[0::2], np.swapaxes(after, 1, 2)
        next_diagonal[:-1] -= before_t @ to_before
        next_diagonal[1:] -= after_t @ to_after
        next_right[:-1] -= before_t @ value
        next_right[1:] -= after_t @ value
        kept = (count + 1) // 2
        upper = (-before_t @ to_after)[: kept - 1]
        diagonal, right = next_diagonal[:kept], next_right[:kept]
    logarithm += float(np.linalg.slogdet(diagonal[0])[1])
    solution = np.linalg.inv(diagonal) @ right
    for count, to_before, to_after, value in reversed(levels):
        whole = np.zeros((2 * len(value) + 1, *solution.shape[1:]))
        whole[0 : 2 * len(solution) : 2] = solution
        whole[1::2] = value - to_before @ whole[0:-1:2] - to_after @ whole[2::2]
        solution = whole[:count]
    return solution, logarithm


@dataclass(frozen=True, kw_only=True, slots=True)
class Group:
    """Residuals of one kind with their Jacobians, as normal equations for unit weight."""

    count: float
    diagonal: Array
    upper: Array
    border: Array
    """Blocks between the poses and the parameters, shape (n, 3, p)."""
    corner: Array
    gradient: Array
    """With respect to the poses, shape (n, 3)."""
    gradient_corner: Array
    cost: float

    def cost_after(self, step: Array, change: Array) -> float:
        """Return the sum of the squared residuals after a step, to second order."""
        linear = 2.0 * float(np.sum(self.gradient * step) + self.gradient_corner @ change)
        along = np.einsum('nij,nj->ni', self.diagonal, step) + 2.0 * np.einsum(
            'nip,p->ni', self.border, change
        )
        square = float(np.sum(step * along) + change @ self.corner @ change)
        square += 2.0 * float(np.einsum('ni,nij,nj->', step[:-1], self.upper, step[1:]))
        return max(0.0, self.cost + linear + square)


def linearized(
    segments: Sequence[Segment],
    nominal: Geometry,
    estimate: Estimate,
    window: float = np.inf,
    columns: Sequence[NDArray[np.int_]] | None = None,
    count: int | None = None,
) -> tuple[tuple[Group, Group, Group], Array]:
    """Return the normal equations of the motion, the positions and the headings.

    And how far the reading errors of both wheels, each of one standard deviation, seem to move the body
    at each pose: twists in its frame, shape (n, 3, 2).

    Args:
        segments: Continuous motions.
        nominal: Nominal dimensions.
        estimate: Parameters and poses at which they are linearized.
        window: As of `increments`.
        columns: Where, among all parameters, changes of the logarithms of the multipliers begin that are
            those of single steps, shape (n - 1, any) for each motion (default: there are none).
        count: Number of all parameters (default: those of the estimate).
    """
    count = count or len(estimate.parameters)
    if columns is None:
        columns = [np.empty((len(one.time) - 1, 0), dtype=int) for one in segments]
    geometry, sensor = estimate.geometry(nominal), estimate.sensor
    parts: tuple[list[Group], ...] = ([], [], [])
    readings = []
    right, left = geometry.radii
    L = geometry.separation
    by_reading = np.array([[right / 2.0, left / 2.0], [0.0, 0.0], [right / L, -left / L]])
    for segment, states, further in zip(segments, estimate.states, columns, strict=True):
        offset = TIME_OFFSETS + segment.recording
        at = segment.time + estimate.parameters[offset]
        moved = increments(segment.wheel_time, segment.wheel_angles, at, geometry, window)
        parts[0].append(_motion(moved, states, offset, count, further))
        for kind, part in enumerate(_observation(segment, states, sensor, count), 1):
            parts[kind].append(part)
        errors = [np.interp(at, segment.wheel_time, one) for one in segment.wheel_errors.T]
        readings.append(by_reading * np.column_stack(errors)[:, None])
    motion, position, heading = (_joined(part) for part in parts)
    return (motion, position, heading), np.concatenate(readings)


def _motion(
    moved: Increments, states: Array, offset: int, count: int, columns: NDArray[np.int_]
) -> Group:
    """Return the normal equations of the motion, for the wheel travel variance 1 m."""
    between = relative(states[:-1], states[1:])
    residual = relative(moved.steps, between)
    residual[:, 2] = wrap(residual[:, 2])
    weight = np.linalg.inv(moved.covariance)
    back = -adjoint(inverted(between))
    change = np.zeros((len(residual), 3, count))
    change[:, :, MULTIPLIERS] = -moved.jacobian
    for begins in columns.T:
        for which in range(3):
            change[np.arange(len(begins)), :, begins + which] = -moved.jacobian[:, :, which]
    # The time offset moves both ends of a step.
    change[:, :, offset] = -(moved.rates[1:] + np.einsum('nij,nj->ni', back, moved.rates[:-1]))
    n = len(states)
    diagonal, border, gradient = np.zeros((n, 3, 3)), np.zeros((n, 3, count)), np.zeros((n, 3))
    weighted_back = np.swapaxes(back, 1, 2) @ weight
    weighted_change, weighted = weight @ change, np.einsum('nij,nj->ni', weight, residual)
    diagonal[1:] += weight
    diagonal[:-1] += weighted_back @ back
    border[1:] += weighted_change
    border[:-1] += weighted_back @ change
    gradient[1:] += weighted
    gradient[:-1] += np.einsum('nij,nj->ni', weighted_back, residual)
    return Group(
        count=3.0 * (n - 1),
        diagonal=diagonal,
        upper=weighted_back,
        border=border,
        corner=np.asarray(np.tensordot(change, weighted_change, ((0, 1), (0, 1))), dtype=np.float64),
        gradient=gradient,
        gradient_corner=np.einsum('nip,ni->p', change, weighted),
        cost=float(np.sum(residual * weighted)),
    )


def _observation(segment: Segment, states: Array, sensor: Array, count: int) -> tuple[Group, Group]:
    """Return the normal equations of the positions and of the headings."""
    residual = relative(composed(states, sensor), segment.poses)
    # In the frame of the body, as the derivatives.
    c, s = np.cos(sensor[2]), np.sin(sensor[2])
    x, y = residual[:, 0].copy(), residual[:, 1].copy()
    residual[:, 0], residual[:, 1] = c * x - s * y, s * x + c * y
    residual[:, 2] = wrap(residual[:, 2])
    by_pose = -np.array([[1.0, 0.0, -sensor[1]], [0.0, 1.0, sensor[0]], [0.0, 0.0, 1.0]])
    by_parameters = np.zeros((3, count))
    by_parameters[:2, LEVER_ARM] = -np.eye(2)
    by_parameters[2, YAW_OFFSET] = -1.0
    groups = []
    for rows in (slice(0, 2), slice(2, 3)):
        J, M, e, w = by_pose[rows], by_parameters[rows], residual[:, rows], segment.weights
        groups.append(
            Group(
                count=float(e.size),
                diagonal=w[:, None, None] * (J.T @ J),
                upper=np.zeros((len(w) - 1, 3, 3)),
                border=w[:, None, None] * (J.T @ M),
                corner=w.sum() * (M.T @ M),
                gradient=w[:, None] * (e @ J),
                gradient_corner=(w @ e) @ M,
                cost=float(np.sum(w[:, None] * e**2)),
            )
        )
    return groups[0], groups[1]


def _joined(parts: Sequence[Group]) -> Group:
    """Return the equations of several segments, between which nothing is coupled."""
    uncoupled = np.zeros((1, 3, 3))
    uppers = [block for one in parts for block in (one.upper, uncoupled)][:-1]
    return Group(
        count=sum(one.count for one in parts),
        diagonal=np.concatenate([one.diagonal for one in parts]),
        upper=np.concatenate(uppers),
        border=np.concatenate([one.border for one in parts]),
        corner=np.sum([one.corner for one in parts], axis=0),
        gradient=np.concatenate([one.gradient for one in parts]),
        gradient_corner=np.sum([one.gradient_corner for one in parts], axis=0),
        cost=sum(one.cost for one in parts),
    )
