"""Numeric inverse kinematics: joints q at which `forward(q)` is the target, searched from a start q0.

With the error `e = target - forward(q)`, the Jacobian `J = d forward / d q`, and the weights of the
task's entries on the diagonal of M, the steps are

    newton               q += J^+ e                              undamped, taken wherever it leads
    transpose            q += alpha J^T M e                      downhill on e^T M e
    levenberg_marquardt  q += (J^T M J + lambda I)^-1 J^T M e    downhill, near the target like newton

Thousands of targets are solved at once, each with an outcome of its own: that one is not reached is a
result, not an exception. Units are those of forward and q; q may hold rad beside m.

Source: document C, "Inverse kinematics" (its update lost the minus of `r_goal - r_i`); document D, 6;
MATH.md, "Manipulators and inverse velocity". How lambda is lowered: H. B. Nielsen, *Damping Parameter in
Marquardt's Method*, IMM-REP-1999-05. Why the line search stops short of the least error: M. Raydan,
B. F. Svaiter, *Relaxed Steepest Descent and Cauchy-Barzilai-Borwein Method*, 2002.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._checks import array, floats, leading, not_negative, number, positive
from diffdrive_jacobian.kinematics._elementary import wrapped
from diffdrive_jacobian.kinematics.inverse_velocity import damped_least_squares

Floats = NDArray[np.float64]
Function = Callable[[Floats], ArrayLike]
Difference = Callable[[Floats, Floats], ArrayLike]

METHODS = ('newton', 'transpose', 'levenberg_marquardt')
EPS = float(np.finfo(np.float64).eps)
STATIONARY = 1e-6
"""Cosine between the error and what a joint does, below which the joint cannot lower the error."""
RELAXED = 0.9
"""How far the line search goes on the way to the least error: all the way, the path would zigzag."""


class IKResult(NamedTuple):
    """What was found for each target; the leading axes are those of targets and starts.

    Attributes:
        q: The best joints seen, shape (..., n).
        converged: Whether the error is within the tolerance, shape (...).
        iterations: Steps that were tried, shape (...).
        error: `sqrt(e^T M e)` at q, shape (...); not finite where forward(q0) is not.
    """

    q: Floats
    converged: NDArray[np.bool_]
    iterations: NDArray[np.int64]
    error: Floats


def pose_difference(target: ArrayLike, pose: ArrayLike) -> Floats:
    """Give the error of planar poses, for `solve(..., difference=pose_difference)`.

    Args:
        target: `[x, y, heading]` wanted, shape (..., 3) (m, m, rad).
        pose: `[x, y, heading]` that is, shape (..., 3) (m, m, rad).

    Returns:
        `target - pose`, shape (..., 3), the heading wrapped to (-pi, pi].

    Raises:
        ValueError: A shape is wrong, or an entry is infinite or NaN.
    """
    target, pose = array('target', target, 3), array('pose', pose, 3)
    leading(target=target.shape[:-1], pose=pose.shape[:-1])
    difference: Floats = target - pose
    difference[..., 2] = wrapped(difference[..., 2])
    return difference


def solve(
    forward: Function,
    jacobian: Function,
    target: ArrayLike,
    q0: ArrayLike,
    *,
    method: str = 'levenberg_marquardt',
    mask: ArrayLike | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
    damping: float = 0.1,
    difference: Difference | None = None,
) -> IKResult:
    """Find joints at which forward is the target, for one target or for thousands (C, D).

    A target is given up when to first order no joint lowers its error (at the nearest reachable point,
    or at a singular start), when a function returns something that is not finite, and after
    max_iterations. `transpose` and `levenberg_marquardt` never let the error grow, and end at the
    nearest reachable point if steps suffice; `newton` may run in circles, and gives the best q it saw.

    Args:
        forward: Maps joints of shape (k, n) to what they reach, shape (k, m). Called only for the
            targets that are still open, and only with finite joints.
        jacobian: Maps joints of shape (k, n) to the derivative of forward, shape (k, m, n).
        target: What is to be reached, shape (..., m).
        q0: Where the search begins, shape (..., n).
        method: `newton`, `transpose` or `levenberg_marquardt`.
        mask: Weights of the task's entries, the diagonal of M, shape (m,); zero leaves an entry out.
            None weighs all of them 1.
        tolerance: The error `sqrt(e^T M e)` at which a target counts as reached.
        max_iterations: How many steps are tried at the most.
        damping: The first lambda of `levenberg_marquardt`, in the unit of `J^T M J`.
        difference: Gives the error, shape (k, m), of targets and what is reached, as `pose_difference`
            does; None subtracts.

    Returns:
        Joints, whether they converged, after how many steps, with what error. NumPy's warnings stay in.

    Raises:
        ValueError: An argument has a wrong shape or value, or a function returns a wrong shape.
    """
    target, q0 = array('target', target, 'm'), array('q0', q0, 'n')
    (m,), (n,) = target.shape[-1:], q0.shape[-1:]
    batch = leading(target=target.shape[:-1], q0=q0.shape[:-1])
    if method not in METHODS:
        raise ValueError(f'method must be one of {", ".join(METHODS)}, got {method!r}')
    whole = isinstance(max_iterations, (int, np.integer)) and not isinstance(max_iterations, bool)
    if not whole or max_iterations < 1:
        raise ValueError(f'max_iterations must be an integer of at least 1, got {max_iterations!r}')
    weights = _weights(mask, m)
    search = _Search(
        forward=forward,
        jacobian=jacobian,
        difference=np.subtract if difference is None else difference,
        rows=weights > 0.0,
        roots=np.sqrt(weights[weights > 0.0]),
        targets=np.broadcast_to(target, (*batch, m)).reshape(-1, m),
        method=method,
        tolerance=number('tolerance', tolerance, positive),
        damping=number('damping', damping, positive),
    )
    # Of the user's functions, too: what they return is looked at.
    with np.errstate(all='ignore'):
        found = search.run(np.broadcast_to(q0, (*batch, n)).reshape(-1, n), max_iterations)
    # [()] makes a scalar of what a single target gives.
    return IKResult._make(field.reshape((*batch, *field.shape[1:]))[()] for field in found)


class _Open(NamedTuple):
    """The targets that are still open: one row each."""

    which: NDArray[np.int64]
    q: Floats
    e: Floats
    error: Floats
    J: Floats
    factor: Floats
    """Lambda, or the line search's share of the step that were best if forward were linear."""

    def keep(self, rows: NDArray[np.bool_]) -> _Open:
        return self if rows.all() else _Open._make(field[rows] for field in self)


