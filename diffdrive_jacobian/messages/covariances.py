"""Covariances in messages, which need NumPy to be checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.messages.conversion import MAX_POSITION, MessageError


def from_covariance(covariance: ArrayLike) -> NDArray[np.float64]:
    """Return a covariance of x, y and yaw, shape (3, 3), from its nine entries, row by row.

    Raises:
        MessageError: It is not finite, symmetric and positive semidefinite.
    """
    matrix = np.reshape(covariance, (3, 3))
    scale = np.abs(matrix).max()
    valid = scale <= MAX_POSITION**2 and np.abs(matrix - matrix.T).max() <= 1e-9 * scale
    if valid:
        symmetric = (matrix + matrix.T) / 2.0
        values, vectors = np.linalg.eigh(symmetric)
        valid = values[0] >= -1e-9 * scale
    if not valid:
        raise MessageError(
            f'covariance of x, y, yaw must be finite, at most {MAX_POSITION**2:g}, symmetric and '
            'positive semidefinite, '
            f'got {matrix.tolist()}'
        )
    if values[0] < 0.0:
        # Rounding of the sender: as the motion grows, so would a negative variance.
        symmetric = vectors * np.maximum(values, 0.0) @ vectors.T
    return np.asarray((symmetric + symmetric.T) / 2.0)
