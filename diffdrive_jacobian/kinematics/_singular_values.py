"""Functions of the singular values of a Jacobian: damped inverses and null-space projectors.

With `J = sum_i s_i u_i v_i^T`, damping lambda and the width `e = FILTER lambda`:

    gain      g(s) = s / (s^2 + lambda^2)    of the damped inverse    sum_i g(s_i) v_i u_i^T
    removal   f(s) = min(s / e, 1)           of the projector         I - sum_i f(s_i) v_i v_i^T

Without damping `g(s) = 1 / s` and `f(s) = 1`, except for singular values that count as zero: there both
are 0. Arrays are checked by the callers.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics.elementary import minimum, sqrt, where

CUTOFF = 1e-15
"""Without damping, singular values below `CUTOFF max(m, n)` times the largest one count as zero."""
FILTER = 0.1
"""Width of the projector's filter, relative to the damping."""
TINY = float(np.finfo(np.float64).tiny)
"""Smaller numbers have no inverse."""
LARGE = 400
"""Entries below `2**LARGE` have squares, and sums of their squares, that do not overflow."""
SHORT = 8192
"""Elements that BLAS adds up in one thread."""

Array = NDArray[np.float64]


def gain(value: Any, damping: Any, least: Any) -> Any:
    """Compute g(s) of floats or arrays. Without damping, singular values up to `least` count as zero."""
    kept = value > where(damping > 0.0, TINY, least)
    safe = where(kept, value, 1.0)
    return where(kept, 1.0 / (safe + damping * (damping / safe)), 0.0)


def removal(value: Any, damping: Any, least: Any) -> Any:
    """Compute f(s) of floats or arrays. Without damping, singular values up to `least` count as zero."""
    damped = damping > 0.0
    # Divided one after the other: the product may be too small for a number.
    filtered = minimum(value / where(damped, damping, 1.0) / FILTER, 1.0)
    return where(damped, filtered, where(value > least, 1.0, 0.0))


def gains(values: Array, damping: Array, least: Any) -> Array:
    """Compute g(s) of singular values, shape (..., k), with damping and least of shape (...)."""
    return _each(gain, values, damping, least)


def removals(values: Array, damping: Array, least: Any) -> Array:
    """Compute f(s) of singular values, shape (..., k), with damping and least of shape (...)."""
    return _each(removal, values, damping, least)


def negligible(norm: Any, relative: float) -> Any:
    """Return up to which value singular values count as zero without damping, a float or shape (...)."""
    if np.ndim(norm) == 0:
        return max(relative * float(norm), TINY)
    return np.maximum(relative * norm, TINY)


def pseudoinverse(J: Array) -> Array:
    """Compute J^+, shape (..., n, m)."""
    if is_large(J):
        units = large_exponent(J, 2)[..., np.newaxis, np.newaxis]
        return np.asarray(np.ldexp(pseudoinverse(np.ldexp(J, -units)), -units))
    left, values, right = np.linalg.svd(J, full_matrices=False)
    kept = values > np.asarray(_least(values, J.shape))[..., np.newaxis]
    inverses = kept / np.where(kept, values, 1.0)
    inverse: Array = (
        np.swapaxes(right, -1, -2) * inverses[..., np.newaxis, :] @ np.swapaxes(left, -1, -2)
    )
    return inverse


def null_space_projector(J: Array, damping: Array) -> Array:
    """Compute N with damping of shape (...), shape (..., n, n)."""
    if is_large(J):
        units = large_exponent(J, 2)
        J, damping = np.ldexp(J, -units[..., np.newaxis, np.newaxis]), np.ldexp(damping, -units)
    _, values, right = np.linalg.svd(J, full_matrices=False)
    return projector(right, removals(values, damping, _least(values, J.shape)))


def projector(right: Array, removed: Array) -> Array:
    """Compute `I - sum_i f_i v_i v_i^T` of the rows v_i and the f_i, shape (..., n, n)."""
    columns = np.swapaxes(right, -1, -2) * removed[..., np.newaxis, :]
    return np.asarray(np.eye(right.shape[-1]) - columns @ right)