class _Search(NamedTuple):
    """What is searched for and how. Errors and Jacobians are `sqrt(M) e` and `sqrt(M) J` throughout."""

    forward: Function
    jacobian: Function
    difference: Difference
    rows: NDArray[np.bool_]
    roots: Floats
    """The task's entries that weigh something, and the roots of their weights."""
    targets: Floats
    method: str
    tolerance: float
    damping: float

    def run(self, q: Floats, max_iterations: int) -> IKResult:
        first = {'newton': 0.0, 'transpose': RELAXED, 'levenberg_marquardt': self.damping}[self.method]
        which = np.arange(len(q))
        e, error = self._errors(q, which)
        found = IKResult(q.copy(), error <= self.tolerance, np.zeros_like(which), error.copy())
        J = np.zeros((*e.shape, q.shape[-1]))
        still = _Open(which, q.copy(), e, error, J, np.full(len(q), first))
        still = still.keep(np.isfinite(error) & ~found.converged)
        self._differentiate(still, np.ones(len(still.which), dtype=np.bool_))
        for _ in range(max_iterations):
            still = still.keep(_movable(still))
            if not len(still.which):
                break
            still = self._advance(still, found)
        return found._replace(converged=found.error <= self.tolerance)

    def _advance(self, still: _Open, found: IKResult) -> _Open:
        """Try a step for every open target; give those that are open after it."""
        gradient = np.einsum('kmn,km->kn', still.J, still.e)
        tried = still.q + self._step(still, gradient)
        # A step that overflows is none.
        tried = np.where(np.isfinite(tried).all(axis=-1, keepdims=True), tried, still.q)
        e, error = self._errors(tried, still.which)
        by = tried - still.q
        change = (error - still.error) * (error + still.error)
        slope = np.einsum('kn,kn->k', by, gradient)
        taken = np.isfinite(error)
        ended = ~taken | (np.linalg.norm(by, axis=-1) <= EPS * np.linalg.norm(still.q, axis=-1))
        if self.method != 'newton':
            taken &= change < 0.0
        still.factor[:] = self._adapted(still, by, slope, change, taken)
        for field, new in (still.q, tried), (still.e, e), (still.error, error):
            field[taken] = new[taken]
        best = still.error < found.error[still.which]
        which = still.which[best]
        found.q[which], found.error[which] = still.q[best], still.error[best]
        found.iterations[still.which] += 1
        ended |= still.error <= self.tolerance
        self._differentiate(still, taken & ~ended)
        return still.keep(~ended)

    def _step(self, still: _Open, gradient: Floats) -> Floats:
        if self.method == 'transpose':
            along = np.einsum('kmn,kn->km', still.J, gradient)
            linear = np.linalg.norm(gradient, axis=-1) / np.linalg.norm(along, axis=-1)
            return np.asarray(gradient * (still.factor * linear**2)[:, np.newaxis])
        # With lambda zero it is the pseudo-inverse's.
        return damped_least_squares(still.J, still.e, np.sqrt(still.factor))

    def _adapted(
        self, still: _Open, by: Floats, slope: Floats, change: Floats, taken: NDArray[np.bool_]
    ) -> Floats:
        """Give the factors for the next step from what this one did to `e^T M e`, beside `2 slope`."""
        if self.method == 'newton':
            return still.factor
        if self.method == 'transpose':
            # As far as would have been best by the parabola through this step's slope and end.
            bend = change + 2.0 * slope
            best = np.where(bend > 0.0, slope / bend, np.inf)
            return still.factor * np.clip(RELAXED * best, 0.1, np.where(taken, 4.0, 0.5))
        # Lower where forward is as linear as was promised, higher where a step is not taken.
        gain = -change / (slope + still.factor * np.einsum('kn,kn->k', by, by))
        lowered = still.factor * np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        # Less would drown in the rounding of J^T M J, and would take long to raise.
        least = EPS * np.einsum('kmn,kmn->k', still.J, still.J)
        changed = np.where(taken, lowered, 4.0 * still.factor)
        return np.asarray(np.fmax(changed, least))

    def _errors(self, q: Floats, which: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Give the errors and their norms, NaN where forward is not finite."""
        target = self.targets[which]
        e = np.full_like(target, np.nan)
        if len(q):
            # A copy: what a function does to its argument is its own affair.
            pose = _returned('forward', self.forward(q.copy()), target.shape, q)
            good = np.isfinite(pose).all(axis=-1)
            if good.any():
                target, pose = target[good], pose[good]
                e[good] = _returned('difference', self.difference(target, pose), pose.shape, q[good])
        e = e[:, self.rows] * self.roots
        return e, np.linalg.norm(e, axis=-1)

    def _differentiate(self, still: _Open, where: NDArray[np.bool_]) -> None:
        """Write the Jacobians."""
        if where.any():
            q = still.q[where]
            shape = (len(q), len(self.rows), q.shape[-1])
            jacobian = _returned('jacobian', self.jacobian(q), shape, q)
            still.J[where] = jacobian[:, self.rows] * self.roots[:, np.newaxis]


def _movable(still: _Open) -> NDArray[np.bool_]:
    """Tell where a joint lowers the error to first order; nowhere if a Jacobian is not finite."""
    # Joint by joint, so that their units do not matter.
    gradient = np.abs(np.einsum('kmn,km->kn', still.J, still.e))
    most = np.linalg.norm(still.J, axis=1) * still.error[:, np.newaxis]
    movable: NDArray[np.bool_] = (gradient > STATIONARY * most).any(axis=-1)
    return movable & np.isfinite(still.J).all(axis=(1, 2))


def _returned(name: str, value: Any, shape: tuple[int, ...], q: Floats) -> Floats:
    """Take what a function returned."""
    made = floats(f'what {name} returns', value)
    if made.shape != shape:
        raise ValueError(f'{name} must return shape {shape} for q of shape {q.shape}, got {made.shape}')
    return made


def _weights(mask: ArrayLike | None, m: int) -> Floats:
    weights = np.ones(m) if mask is None else floats('mask', mask)
    if weights.shape != (m,):
        raise ValueError(f'mask must have shape ({m},), as target has m = {m}, got {weights.shape}')
    not_negative('mask', weights)
    if not weights.any():
        raise ValueError(f'mask must have an entry that is not zero, got {weights.tolist()}')
    return weights
