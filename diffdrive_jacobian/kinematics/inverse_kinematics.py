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

"""Numeric inverse kinematics: joints q at which `forward(q)` is the target, searched from a start q0.

With the error `e = target - forward(q)`, the Jacobian `J = d forward / d q`, and the weights of the
task's entries on the diagonal of M, the steps are

    newton               q += J^+ e                              undamped, taken wherever it leads
    transpose            q += alpha J^T M e                      alpha by line search, or the caller's
    levenberg_marquardt  q += (J^T M J + lambda I)^-1 J^T M e    downhill, near the target like newton

After ten steps of a search `levenberg_marquardt` adds `-sum (M e)_i d^2 forward_i / dq^2` to `J^T M J`,
from differences of Jacobians. Without it hundreds of steps are needed where J is nearly singular: the
error times the curvature of forward is then larger than the small eigenvalues of `J^T M J`, and a lambda
that makes up for it in one direction shortens the step in all of them.

Thousands of targets are searched for together: in each iteration forward is called once, for a step of
every open target or the start of its next search. But for rounding no outcome depends on the other
targets, because all use the same restart points. In the code errors and Jacobians are `sqrt(M) e` and
`sqrt(M) J`, without the entries of weight zero, so that `J^T J` and `J^T e` are the documents' `J^T M J`
and `J^T M e`. Entries come first: with k targets q has the shape (n, k), e (m, k) and J (m, n, k). The
caller's functions have them last.

A search ends unsuccessfully where to first order no joint lowers the error: at the nearest reachable
point, in a local minimum, or at a singular start, such as a stretched arm with the target on its own
line. A target that is not reached is a result, not an exception. Units are those of forward and q, which
may contain rad and m.

Source: document C, "Inverse kinematics" (its update lost the minus of `r_goal - r_i`); document D, 6.
How lambda is lowered: H. B. Nielsen, *Damping Parameter in Marquardt's Method*, IMM-REP-1999-05. Why the
line search stops short of the least error: M. Raydan, B. F. Svaiter, *Relaxed Steepest Descent and
Cauchy-Barzilai-Borwein Method*, 2002. Steps projected onto the limits: C. Kanzow, N. Yamashita, M.
Fukushima, *Levenberg-Marquardt methods with strong local convergence properties for solving nonlinear
equations with convex constraints*, 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.singular_values import EPS, column, dot, outer, svd, times
from diffdrive_jacobian.numerics.checks import (
    Checked,
    Count,
    NotNegative,
    Positive,
    array,
    floats,
    function,
    integer,
    leading,
    not_negative,
    one_of,
)
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.numerics.formula import Entries, Vector, entries_first, formula

__all__ = ['METHODS', 'IKResult', 'pose_difference', 'solve']

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
Function = Callable[[Floats], ArrayLike]
OfTwo = Callable[[Floats, Floats], ArrayLike]

METHODS = ('newton', 'transpose', 'levenberg_marquardt')
"""Names of the methods that solve for a configuration."""
STATIONARY = {'newton': 1e-6, 'transpose': 1e-6, 'levenberg_marquardt': 1e-7}
"""Cosine between the error and what a joint does, below which the joint cannot lower the error.

The last one converges quadratically, to about the square root of the precision."""
RELAXED = 0.9
"""Fraction of the step to the minimum that the line search takes. The full step would zigzag."""
SECOND_ORDER_AFTER = 10
"""Steps of a search after which `levenberg_marquardt` adds the second derivatives of forward."""
STALLED_AFTER = 30
"""Steps in a row without a lower error after which a method that lets the error grow is restarted."""
LONG_AFTER = 50
"""Steps after which a search without second derivatives is restarted: it converges slowly if at all."""
AGREEING = 3
"""Searches that end at the same least error, after which a target is taken for unreachable.