def joint_velocities(J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None = None) -> Array:
    """Compute `sum_i g(s_i) v_i u_i^T x_dot`, and with q_dot_0 its projection added.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        damping: lambda, shape (...).
        q_dot_0: Secondary joint velocities, shape (..., n), or None.

    Returns:
        Joint velocities, shape (..., n). Infinite where they overflow.
    """
    axes = J.ndim == 2 and x_dot.ndim == 1 and damping.ndim == 0
    if axes and len(J) == 2 and (q_dot_0 is None or q_dot_0.ndim == 1):
        # Floats: several times as fast as arrays of one.
        secondary = [] if q_dot_0 is None else q_dot_0.tolist()
        columns = list(zip(*J.tolist(), strict=True))
        one, other = x_dot.tolist()
        single, exact = _two_rows(columns, one, other, float(damping), secondary)
        if exact:
            return np.array(single)
    method = _columns if J.shape[-2] == 2 else _by_svd
    with np.errstate(all='ignore'):
        q_dot, exact = method(J, x_dot, damping, q_dot_0)
        if np.all(exact):
            return np.asarray(q_dot)
        batch = q_dot.shape[:-1]
        redo = ~np.broadcast_to(exact, batch)

        def selected(value: Array, axes: int) -> Array:
            whole = np.broadcast_to(value, (*batch, *value.shape[value.ndim - axes :]))
            return np.asarray(whole[redo])

        secondary = None if q_dot_0 is None else selected(q_dot_0, 1)
        q_dot[redo] = _scaled(selected(J, 2), selected(x_dot, 1), selected(damping, 0), secondary)
    return np.asarray(q_dot)


def manipulability(J: Array) -> Array:
    """Compute the product of the singular values of Jacobians with m <= n, shape (...)."""
    if J.ndim == len(J) == 2:
        columns = list(zip(*J.tolist(), strict=True))
        if 1e-60 < sum(a * a + b * b for a, b in columns) < 1e60:
            return np.array(_minors(columns))
    with np.errstate(all='ignore'):
        if J.shape[-2] == 2:
            w = np.asarray(_minors(_column_pairs(J)))
            squares = np.einsum('...ij,...ij->...', J, J)
            extreme = ~((squares > 1e-60) & (squares < 1e60))
        else:
            values = np.linalg.svd(J, compute_uv=False)
            w, largest = np.asarray(values.prod(axis=-1)), values[..., 0]
            extreme = ~((largest > 1e-30) & (largest < 1e30))
        if extreme.any():
            # The product is proportional to every row, so each row has its own scale.
            exponents = _exponent(J[extreme], 1)
            scaled = np.ldexp(J[extreme], -exponents[..., np.newaxis])
            w[extreme] = _scaled_manipulability(scaled, exponents.sum(axis=-1, dtype=np.int32))
    return w


def is_large(J: Array) -> bool:
    """Return whether singular values of finite Jacobians, or products with them, may overflow."""
    # BLAS would split longer arrays among threads, which takes more CPU than the sum itself.
    squares = np.vdot(J, J) if J.size <= SHORT else np.einsum('i,i->', J.ravel(), J.ravel())
    return not squares < 4.0**LARGE


def large_exponent(values: Array, axes: int) -> NDArray[np.int32]:
    """Return the binary exponent of the largest entry along the last axes, 0 if it is up to LARGE."""
    exponents = _exponent(values, axes)
    return np.asarray(np.where(exponents > LARGE, exponents, 0), dtype=np.int32)


def _least(values: Array, shape: tuple[int, ...]) -> Any:
    return negligible(values[..., 0], CUTOFF * max(shape[-2:]))


