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

"""Damped inverse and null-space projector of a Jacobian, by its singular values: `J = U diag(s) V^T`.

Nothing is computed from `J J^T`, so that no digits are lost, and a Jacobian may have any rank. Entries
come first, as in the equations: a Jacobian is an array of shape (m, n, ...), a vector one of (n, ...).
Arguments are checked by the callers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from diffdrive_jacobian.numerics.formula import Array, entries_first, entries_last

CUTOFF = 1e-15
"""Without damping, singular values up to `CUTOFF max(m, n)` times the largest one count as zero."""
TINY = 1e-150
"""Singular values up to this count as zero, because their squares have lost digits to underflow."""
EPS = float(np.finfo(np.float64).eps)
FILTER = 0.1
"""Width of the projector's filter, relative to the damping."""


class SingularValues(NamedTuple):
    """`J = sum_i s_i u_i v_i^T`: k singular values, in any order, and singular vectors."""

    u: Array
    """Shape (k, m, ...)."""
    s: Array
    """Shape (k, ...)."""
    v: Array
    """Shape (k, n, ...)."""

    def inverse(self) -> Array:
        """Return the pseudo-inverse J^+, shape (n, m, ...)."""
        return self.damped_inverse(0.0)

    def damped_inverse(self, damping: Any, least: Any = None) -> Array:
        """Return `J^T (J J^T + lambda^2 I)^-1`, which without damping is the pseudo-inverse J^+.

        It is `sum_i s_i / (s_i^2 + lambda^2) v_i u_i^T`, shape (n, m, ...). Without damping, singular
        values up to `least` count as zero, by default those of CUTOFF. Both have the shape (...).
        """
        u, s, v = self
        gain = np.where(self._counts(damping, least), s / (s * s + damping * damping), 0.0)
        return outer(column(gain) * v, u)  # V diag(gain) U^T

    def projector(self, damping: Any = 0.0, least: Any = None) -> Array:
        """Return the projector N to the null space, which without damping is `I - J^+ J`.

        It is `I - sum_i f_i v_i v_i^T` with `f_i = min(s_i / (FILTER lambda), 1)`, shape (n, n, ...).
        """
        N: Array = -outer(column(self._removed(damping, least)) * self.v, self.v)
        N[np.diag_indices(len(N))] += 1.0
        return N

    def projected(self, q_dot: Array, damping: Any = 0.0) -> Array:
        """Return `N q_dot`, shape (n, ...): without N, whose n^2 entries take long."""
        along = self._removed(damping, None) * times(self.v, q_dot)
        return np.asarray(q_dot - dot(column(along), self.v))

    def _removed(self, damping: Any, least: Any) -> Array:
        """Return the f_i, shape (k, ...)."""
        filtered = np.minimum(self.s / damping / FILTER, 1.0)
        counts = self._counts(damping, least)
        return np.asarray(np.where(np.greater(damping, 0.0), filtered, counts))

    def _counts(self, damping: Any, least: Any) -> Any:
        """Return which singular values do not count as zero."""
        if least is None:
            least = CUTOFF * max(len(self.u[0]), len(self.v[0])) * self.s.max(axis=0)
        return self.s > np.maximum(least * np.equal(damping, 0.0), TINY)


def svd(J: Array) -> SingularValues:
    """Return the singular values and vectors of Jacobians, shape (m, n, ...).

    OverflowError: The square of an entry is not finite. LAPACK may not terminate with infinite ones.
    """
    if not np.isfinite(2.0 * np.einsum('ij...,ij...->...', J, J)).all():
        raise OverflowError('|J|^2 must be finite')
    if len(J) == 2:
        return _of_two_rows(J)
    U, s, V_transposed = np.linalg.svd(entries_last(J, 2), full_matrices=False)
    batch = J.ndim - 2
    return SingularValues(
        transposed(entries_first(U, 2, batch)),
        entries_first(s, 1, batch),
        entries_first(V_transposed, 2, batch),
    )


def _of_two_rows(J: Array) -> SingularValues:
    """Rotate two rows until they are orthogonal: then they are `s_i v_i^T` (one-sided Jacobi).

    Many times as fast as LAPACK.
    """
    first = _rotation(J)
    J = product(first, J)
    # Removes the rounding of the first one, which matters where one row is much shorter.
    second = _rotation(J)
    u, rows = product(second, first), product(second, J)
    s = np.sqrt(np.einsum('ij...,ij...->i...', rows, rows))
    return SingularValues(u, s, rows / column(np.maximum(s, TINY)))


def _rotation(J: Array) -> Array:
    """Return the rotation by at most 45 deg that makes two rows orthogonal."""
    (a, b), (_, d) = np.einsum('in...,jn...->ij...', J, J)  # J J^T
    difference, twice = a - d, 2.0 * b
    tangent = twice / (difference + np.copysign(np.hypot(difference, twice) + TINY**2, difference))
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    return np.array([[cosine, sine], [-sine, cosine]])


def refuse_singular(determinant: Any, singular: Any) -> None:
    """Raise LinAlgError with the determinant of the first Jacobian that is singular, if there is one."""
    if np.any(singular):
        determinant = np.asarray(determinant)
        where = tuple(int(index) for index in np.argwhere(singular)[0])
        at = f' (at index {where if len(where) > 1 else where[0]})' if where else ''
        raise np.linalg.LinAlgError(
            f'J must not be singular, got a determinant of {determinant[where]:.3g}{at}'
        )


def transposed(A: Array) -> Array:
    """Exchange rows and columns."""
    return np.swapaxes(A, 0, 1)


def dot(a: Array, b: Array) -> Array:
    """Multiply vectors, shape (n, ...)."""
    return np.asarray(np.einsum('i...,i...->...', a, b))


def norm(A: Array) -> Array:
    """Return the norm of Frobenius of matrices, shape (m, n, ...)."""
    return np.asarray(np.sqrt(np.einsum('ij...,ij...->...', A, A)))


def times(A: Array, x: Array) -> Array:
    """Multiply matrices, shape (m, n, ...), with vectors, shape (n, ...)."""
    return np.asarray(np.einsum('ij...,j...->i...', A, x))


def outer(a: Array, b: Array) -> Array:
    """Return `sum_i a_i b_i^T` of vectors, shapes (k, m, ...) and (k, n, ...)."""
    return np.asarray(np.einsum('im...,in...->mn...', a, b))


def product(A: Array, B: Array) -> Array:
    """Multiply matrices, shapes (l, m, ...) and (m, n, ...)."""
    return np.asarray(np.einsum('ij...,jk...->ik...', A, B))


def root(weights: Any) -> Array:
    """Return the diagonal of `W^1/2`, shape (n, ...), or (1,) if there are no weights."""
    return np.ones(1) if weights is None else np.asarray(np.sqrt(weights))


def column(x: Array) -> Array:
    """Return a vector as a matrix of one column, to scale the rows of matrices."""
    return x[:, np.newaxis]