Not with limits: these leave local minima, in which many searches may end before one finds the target."""
SAME = 1e-6
"""Relative difference up to which two errors are the same."""
NUDGE = 0.1
"""Fraction of the step to the restart point after a search that could not take a single step."""
ROUNDING = 4.0 * EPS
"""Relative decrease of `e^T M e` that may be rounding alone."""
REGULAR = 100.0 * EPS
"""Added to the diagonal of `J^T M J`, relative to it, so that rounding does not make it singular."""
FIRST_DIFFERENCE, SECOND_DIFFERENCE = EPS ** (1.0 / 3.0), EPS**0.25
"""Steps of central differences, where rounding and truncation errors are alike: of forward, and of
Jacobians, which may be differences themselves."""


class IKResult(NamedTuple):
    """Result for each target. The leading axes are those of targets and starts.

    Attributes:
        q: The joints with the lowest error, shape (..., n).
        converged: Whether the error is within the tolerance, shape (...).
        iterations: Steps that were tried, over all starts, shape (...).
        error: `sqrt(e^T M e)` at q, shape (...). Not finite where forward(q0) is not.
        restarts: How often the search was restarted, shape (...).
        start: The start that led to q, shape (...): 0 for q0, i for the i-th restart.
    """

    q: Floats
    converged: Flags
    iterations: Integers
    error: Floats
    restarts: Integers
    start: Integers


@formula('(3),(3) -> (3)')
def pose_difference(target: Vector, pose: Vector) -> Entries:
    """Return the error of planar poses, for `solve(..., difference=pose_difference)`.

    Of `[x, y, heading]`, shape (..., 3) (m, m, rad), it is `target - pose`, the heading wrapped to
    (-pi, pi].
    """
    x, y, heading = target
    x_is, y_is, heading_is = pose
    return [x - x_is, y - y_is, wrap(heading - heading_is)]


def solve(
    forward: Function,
    jacobian: Function | None,
    target: ArrayLike,
    q0: ArrayLike,
    *,
    method: str = 'levenberg_marquardt',
    mask: ArrayLike | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
    damping: float = 0.1,
    difference: OfTwo | None = None,
    difference_jacobian: OfTwo | None = None,
    alpha: float | None = None,
    step_tolerance: float = 0.0,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
    restarts: int = 20,
    seed: int | np.random.Generator | None = 0,
) -> IKResult:
    """Find joints at which forward is the target, for one target or for thousands (C, D).

    A search ends when the target is reached, when to first order no joint lowers its error, when a step
    is too small, and, while restarts are left, where steps may raise the error (`newton`, `transpose`
    with alpha) after 30 steps in a row without a lower one, and for `levenberg_marquardt` without second
    derivatives after 50 steps. It is then restarted: from random joints within the limits, or, if it
    could not take a single step, a tenth of the distance from there. All targets use the same restart
    points.

    The search for a target ends after `max_iterations` steps over all its searches, after `restarts`
    restarts, when a function returns something that is not finite, and, without limits, when three
    searches ended at the same lowest error: that is taken for the distance of the nearest reachable
    point. (Limits leave local minima, in which many searches end alike.) `levenberg_marquardt`, and
    `transpose` without alpha, never let the error grow within a search, and end at a point without a
    nearer one around it if the steps suffice. (With a `difference_jacobian` that point is nearest to a
    part in a thousand.) The result is the best q of all searches.

    Args:
        forward: Maps joints of shape (k, n) to what they reach, shape (k, m). Called only for the
            targets that are still open, and only with finite joints within the limits.
        jacobian: Maps joints of shape (k, n) to the derivative of forward, shape (k, m, n). None takes
            central differences of forward (2 n calls of it in one batch).
        target: What is to be reached, shape (..., m).
        q0: Start of the search, shape (..., n). Moved to the limits if it is beyond them.
        method: `newton`, `transpose` or `levenberg_marquardt`.
        mask: Weights of the task's entries, the diagonal of M, shape (m,). Zero omits an entry.
            None weighs all of them 1.
        tolerance: The error `sqrt(e^T M e)` at which a target counts as reached.
        max_iterations: How many steps are tried at the most, over all starts of a target.
        damping: The first lambda of `levenberg_marquardt`, in the unit of `J^T M J`.
        difference: Returns the error, shape (k, m), of targets and what is reached, as `pose_difference`
            does; None subtracts.
        difference_jacobian: Returns minus the derivative of the error by the joints, shape (k, m, n), of
            errors and of what jacobian returns, for a jacobian that is not the derivative of forward:
            one that maps to angular velocities. `levenberg_marquardt` then adds no second derivatives.
        alpha: The fixed factor of `transpose` (D). The error falls for alpha below `2 / s^2`, s the
            largest singular value of `sqrt(M) J`; far below, it takes many steps; above, the search may
            diverge. None finds a factor for every step by line search.
        step_tolerance: A search ends after a step `|dq|` of this or less (D), in the unit of q; whether
            the target is reached depends on the error alone. Zero ends it when q does not change in
            double precision.
        limits: Lower and upper limits of the joints, each of shape (n,) or one for all. Infinite for
            none. Steps end at them.
        restarts: Largest number of restarts. 0: the search starts from q0 only.
        seed: Seed or NumPy generator of the restart points. None: they differ in every call. Joints
            without limits are drawn from (-pi, pi], those with one limit from 2 pi next to it: give
            limits for joints that are not angles.

    An argument of a wrong shape or value, and a function that returns a wrong shape, raise ValueError.
    NumPy's warnings are suppressed.
    """
    target, q0 = array('target', target, 'm'), array('q0', q0, 'n')
    (m,), (n,) = target.shape[-1:], q0.shape[-1:]
    batch = leading(target=target.shape[:-1], q0=q0.shape[:-1])
    weights = np.ones(m) if mask is None else not_negative('mask', floats('mask', mask))
    if weights.shape != (m,):
        raise ValueError(f'mask must have shape ({m},), as target has m = {m}, got {weights.shape}')
    if not weights.any():
        raise ValueError(f'mask must have an entry that is not zero, got {weights.tolist()}')
    task = Task(
        forward=function('forward', forward),
        jacobian=jacobian,
        difference=np.subtract if difference is None else difference,
        difference_jacobian=difference_jacobian,
        rows=weights > 0.0,
        roots=np.sqrt(weights[weights > 0.0]),
        targets=np.broadcast_to(target, (*batch, m)).reshape(-1, m),
        limits=None if limits is None else joint_limits(limits, n),
    )
    search = Search(
        task=task,
        method=method,
        joints=n,
        tolerance=tolerance,
        max_iterations=max_iterations,
        step_tolerance=step_tolerance,
        damping=damping,
        alpha=alpha,
        restarts=restarts,
        seed=seed,
    )
    # Of the caller's functions, too: what they return is checked.
    with np.errstate(all='ignore'):
        found = search.run(np.broadcast_to(q0, (*batch, n)).reshape(-1, n))
        converged = found.error <= search.tolerance
    fields = (found.q.T, converged, found.iterations, found.error, found.restarts, found.start)
    # [()] converts the result of a single target to a scalar.
    return IKResult._make(values.reshape((*batch, *values.shape[1:]))[()] for values in fields)


def joint_limits(limits: tuple[ArrayLike, ArrayLike], n: int) -> tuple[Floats, Floats]:
    """Return lower and upper limits, shape (n,) each, or raise ValueError."""
    try:
        sides = [floats(name, side) for name, side in zip(('lower', 'upper'), limits, strict=True)]
    except (TypeError, ValueError) as error:
        raise ValueError(f'limits must be a pair (lower, upper): {error}') from None
    for side in sides:
        if side.shape not in ((), (n,)):
            raise ValueError(
                f'limits must have shape () or ({n},), one for each joint, got {side.shape}'
            )
    lower, upper = (np.broadcast_to(side, n) for side in sides)
    # Not for NaN either.
    if not np.all((lower <= upper) & (lower < np.inf) & (upper > -np.inf)):
        raise ValueError(
            f'limits must be numbers with lower <= upper, got {lower.tolist()} and {upper.tolist()}'
        )
    return lower, upper


# --- The search


@dataclass(frozen=True)
class Task:
    """Targets, and the functions that compute the errors of joint positions."""

    forward: Function
    jacobian: Function | None
    difference: OfTwo
    difference_jacobian: OfTwo | None
    rows: Flags
    roots: Floats
    """The task's entries with a weight above zero, and the square roots of these weights."""
    targets: Floats
    limits: tuple[Floats, Floats] | None

    def errors(self, q: Floats, which: Integers) -> tuple[Floats, Floats, Floats]:
        """Return what joints of shape (k, n) miss, shape (k, m), the errors, (m, k), and their norms.

        NaN where forward is not finite.
        """
        target = self.targets[which]
        missing = np.full_like(target, np.nan)
        if len(q):
            # A copy, as the function may write to its argument.
            reached = _returned('forward', self.forward(q.copy()), target.shape, q)
            finite = np.isfinite(reached).all(axis=-1, keepdims=True)
            if finite.any():
                reached = np.where(finite, reached, target)
                missing = np.where(finite, self._differences(target, reached, q), np.nan)
        e = self._weighted(missing)
        return missing, e, norm(e)

    def derivatives(self, q: Floats, missing: Floats | None = None) -> Floats:
        """Return the Jacobians, shape (m, n, k), of joints of shape (k, n) that miss these errors."""
        shape = (len(q), len(self.rows), q.shape[-1])
        if self.jacobian is None:
            J = self._central_differences(q, shape)
        else:
            J = _returned('jacobian', self.jacobian(q.copy()), shape, q)
        if self.difference_jacobian is not None and missing is not None:
            J = _returned('difference_jacobian', self.difference_jacobian(missing, J), shape, q)
        return self._weighted(J)

    def around(self, q: Floats, step: float) -> tuple[Floats, Floats]:
        """Return points a step up and down each joint, (k, 2, n, n), and how far apart, (k, n)."""
        steps = step * np.maximum(1.0, np.abs(q))
        up, down = self.within_limits(q + steps), self.within_limits(q - steps)
        own = np.eye(q.shape[-1], dtype=np.bool_)
        ends = np.stack([up, down], axis=1)[:, :, np.newaxis]
        return np.where(own, ends, q[:, np.newaxis, np.newaxis]), up - down

    def within_limits(self, q: Floats) -> Floats:
        """Move joints that are beyond a limit to it."""
        return q if self.limits is None else np.clip(q, *self.limits)

    def _weighted(self, values: Floats) -> Floats:
        """Return `sqrt(M) e` or `sqrt(M) J`, a copy, as the caller may use its memory again."""
        if not self.rows.all():
            values = values[:, self.rows]
        roots = self.roots.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(entries_first(values, values.ndim - 1, 1) * roots)

    def _differences(self, target: Floats, reached: Floats, q: Floats) -> Floats:
        return _returned('difference', self.difference(target, reached), reached.shape, q)

    def _central_differences(self, q: Floats, shape: tuple[int, ...]) -> Floats:
        """Return Jacobians from forward alone, NaN where it is not finite near q."""
        k, m, n = shape
        around, width = self.around(q, FIRST_DIFFERENCE)
        around = around.reshape(-1, n)
        reached = _returned('forward', self.forward(around), (k * 2 * n, m), around)
        reached = reached.reshape(k, 2, n, m)
        good = np.isfinite(reached).all(axis=(1, 2, 3))
        J = np.full(shape, np.nan)
        if good.any():
            up, down = (reached[good, side].reshape(-1, m) for side in (0, 1))
            change = self._differences(up, down, around[: len(up)]).reshape(-1, n, m)
            J[good] = np.swapaxes(_quotient(change, width[good][..., np.newaxis]), 1, 2)
        return J