def _each(function: Any, values: Array, damping: Array, least: Any) -> Array:
    """Apply a function to each singular value, of a single Jacobian as a float, which is faster."""
    if values.ndim == 1 and type(least) is float and damping.ndim == 0:
        factor = float(damping)
        return np.array([function(value, factor, least) for value in values.tolist()])
    least = np.asarray(least)
    with np.errstate(all='ignore'):
        computed: Array = function(values, damping[..., np.newaxis], least[..., np.newaxis])
    return computed


def _minors(columns: list[tuple[Any, Any]]) -> Any:
    """Compute the manipulability of two rows: the root of the sum of all squared minors (Cauchy and
    Binet), which loses no digits.
    """
    squares: Any = 0.0
    for i, (a, b) in enumerate(columns):
        for c, d in columns[:i]:
            minor = a * d - c * b
            squares = squares + minor * minor
    return sqrt(squares)


def _column_pairs(J: Array) -> list[tuple[Any, Any]]:
    """Return the columns of two rows: pairs of shape (...)."""
    return [(J[..., 0, k], J[..., 1, k]) for k in range(J.shape[-1])]


def _scaled_manipulability(J: Array, exponents: NDArray[np.int32]) -> Array:
    """Compute the manipulability of Jacobians whose rows are about 1, times two to the exponents."""
    if J.shape[-2] == 2:
        return np.asarray(np.ldexp(_minors(_column_pairs(J)), exponents))
    # Singular values can be so small that their product underflows before it is scaled.
    mantissas, powers = np.frexp(np.linalg.svd(J, compute_uv=False))
    exponents = exponents + powers.sum(axis=-1, dtype=np.int32)
    return np.asarray(np.ldexp(mantissas.prod(axis=-1), exponents))


def _exponent(values: Array, axes: int) -> NDArray[np.int32]:
    """Return the binary exponent of the largest entry along the last axes."""
    largest = np.abs(values).max(axis=tuple(range(-axes, 0)))
    return np.asarray(np.frexp(largest)[1], dtype=np.int32)


def _scaled(J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None) -> Array:
    """Compute joint velocities, shape (k, n), from entries scaled to about 1, which cannot overflow."""
    units, speeds = _exponent(J, 2)[:, np.newaxis], _exponent(x_dot, 1)[:, np.newaxis]
    J, damping = np.ldexp(J, -units[..., np.newaxis]), np.ldexp(damping, -units[:, 0])
    # Without damping, singular values of J count as zero if their inverse is not a number.
    tiny = np.ldexp(np.full(len(units), TINY), -units[:, 0])
    task, _ = _by_svd(J, np.ldexp(x_dot, -speeds), damping, None, tiny)
    q_dot: Array = np.ldexp(task, speeds - units)
    if q_dot_0 is not None:
        own = _exponent(q_dot_0, 1)[:, np.newaxis]
        free, _ = _by_svd(J, np.zeros_like(x_dot), damping, np.ldexp(q_dot_0, -own), tiny)
        total = q_dot + np.ldexp(free, own)
        # Infinite terms of opposite signs: add them at the larger scale.
        top = np.maximum(speeds - units, own)
        scaled = np.ldexp(task, speeds - units - top) + np.ldexp(free, own - top)
        q_dot = np.where(np.isnan(total), np.ldexp(scaled, top), total)
    return q_dot


