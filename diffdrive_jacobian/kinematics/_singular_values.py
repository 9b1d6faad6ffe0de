"""Functions of the singular values of a Jacobian: damped inverses and null-space projectors.

With `J = sum_i s_i u_i v_i^T`, damping lambda and the width `e = FILTER lambda`:

    gain      g(s) = s / (s^2 + lambda^2)    of the damped inverse    sum_i g(s_i) v_i u_i^T
    removal   f(s) = min(s / e, 1)           of the projector         I - sum_i f(s_i) v_i v_i^T

Without damping `g(s) = 1 / s` and `f(s) = 1`, except for singular values that count as zero: there both
are 0. Arrays are checked by the callers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

CUTOFF = 1e-15
"""Without damping, singular values below `CUTOFF max(m, n)` times the largest one count as zero."""
FILTER = 0.1
"""Width of the projector's filter, relative to the damping."""
_TINY = float(np.finfo(np.float64).tiny)

Array = NDArray[np.float64]


def gains_and_removals(values: Array, damping: Array, least: Array) -> tuple[Array, Array]:
    """Compute g and f of singular values, shape (..., k), with damping, shape (..., 1).

    Args:
        values: Singular values, shape (..., k).
        damping: lambda, shape (..., 1).
        least: Without damping, values up to this count as zero, shape (..., 1).
    """
    damped = damping > 0.0
    kept = values > np.where(damped, _TINY, least)
    safe = np.where(kept, values, 1.0)
    with np.errstate(over='ignore', under='ignore', divide='ignore', invalid='ignore'):
        gains = np.where(kept, 1.0 / (safe + damping * (damping / safe)), 0.0)
        # Divided one after the other: the product may be too small for a number.
        filtered = np.fmin(values / damping / FILTER, 1.0)
    return gains, np.where(damped, filtered, kept)


def negligible(values: Array, shape: tuple[int, ...]) -> Array:
    """Return up to which singular value they count as zero without damping, shape (..., 1)."""
    least: Array = np.maximum(CUTOFF * max(shape[-2:]) * values[..., :1], _TINY)
    return least


def inverse_and_projector(J: Array, damping: Array, least: Array | None = None) -> tuple[Array, Array]:
    """Compute the damped inverse, shape (..., n, m), and the projector, shape (..., n, n).

    Args:
        J: Jacobians, shape (..., m, n).
        damping: lambda, shape (...).
        least: Without damping, singular values up to this count as zero, shape (...); None: `CUTOFF`.
    """
    left, values, right = np.linalg.svd(J, full_matrices=False)
    zero = negligible(values, J.shape) if least is None else np.maximum(least, _TINY)[..., np.newaxis]
    gains, removals = gains_and_removals(values, damping[..., np.newaxis], zero)
    columns = np.swapaxes(right, -1, -2)
    inverse = columns * gains[..., np.newaxis, :] @ np.swapaxes(left, -1, -2)
    projector = np.eye(J.shape[-1]) - columns * removals[..., np.newaxis, :] @ right
    return inverse, projector


def joint_velocities(J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None = None) -> Array:
    """Compute `sum_i g(s_i) v_i u_i^T x_dot`, and with q_dot_0 its projection added.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        damping: lambda, shape (...).
        q_dot_0: Secondary joint velocities, shape (..., n), or None.

    Returns:
        Joint velocities, shape (..., n); infinite where a number cannot represent them.
    """
    method = _two_rows if J.shape[-2] == 2 else _by_svd
    with np.errstate(all='ignore'):
        q_dot, exact = method(J, x_dot, damping, q_dot_0)
        if exact.all():
            return q_dot
        batch = q_dot.shape[:-1]
        redo = ~np.broadcast_to(exact, batch)

        def selected(value: Array, axes: int) -> Array:
            return np.broadcast_to(value, (*batch, *value.shape[value.ndim - axes :]))[redo]

        secondary = None if q_dot_0 is None else selected(q_dot_0, 1)
        q_dot[redo] = _scaled(selected(J, 2), selected(x_dot, 1), selected(damping, 0), secondary)
    return q_dot


def manipulability(J: Array) -> Array:
    """Compute the product of the singular values of Jacobians with m <= n, shape (...)."""
    with np.errstate(over='ignore', under='ignore', invalid='ignore'):
        if J.shape[-2] != 2:
            return np.asarray(np.linalg.svd(J, compute_uv=False).prod(axis=-1))
        w = _minors(J)
        squares = np.einsum('...ij,...ij->...', J, J)
        extreme = ~((squares > 1e-60) & (squares < 1e60))
        if extreme.any():
            exponents = _exponent(J[extreme], 2)
            w[extreme] = np.ldexp(
                _minors(np.ldexp(J[extreme], -exponents[:, np.newaxis, np.newaxis])), 2 * exponents
            )
    return w