def norm(vectors: Floats) -> Floats:
    """Return the lengths of vectors, shape (n, k)."""
    # Several times as fast as numpy.linalg.norm with an axis.
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def _square(J: Floats) -> Floats:
    """Return `|J|^2` in the norm of Frobenius, shape (k,); infinite where it is too large for `svd`."""
    square = np.einsum('mnk,mnk->k', J, J)
    return np.where(np.isfinite(2.0 * square), square, np.inf)


def _quotient(change: Floats, width: Floats) -> Floats:
    """Divide a change by the width over which it happened, 0 for joints that cannot move."""
    return np.where(width > 0.0, change / np.where(width > 0.0, width, 1.0), 0.0)


def _returned(name: str, value: Any, shape: tuple[int, ...], q: Floats) -> Floats:
    """Check what a function of the caller returned."""
    values = floats(f'what {name} returns', value)
    if values.shape != shape:
        raise ValueError(
            f'{name} must return shape {shape} for q of shape {q.shape}, got {values.shape}'
        )
    return values


@dataclass
class Outcome:
    """Best result for each target, and the state of its search. Shapes (k,), q (n, k)."""

    q: Floats
    error: Floats
    level: Floats
    """The lowest error at which a search ended."""
    agreeing: Integers
    """How many searches ended at that error."""
    iterations: Integers
    restarts: Integers
    start: Integers
    """The search that found q: 0 from q0, 1 from the first restart point."""
    began: Integers
    """Iterations before the present search."""
    lowered: Integers
    """Iterations when the error was last lowered."""

    @classmethod
    def of(cls, q: Floats, error: Floats) -> Outcome:
        """Return the state before the first step."""
        return cls(q.copy(), error.copy(), error.copy(), *np.zeros((6, len(error)), dtype=np.int64))