def _by_svd(
    J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None, tiny: Array | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Compute joint velocities, and where neither overflow nor underflow can have spoilt them."""
    left, values, right = np.linalg.svd(J, full_matrices=False)
    least = _least(values, J.shape)
    if tiny is not None:
        least = np.maximum(least, tiny)
    along = gains(values, damping, least) * (x_dot[..., np.newaxis, :] @ left)[..., 0, :]
    if q_dot_0 is not None:
        secondary = (right @ q_dot_0[..., np.newaxis])[..., 0]
        along = along - removals(values, damping, least) * secondary
    q_dot: Array = (along[..., np.newaxis, :] @ right)[..., 0, :]
    if q_dot_0 is not None:
        q_dot = q_dot + q_dot_0
    largest = values[..., 0]
    return q_dot, (largest > 1e-30) & (largest < 1e30) & np.isfinite(q_dot).all(axis=-1)


def _columns(J: Array, x_dot: Array, damping: Array, q_dot_0: Array | None) -> tuple[Array, Any]:
    """Compute the same for arrays of two rows."""
    # Column by column, because loops over the short last axis take longer.
    secondary = [] if q_dot_0 is None else [q_dot_0[..., k] for k in range(J.shape[-1])]
    q_dot, exact = _two_rows(_column_pairs(J), x_dot[..., 0], x_dot[..., 1], damping, secondary)
    return np.stack(q_dot, axis=-1), exact


def _two_rows(
    columns: list[tuple[Any, Any]], one: Any, other: Any, factor: Any, secondary: list[Any]
) -> tuple[list[Any], Any]:
    """Compute the same for two rows, in closed form: a rotation in the plane of the task makes the rows
    orthogonal (one-sided Jacobi), then they are `s_i v_i^T`. Many times as fast as LAPACK.
    """
    n = len(columns)
    for _ in range(2):  # The second rotation removes the rounding of the first near a singularity.
        c, s = _rotation(*_products(columns))
        one, other = c * one + s * other, c * other - s * one
        columns = [(c * a + s * b, c * b - s * a) for a, b in columns]
    first, second, _ = _products(columns)
    largest, smallest = sqrt(first), sqrt(second)
    least = where(largest > TINY, CUTOFF * max(2, n) * largest, TINY)
    # The rows are singular vectors times singular values: divide by these once more.
    by_first, by_second = where(first > 0.0, largest, 1.0), where(second > 0.0, smallest, 1.0)
    one = gain(largest, factor, least) / by_first * one
    other = gain(smallest, factor, least) / by_second * other
    if secondary:
        along = _sum(a * q for (a, _), q in zip(columns, secondary, strict=True)) / by_first
        across = _sum(b * q for (_, b), q in zip(columns, secondary, strict=True)) / by_second
        one = one - removal(largest, factor, least) * along / by_first
        other = other - removal(smallest, factor, least) * across / by_second
        q_dot = [one * a + other * b + q for (a, b), q in zip(columns, secondary, strict=True)]
    else:
        q_dot = [one * a + other * b for a, b in columns]
    exact = (first > 1e-60) & (first < 1e60) & (abs(_sum(map(abs, q_dot))) < np.inf)
    small = second < 1e-200
    if small is not False and np.any(small):
        # Its square may have underflowed although that of the first has not.
        exact = exact & ~(np.asarray(small) & np.any([b != 0.0 for _, b in columns], axis=0))
    return q_dot, exact


def _rotation(first: Any, second: Any, both: Any) -> tuple[Any, Any]:
    """Return cosine and sine of the angle that makes two rows orthogonal, the first the longer one.

    All operations are correctly rounded, so floats and arrays have equal results.
    """
    difference = first - second
    double = sqrt(difference * difference + 4.0 * both * both)
    safe = where(double > 0.0, double, 1.0)
    # Half of the angle whose cosine is difference / double, without cancellation.
    larger = sqrt(0.5 + 0.5 * where(double > 0.0, abs(difference) / safe, 1.0))
    smaller = abs(both) / (safe * larger)
    sign = where(both < 0.0, -1.0, 1.0)
    turned = difference < 0.0
    return where(turned, smaller, larger), sign * where(turned, larger, smaller)


def _products(columns: list[tuple[Any, Any]]) -> tuple[Any, Any, Any]:
    """Return the squares of two rows, and their product."""
    a, b = columns[0]
    first, second, both = a * a, b * b, a * b
    for a, b in columns[1:]:
        first, second, both = first + a * a, second + b * b, both + a * b
    return first, second, both


def _sum(terms: Iterable[Any]) -> Any:
    """Add from left to right: `sum` of floats may compensate rounding, that of arrays does not."""
    return functools.reduce(operator.add, terms)