def _minors(J: Array) -> Array:
    """Compute the manipulability of two rows: the root of the sum of all squared minors (Cauchy and
    Binet), which loses no digits.
    """
    squares: Any = np.zeros(J.shape[:-2])
    for i in range(J.shape[-1]):
        for j in range(i):
            minor = J[..., 0, i] * J[..., 1, j] - J[..., 0, j] * J[..., 1, i]
            squares = squares + minor * minor
    return np.array(np.sqrt(squares))


def _exponent(values: Array, axes: int) -> NDArray[np.int32]:
    """Return the binary exponent of the largest entry along the last axes."""
    largest = np.abs(values).max(axis=tuple(range(-axes, 0)))
    return np.asarray(np.frexp(largest)[1], dtype=np.int32)


def _scaled(J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None) -> Array:
    """Compute joint velocities, shape (k, n), by way of entries near 1: nothing overflows on the way."""
    units, speeds = _exponent(J, 2)[:, np.newaxis], _exponent(x_dot, 1)[:, np.newaxis]
    J, damping = np.ldexp(J, -units[..., np.newaxis]), np.ldexp(damping, -units[:, 0])
    # What has no inverse that is a number counts as zero, in the units of J.
    tiny = np.ldexp(np.full(units.shape, _TINY), -units)
    task, _ = _by_svd(J, np.ldexp(x_dot, -speeds), damping, None, tiny)
    q_dot: Array = np.ldexp(task, speeds - units)
    if q_dot_0 is not None:
        own = _exponent(q_dot_0, 1)[:, np.newaxis]
        free, _ = _by_svd(J, np.zeros_like(x_dot), damping, np.ldexp(q_dot_0, -own), tiny)
        q_dot = q_dot + np.ldexp(free, own)
    return q_dot


def _by_svd(
    J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None, tiny: Array | float = _TINY
) -> tuple[Array, NDArray[np.bool_]]:
    """Compute joint velocities, and where neither overflow nor underflow can have spoilt them."""
    left, values, right = np.linalg.svd(J, full_matrices=False)
    along = (x_dot[..., np.newaxis, :] @ left)[..., 0, :]
    least = np.maximum(negligible(values, J.shape), tiny)
    gains, removals = gains_and_removals(values, damping[..., np.newaxis], least)
    weights = gains * along
    if q_dot_0 is not None:
        weights = weights - removals * (right @ q_dot_0[..., np.newaxis])[..., 0]
    q_dot: Array = (weights[..., np.newaxis, :] @ right)[..., 0, :]
    if q_dot_0 is not None:
        q_dot = q_dot + q_dot_0
    largest = values[..., 0]
    return q_dot, (largest > 1e-30) & (largest < 1e30) & np.isfinite(q_dot).all(axis=-1)


def _two_rows(
    J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None
) -> tuple[Array, NDArray[np.bool_]]:
    """Compute the same for two rows, in closed form: a rotation in the plane of the task makes the rows
    orthogonal (one-sided Jacobi), then they are `s_i v_i^T`. Many times as fast as LAPACK on batches.
    """
    # Column by column, for loops over the short last axis take longer.
    columns: list[tuple[Any, Any]] = [(J[..., 0, k], J[..., 1, k]) for k in range(J.shape[-1])]
    one, other = x_dot[..., 0], x_dot[..., 1]
    for _ in range(2):  # The second rotation removes the rounding of the first near a singularity.
        first, second, both = _products(columns)
        angle = 0.5 * np.arctan2(2.0 * both, first - second)
        c, s = np.cos(angle), np.sin(angle)
        one, other = c * one + s * other, c * other - s * one
        columns = [(c * a + s * b, c * b - s * a) for a, b in columns]
    first, second, _ = _products(columns)
    squares = np.stack([first, second], axis=-1)
    values = np.sqrt(squares)
    gains, removals = gains_and_removals(values, damping[..., np.newaxis], negligible(values, J.shape))
    nonzero = np.where(squares > 0.0, squares, 1.0)
    gains = gains / np.sqrt(nonzero)
    one, other = gains[..., 0] * one, gains[..., 1] * other
    if q_dot_0 is not None:
        removals = removals / nonzero
        secondary = [q_dot_0[..., k] for k in range(J.shape[-1])]
        one = one - removals[..., 0] * sum(a * q for (a, _), q in zip(columns, secondary, strict=True))
        other = other - removals[..., 1] * sum(
            b * q for (_, b), q in zip(columns, secondary, strict=True)
        )
    q_dot = np.stack([one * a + other * b for a, b in columns], axis=-1)
    if q_dot_0 is not None:
        q_dot = q_dot + q_dot_0
    exact = (first > 1e-60) & (first < 1e60) & np.isfinite(q_dot).all(axis=-1)
    small = second < 1e-200
    if small.any():  # Its square may have underflowed although that of the first has not.
        exact = exact & ~(small & np.any([b != 0.0 for _, b in columns], axis=0))
    return q_dot, exact


def _products(columns: Sequence[tuple[Any, Any]]) -> tuple[Any, Any, Any]:
    """Return the squares of two rows, and their product."""
    return (
        sum(a * a for a, _ in columns),
        sum(b * b for _, b in columns),
        sum(a * b for a, b in columns),
    )