class _Open(NamedTuple):
    """The targets that are not reached yet, one row each. e and J as `Task` returns them."""

    which: Integers
    q: Floats
    missing: Floats
    e: Floats
    error: Floats
    J: Floats
    factor: Floats
    """Lambda, or the share of the step that would be best if forward were linear."""

    def keep(self, rows: Flags) -> _Open:
        return self if rows.all() else _Open._make(values[..., rows] for values in self)


# Steps of q, shape (n, k). J and e are `sqrt(M) J` and `sqrt(M) e`, and JT_e is `J^T e`.


def newton_step(J: Floats, e: Floats) -> Floats:
    """Return `J^+ e` (C)."""
    J_plus = svd(J).inverse()
    return times(J_plus, e)


def transpose_step(JT_e: Floats, alpha: float | Floats) -> Floats:
    """Return `alpha J^T e` (D)."""
    return alpha * JT_e


def levenberg_marquardt_step(J: Floats, JT_e: Floats, damping: Floats) -> Floats:
    """Return `(J^T J + lambda I)^-1 J^T e` (D), with lambda of shape (k,)."""
    JT_J = outer(J, J)  # J^T J
    diagonal = np.einsum('iik->ik', JT_J)  # a view
    diagonal += damping + REGULAR * diagonal  # + lambda I, and a little against rounding
    return np.asarray(np.linalg.solve(JT_J.transpose(2, 0, 1), JT_e.T[..., np.newaxis])[..., 0].T)


