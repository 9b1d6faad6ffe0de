"""What inverse kinematics searches for: the caller's functions, checked and weighted.

Errors and Jacobians are `sqrt(M) e` and `sqrt(M) J`, without the entries of weight zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.numerics.checks import floats

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
Function = Callable[[Floats], ArrayLike]
Difference = Callable[[Floats, Floats], ArrayLike]

EPS = float(np.finfo(np.float64).eps)
STEP = EPS ** (1.0 / 3.0)
"""Of central differences, where rounding and truncation errors are alike."""


@dataclass(frozen=True)
class Task:
    """Targets, and the functions that compute the errors of joint positions."""

    forward: Function
    jacobian: Function | None
    difference: Difference
    rows: Flags
    roots: Floats
    """The task's entries with a weight above zero, and the square roots of these weights."""
    targets: Floats
    limits: tuple[Floats, Floats] | None

    def errors(self, q: Floats, which: Integers) -> tuple[Floats, Floats]:
        """Return the errors and their norms, NaN where forward is not finite."""
        target = self.targets[which]
        e = np.full_like(target, np.nan)
        if len(q):
            # A copy, as the function may write to its argument.
            pose = returned('forward', self.forward(q.copy()), target.shape, q)
            good = np.isfinite(pose).all(axis=-1)
            if good.all():
                e[:] = self._differences(target, pose, q)
            elif good.any():
                e[good] = self._differences(target[good], pose[good], q[good])
        e = self.weighted(e)
        return e, norm(e)

    def weighted(self, values: Floats) -> Floats:
        """Return what counts of errors, shape (k, m), or Jacobians, shape (k, m, n)."""
        if not self.rows.all():
            values = values[:, self.rows]
        # A product is a copy, too: the caller's functions may use their memory again.
        return values * self.roots.reshape(-1, *[1] * (values.ndim - 2))

    def _differences(self, target: Floats, pose: Floats, q: Floats) -> Floats:
        return returned('difference', self.difference(target, pose), pose.shape, q)

    def jacobians(self, q: Floats) -> Floats:
        """Return the Jacobians of joints of shape (k, n), by differences if the caller gave none."""
        shape = (len(q), len(self.rows), q.shape[-1])
        if self.jacobian is None:
            jacobian = self._central_differences(q, shape)
        else:
            jacobian = returned('jacobian', self.jacobian(q.copy()), shape, q)
        return self.weighted(jacobian)

    def _central_differences(self, q: Floats, shape: tuple[int, ...]) -> Floats:
        """Return Jacobians from forward alone, NaN where it is not finite near q."""
        k, m, n = shape
        around, width = self.around(q, STEP)
        around = around.reshape(-1, n)
        pose = returned('forward', self.forward(around), (k * 2 * n, m), around)
        pose = pose.reshape(k, 2, n, m)
        good = np.isfinite(pose).all(axis=(1, 2, 3))
        jacobian = np.full(shape, np.nan)
        if good.any():
            up, down = (pose[good, side].reshape(-1, m) for side in (0, 1))
            change = self._differences(up, down, around[: len(up)]).reshape(-1, n, m)
            wide = np.broadcast_to(width[good][:, :, np.newaxis], change.shape)
            slopes = np.divide(change, wide, out=np.zeros_like(change), where=wide > 0.0)
            jacobian[good] = np.swapaxes(slopes, 1, 2)
        return jacobian

    def around(self, q: Floats, step: float) -> tuple[Floats, Floats]:
        """Return points a step up and down each joint, (k, 2, n, n), and how far apart, (k, n)."""
        steps = step * np.maximum(1.0, np.abs(q))
        up, down = q + steps, q - steps
        if self.limits is not None:
            up, down = np.clip(up, *self.limits), np.clip(down, *self.limits)
        own = np.eye(q.shape[-1], dtype=np.bool_)
        ends = np.stack([up, down], axis=1)[:, :, np.newaxis]
        return np.where(own, ends, q[:, np.newaxis, np.newaxis]), up - down


def norm(vectors: Floats) -> Floats:
    """Return the lengths of vectors, shape (k, n)."""
    # Several times as fast as numpy.linalg.norm with an axis.
    return np.asarray(np.sqrt(np.einsum('kn,kn->k', vectors, vectors)))


def returned(name: str, value: Any, shape: tuple[int, ...], q: Floats) -> Floats:
    """Check what a function of the caller returned."""
    values = floats(f'what {name} returns', value)
    if values.shape != shape:
        raise ValueError(
            f'{name} must return shape {shape} for q of shape {q.shape}, got {values.shape}'
        )
    return values
