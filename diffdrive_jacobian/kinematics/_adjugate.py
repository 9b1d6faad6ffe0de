"""The adjugate of 2x2 matrices, and the error for singular ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)


def adjugate(J: Array) -> Array:
    """Return `[[d, -b], [-c, a]]` of `[[a, b], [c, d]]`, shape (..., 2, 2)."""
    adjugates = np.empty_like(J)
    adjugates[..., 0, 0], adjugates[..., 1, 1] = J[..., 1, 1], J[..., 0, 0]
    adjugates[..., 0, 1], adjugates[..., 1, 0] = -J[..., 0, 1], -J[..., 1, 0]
    return adjugates


def refuse_singular(determinant: Any, singular: Any) -> None:
    """Raise LinAlgError with the determinant of the first Jacobian that is singular, if there is one."""
    if singular is not False and np.any(singular):
        determinant = np.asarray(determinant)
        where = tuple(int(index) for index in np.argwhere(singular)[0])
        at = f' (at index {where if len(where) > 1 else where[0]})' if where else ''
        raise np.linalg.LinAlgError(
            f'J must not be singular, got a determinant of {determinant[where]:.3g}{at}'
        )
