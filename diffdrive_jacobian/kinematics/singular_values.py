"""Damped inverse and null-space projector of a Jacobian, by its singular values: `J = U diag(s) V^T`.

Both are computed from singular vectors and values, so that no digits are lost to `J J^T` and a Jacobian
may have any rank. Arrays are stacks, shape (..., m, n), and are checked by the callers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from diffdrive_jacobian.numerics.checks import finite
from diffdrive_jacobian.numerics.formula import Array

CUTOFF = 1e-15
"""Without damping, singular values up to `CUTOFF max(m, n)` times the largest one count as zero."""
EPS = float(np.finfo(np.float64).eps)
FILTER = 0.1
"""Width of the projector's filter, relative to the damping."""


def damped_inverse(J: Array, damping: Any = 0.0, least: Any = None) -> Array:
    """Return `J^T (J J^T + lambda^2 I)^-1`, which without damping is the pseudo-inverse J^+.

    In singular values it is `V diag(s / (s^2 + lambda^2)) U^T`.

    Args:
        J: Jacobians, shape (..., m, n).
        damping: lambda, shape (...).
        least: Without damping, singular values up to this count as zero, shape (...). None: see CUTOFF.

    Returns:
        The inverses, shape (..., n, m).
    """
    U, s, V = svd(J)
    damping = column(damping)
    counts = (damping > 0.0) | (s > _least(J, s, least))
    root = np.hypot(s, damping)  # of s^2 + lambda^2, which might underflow
    gain = np.where(counts, s / root / root, 0.0)
    return np.asarray((V * row(gain)) @ transposed(U))


def projector(J: Array, damping: Any = 0.0, least: Any = None) -> Array:
    """Return `I - V diag(f) V^T` with `f = min(s / (FILTER lambda), 1)`, without damping `I - J^+ J`.

    Args:
        J: Jacobians, shape (..., m, n).
        damping: lambda, shape (...).
        least: Without damping, singular values up to this count as zero, shape (...). None: see CUTOFF.

    Returns:
        The projectors, shape (..., n, n).
    """
    _, s, V = svd(J)
    damping = column(damping)
    filtered = np.minimum(s / damping / FILTER, 1.0)
    f = np.where(damping > 0.0, filtered, s > _least(J, s, least))
    return np.asarray(np.eye(J.shape[-1]) - (V * row(f)) @ transposed(V))


def svd(J: Array) -> tuple[Array, Array, Array]:
    """Return U, s and V, shapes (..., m, k), (..., k) and (..., n, k) with k = min(m, n).

    Raises:
        ValueError: The squares of the entries overflow.
    """
    # LAPACK may not terminate with infinite entries.
    finite('|J|^2', np.asarray(np.square(J).sum(axis=(-2, -1))))
    U, s, V_transposed = np.linalg.svd(J, full_matrices=False)
    return U, s, transposed(V_transposed)


def _least(J: Array, s: Array, least: Any) -> Any:
    """Return up to which value singular values count as zero, shape (..., 1)."""
    return CUTOFF * max(J.shape[-2:]) * s[..., :1] if least is None else column(least)


def refuse_singular(determinant: Any, singular: Any) -> None:
    """Raise LinAlgError with the determinant of the first Jacobian that is singular, if there is one."""
    if np.any(singular):
        determinant = np.asarray(determinant)
        where = tuple(int(index) for index in np.argwhere(singular)[0])
        at = f' (at index {where if len(where) > 1 else where[0]})' if where else ''
        raise np.linalg.LinAlgError(
            f'J must not be singular, got a determinant of {determinant[where]:.3g}{at}'
        )


def transposed(matrices: Array) -> Array:
    """Exchange rows and columns."""
    return np.swapaxes(matrices, -1, -2)


def times(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices, shape (..., m, n), with vectors, shape (..., n)."""
    return np.asarray((matrices @ vectors[..., np.newaxis])[..., 0])


def row(vectors: Array) -> Array:
    """Return vectors as matrices of one row, to scale the columns of matrices."""
    return np.asarray(vectors[..., np.newaxis, :])


def column(entries: Any) -> Array:
    """Append an axis of length one."""
    return np.asarray(np.asarray(entries)[..., np.newaxis])


def root(weights: Any) -> Array:
    """Return the diagonal of `W^1/2`, shape (..., n) or (1,); of None that of the identity."""
    return np.ones(1) if weights is None else np.asarray(np.sqrt(weights))