def best_alpha(J: Floats, JT_e: Floats) -> Floats:
    """Return with which alpha the error would be least if forward were linear, shape (k,)."""
    return np.asarray((norm(JT_e) / norm(times(J, JT_e))) ** 2)


def _seed(name: str, value: Any) -> Any:
    if value is None or isinstance(value, np.random.Generator):
        return value
    return integer(name, value, 0)


@dataclass(frozen=True, kw_only=True)
class Search(Checked):
    """How a task is searched for, with the arguments of `solve`."""

    task: Task
    method: Annotated[str, one_of(*METHODS)]
    joints: Count
    tolerance: Positive
    max_iterations: Count
    step_tolerance: NotNegative
    damping: Positive
    alpha: Positive | None
    restarts: Annotated[int, partial(integer, low=0)]
    seed: Annotated[Any, _seed]

    def __post_init__(self) -> None:
        """Check every value."""
        super().__post_init__()
        if self.alpha is not None and self.method != 'transpose':
            raise ValueError(f'alpha is for the method transpose alone, got method {self.method!r}')

    def run(self, q: Floats) -> Outcome:
        """Search from q, shape (k, n), and from restart points."""
        q, which = self.task.within_limits(q), np.arange(len(q))
        missing, e, error = self.task.errors(q, which)
        q, missing = entries_first(q, 1, 1), entries_first(missing, 1, 1)
        found = Outcome.of(q, error)
        J: Floats = np.zeros((len(e), self.joints, len(which)))
        factor = np.full(len(which), self._first_factor)
        still = _Open(which, q, missing, e, error, J, factor)
        still = still.keep(np.isfinite(error) & (error > self.tolerance))
        ended: Flags = np.zeros(len(still.which), dtype=np.bool_)
        self._differentiate(still, ~ended)
        for _ in range(self.max_iterations):
            J, JT_e = self._free(still)
            # Joint by joint, so that their units do not matter.
            most = STATIONARY[self.method] * np.sqrt(np.einsum('mnk,mnk->nk', J, J)) * still.error
            ended |= ~(np.abs(JT_e) > most).any(axis=0) | ~np.isfinite(_square(J))
            again: Flags = np.zeros_like(ended)
            if ended.any():
                again = ended & self._may_restart(still, ended, found)
                kept = again | ~ended
                still, again = still.keep(kept), again[kept]
                J, JT_e = J[..., kept], JT_e[..., kept]
            if not len(still.which):
                break
            tried = self.task.within_limits((still.q + self._step(still, found, J, JT_e)).T).T
            # A step that overflows is not taken.
            tried = np.where(np.isfinite(tried).all(axis=0), tried, still.q)
            if again.any():
                tried[:, again] = self._restart(still, found, again)
            still, ended = self._judged(still, found, JT_e, again, tried)
        return found

    def _free(self, still: _Open) -> tuple[Floats, Floats]:
        """Return J and `J^T M e`, zero for joints at a limit that would have to go beyond it."""
        JT_e = np.einsum('mnk,mk->nk', still.J, still.e)
        if self.task.limits is None:
            return still.J, JT_e
        lower, upper = map(column, self.task.limits)
        blocked = ((still.q <= lower) & (JT_e < 0.0)) | ((still.q >= upper) & (JT_e > 0.0))
        return np.where(blocked, 0.0, still.J), np.where(blocked, 0.0, JT_e)

    def _differentiate(self, still: _Open, where: Flags) -> None:
        """Write the Jacobians of these rows."""
        if where.any():
            still.J[..., where] = self.task.derivatives(still.q[:, where].T, still.missing[:, where].T)

    # --- Steps

    @property
    def _longest(self) -> int | None:
        """Steps after which a search is restarted: of a whole search, or without a lower error."""
        if not self._descends:
            return STALLED_AFTER
        second_order = self.task.difference_jacobian is None
        return None if self.method == 'transpose' or second_order else LONG_AFTER

    @property
    def _descends(self) -> bool:
        """Whether steps that raise the error are rejected."""
        return self.method != 'newton' and self.alpha is None

    @property
    def _first_factor(self) -> float:
        return {'newton': 0.0, 'transpose': RELAXED, 'levenberg_marquardt': self.damping}[self.method]

    def _step(self, still: _Open, found: Outcome, J: Floats, JT_e: Floats) -> Floats:
        """Return the step of the method, shape (n, k)."""
        if self.method == 'newton':
            return newton_step(J, still.e)
        if self.method == 'transpose':
            alpha = still.factor * best_alpha(J, JT_e) if self.alpha is None else self.alpha
            return transpose_step(JT_e, alpha)
        step = levenberg_marquardt_step(J, JT_e, still.factor)
        late = found.iterations[still.which] - found.began[still.which] >= SECOND_ORDER_AFTER
        if self.task.difference_jacobian is None and late.any():
            step[:, late] = self._second_order_step(still._replace(J=J).keep(late), JT_e[:, late])
        return step

    def _second_order_step(self, still: _Open, JT_e: Floats) -> Floats:
        """Return `(|H| + lambda I)^-1 J^T M e`, with the second derivatives of forward, shape (n, k).

        `H = J^T M J - sum (M e)_i d^2 forward_i / dq^2`. Its eigenvalues are made positive, so that the
        step is a descent direction.
        """
        J, (m, n, k) = still.J, still.J.shape
        around, width = self.task.around(still.q.T, SECOND_DIFFERENCE)
        nearby = self.task.derivatives(around.reshape(-1, n)).reshape(m, n, k, 2, n)
        bend = np.einsum('mnkl,mk->kln', nearby[..., 0, :] - nearby[..., 1, :], still.e)
        bend = _quotient(bend, width[..., np.newaxis])
        free = (J != 0.0).any(axis=0).T
        counts = free[:, :, np.newaxis] & free[:, np.newaxis]
        counts &= np.isfinite(bend).all(axis=(1, 2), keepdims=True)
        H = outer(J, J).transpose(2, 0, 1)
        H = H - np.where(counts, 0.5 * (bend + np.swapaxes(bend, 1, 2)), 0.0)
        values, V = np.linalg.eigh(H)
        along = np.einsum('kij,ik->jk', V, JT_e) / (np.abs(values.T) + still.factor)
        return np.asarray(np.einsum('kij,jk->ik', V, along))

    # --- What became of a step

    def _judged(
        self, still: _Open, found: Outcome, JT_e: Floats, again: Flags, tried: Floats
    ) -> tuple[_Open, Flags]:
        """Take steps or reject them. Return the open rows, and whose search ended."""
        missing, e, error = self.task.errors(tried.T, still.which)
        by = tried - still.q
        change = (error - still.error) * (error + still.error)
        slope, length = dot(by, JT_e), norm(by)
        finite, rounding = np.isfinite(error), ROUNDING * still.error**2
        taken = finite & (change < -rounding) if self._descends else finite
        ended = length <= np.maximum(EPS * norm(still.q), self.step_tolerance)
        factor = still.factor
        if self.method == 'levenberg_marquardt':
            predicted = slope + factor * length**2
            # Limits may cut a step off so that it increases the error.
            ended |= ~taken & (slope >= 0.0) & (predicted <= rounding)
            factor = self._damped(still, predicted, change, taken)
        elif self._descends:
            factor = self._stretched(still, slope, change, taken)
        taken, ended = taken | (again & finite), ended & ~again
        still = still._replace(
            q=np.where(taken, tried, still.q),
            missing=np.where(taken, missing.T, still.missing),
            e=np.where(taken, e, still.e),
            error=np.where(taken, error, still.error),
            factor=np.where(again, self._first_factor, factor),
        )
        found.iterations[still.which] += 1
        self._record(still, found)
        if (longest := self._longest) is not None:
            since = found.began if self._descends else found.lowered
            long = found.iterations[still.which] - since[still.which] >= longest
            ended |= long & (found.restarts[still.which] < self.restarts)
        closed = ~finite | (still.error <= self.tolerance)
        self._differentiate(still, taken & ~closed & ~ended)
        return still.keep(~closed), ended[~closed]

    def _damped(self, still: _Open, predicted: Floats, change: Floats, taken: Flags) -> Floats:
        """Return lambda for the next step, lower where the error fell as predicted."""
        gain = np.where(predicted > 0.0, -change / predicted, 0.5)
        lowered = still.factor * np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        # Less would drown in the rounding of J^T M J, and would take long to raise.
        least = EPS * _square(still.J)
        return np.asarray(np.fmax(np.where(taken, lowered, 4.0 * still.factor), least))

    def _stretched(self, still: _Open, slope: Floats, change: Floats, taken: Flags) -> Floats:
        """Return the line search's factors for the next step from what this one did to `e^T M e`."""
        # As far as would have been best by the parabola through this step's slope and end.
        bend = change + 2.0 * slope
        best = np.where(bend > 0.0, slope / bend, np.inf)
        return np.asarray(still.factor * np.clip(RELAXED * best, 0.1, np.where(taken, 4.0, 0.5)))

    def _record(self, still: _Open, found: Outcome) -> None:
        """Keep the best joints of each target."""
        # Another search has to be better by more than rounding, so that rounding does not choose.
        bound = found.error[still.which]
        other = found.start[still.which] != found.restarts[still.which]
        bound = np.where(other & (still.error > self.tolerance), (1.0 - SAME) * bound, bound)
        best = still.error < bound
        which = still.which[best]
        found.q[:, which], found.error[which] = still.q[:, best], still.error[best]
        found.start[which] = found.restarts[which]
        found.lowered[which] = found.iterations[which]

    # --- Restarts

    def _may_restart(self, still: _Open, ended: Flags, found: Outcome) -> Flags:
        """Store the errors at which searches ended. Return which targets to restart, shape (k,)."""
        which, error = still.which[ended], still.error[ended]
        # A search without a single step may have started at a saddle point, so its error is ignored.
        moved = found.iterations[which] > found.began[which]
        level = found.level[which]
        lower, same = moved & (error < (1.0 - SAME) * level), moved & (error <= (1.0 + SAME) * level)
        found.agreeing[which] = np.where(lower, 1, found.agreeing[which] + same)
        found.level[which] = np.where(lower, error, level)
        allowed = found.restarts[still.which] < self.restarts
        if self.task.limits is None:
            allowed &= found.agreeing[still.which] < AGREEING
        # A function that fails once would fail again.
        return np.asarray(allowed & np.isfinite(_square(still.J)))

    def _restart(self, still: _Open, found: Outcome, again: Flags) -> Floats:
        """Return where the next search of these rows begins."""
        which, q = still.which[again], still.q[:, again]
        starts = self._starts[found.restarts[which]].T
        moved = found.iterations[which] > found.began[which]
        found.restarts[which] += 1
        found.began[which] = found.lowered[which] = found.iterations[which] + 1
        # A small offset from a singular start is enough, and solutions near q0 are preferred.
        return np.asarray(np.where(moved, starts, q + NUDGE * (starts - q)))

    @cached_property
    def _starts(self) -> Floats:
        """Restart points, shape (restarts, n): within the limits, and over a turn without any."""
        lower, upper = (-np.inf, np.inf) if self.task.limits is None else self.task.limits
        open_below, open_above = np.isneginf(lower), np.isposinf(upper)
        least = np.where(open_below, np.where(open_above, -np.pi, upper - 2.0 * np.pi), lower)
        most = np.where(open_above, np.where(open_below, np.pi, lower + 2.0 * np.pi), upper)
        share = np.random.default_rng(self.seed).random((self.restarts, self.joints))
        # Both ends scaled apart, as limits may be as far apart as floats can be.
        return np.asarray(np.clip(most * (1.0 - share) + least * share, least, most))
