"""Iterations of numeric inverse kinematics over a batch: steps, damping, limits, restarts.

Each target is a row of `Outcome`, and of `_Open` while it is searched for. All rows advance together: in
each iteration forward is called once, for a step of every open row or the start of its next search. Rows
do not influence each other: all use the same restart points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from diffdrive_jacobian.kinematics._ik_single import take_steps
from diffdrive_jacobian.kinematics._ik_task import EPS, Flags, Floats, Integers, Task, norm
from diffdrive_jacobian.kinematics._singular_values import joint_velocities

STATIONARY = {'newton': 1e-6, 'transpose': 1e-6, 'levenberg_marquardt': 1e-7}
"""Cosine between the error and what a joint does, below which the joint cannot lower the error.

The last one converges quadratically, to about the square root of the precision."""
RELAXED = 0.9
"""Fraction of the step to the minimum that the line search takes. The full step would zigzag."""
SECOND_ORDER_AFTER = 10
"""Steps of a search after which `levenberg_marquardt` adds the second derivatives of forward."""
STALLED_AFTER = 30
"""Steps in a row without a lower error after which a method that lets the error grow is restarted."""
AGREEING = 3
"""Searches that end at the same least error, after which a target is taken for unreachable.

Not with limits: these leave local minima, in which many searches may end before one finds the target."""
SAME = 1e-6
"""Relative difference up to which two errors are the same."""
NUDGE = 0.1
"""Fraction of the step to the restart point after a search that could not take a single step."""
STEP = EPS**0.25
"""Of central differences of Jacobians, which may be differences themselves."""


@dataclass
class Outcome:
    """Best result for each target, and the state of its search. Shapes (k,), q (k, n)."""

    q: Floats
    error: Floats
    iterations: Integers
    restarts: Integers
    start: Integers
    """The search that found q: 0 from q0, 1 from the first restart point."""
    began: Integers
    """Iterations before the present search."""
    lowered: Integers
    """Iterations when the error was last lowered."""
    level: Floats
    agreeing: Integers
    """The lowest error at which searches ended, and how many did."""

    @classmethod
    def of(cls, q: Floats, error: Floats) -> Outcome:
        """Return the state before the first step."""
        iterations, restarts, start, began, lowered, agreeing = np.zeros((6, len(q)), dtype=np.int64)
        return cls(
            q.copy(), error.copy(), iterations, restarts, start, began, lowered, error.copy(), agreeing
        )


class _Open(NamedTuple):
    """The targets that are not reached yet, one row each. e and J as `Task` returns them."""

    which: Integers
    q: Floats
    e: Floats
    error: Floats
    J: Floats
    factor: Floats
    """Lambda, or the share of the step that would be best if forward were linear."""

    def keep(self, rows: Flags) -> _Open:
        return self if rows.all() else _Open._make(values[rows] for values in self)


@dataclass
class Search:
    """How a task is searched for."""

    task: Task
    method: str
    tolerance: float
    step_tolerance: float
    damping: float
    alpha: float | None
    restarts: int
    seed: int | np.random.Generator | None
    _starts: Floats | None = field(default=None, init=False)

    def run(self, q: Floats, max_iterations: int) -> Outcome:
        """Search from q, shape (k, n), and from restart points, in max_iterations steps per target."""
        if self.task.limits is not None:
            q = np.clip(q, *self.task.limits)
        which = np.arange(len(q))
        e, error = self.task.errors(q, which)
        found = Outcome.of(q, error)
        J = np.zeros((*e.shape, q.shape[-1]))
        still = _Open(which, q.copy(), e, error, J, np.full(len(q), self._first_factor()))
        still = still.keep(np.isfinite(error) & (error > self.tolerance))
        ended: Flags = np.zeros(len(still.which), dtype=np.bool_)
        self._differentiate(still, ~ended)
        done = 0
        if len(ended) == 1 and self.method == 'levenberg_marquardt':
            most = min(max_iterations, SECOND_ORDER_AFTER)
            still, done = take_steps(self, still, found, most, STATIONARY[self.method])
            if still.error[0] <= self.tolerance:
                return found
        for count in range(done, max_iterations):
            J, gradient = self._free(still)
            ended |= ~self._movable(still, J, gradient)
            again = None
            if ended.any():
                again = ended & self._may_restart(still, ended, found)
                kept = again | ~ended
                still, J, gradient = still.keep(kept), J[kept], gradient[kept]
                again = again[kept] if again.any() else None
            if not len(still.which):
                break
            still, ended = self._advance(still, found, J, gradient, again, count)
        return found

    def _advance(
        self, still: _Open, found: Outcome, J: Floats, gradient: Floats, again: Flags | None, count: int
    ) -> tuple[_Open, Flags]:
        """Try a step for every row, or restart it. Return the open rows, and whose search ended."""
        tried = still.q + self._step(still, found, J, gradient, count)
        if self.task.limits is not None:
            tried = np.clip(tried, *self.task.limits)
        # A step that overflows is not taken.
        if not np.isfinite(tried).all():
            tried = np.where(np.isfinite(tried).all(axis=-1, keepdims=True), tried, still.q)
        if again is not None:
            tried[again] = self._restart(still, found, again)
        e, error = self.task.errors(tried, still.which)
        by = tried - still.q
        change = (error - still.error) * (error + still.error)
        slope, length = np.einsum('kn,kn->k', by, gradient), norm(by)
        finite = np.isfinite(error)
        ended = length <= np.maximum(EPS * norm(still.q), self.step_tolerance)
        taken = finite & (change < 0.0) if self._descends() else finite
        if self.method == 'levenberg_marquardt':
            predicted = slope + still.factor * length**2
            # A decrease below the rounding error does not count. A step cut off at limits may increase
            # it.
            ended |= ~taken & (slope >= 0.0) & (predicted <= 4.0 * EPS * still.error**2)
            still.factor[:] = self._damped(still, predicted, change, taken)
        elif self._descends():
            still.factor[:] = self._stretched(still, slope, change, taken)
        if again is not None:
            taken, ended = taken | (again & finite), ended & ~again
            still.factor[again] = self._first_factor()
        if taken.all():
            still = still._replace(q=tried, e=e, error=error)
        else:
            for values, new in (still.q, tried), (still.e, e), (still.error, error):
                values[taken] = new[taken]
        found.iterations[still.which] += 1
        self._record(still, found)
        if not self._descends():
            idle = found.iterations[still.which] - found.lowered[still.which] >= STALLED_AFTER
            ended |= idle & (found.restarts[still.which] < self.restarts)
        closed = ~finite | (still.error <= self.tolerance)
        self._differentiate(still, taken & ~closed & ~ended)
        return still.keep(~closed), ended[~closed]

    def _record(self, still: _Open, found: Outcome) -> None:
        """Keep the best joints of each target."""
        bound = found.error[still.which]
        if self._starts is not None:
            # Another search has to be better by more than rounding, so that rounding does not choose.
            other = found.start[still.which] != found.restarts[still.which]
            bound = np.where(other & (still.error > self.tolerance), (1.0 - SAME) * bound, bound)
        best = still.error < bound
        which = still.which[best]
        found.q[which], found.error[which] = still.q[best], still.error[best]
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
        return np.asarray(allowed & np.isfinite(still.J).all(axis=(1, 2)))

    def _restart(self, still: _Open, found: Outcome, again: Flags) -> Floats:
        """Return where the next search of these rows begins."""
        if self._starts is None:
            self._starts = self._sampled(still.q.shape[-1])
        which, q = still.which[again], still.q[again]
        starts = self._starts[found.restarts[which]]
        moved = (found.iterations[which] > found.began[which])[:, np.newaxis]
        found.restarts[which] += 1
        found.began[which] = found.lowered[which] = found.iterations[which] + 1
        # A small offset from a singular start is enough, and solutions near q0 are preferred.
        return np.where(moved, starts, q + NUDGE * (starts - q))

    def _sampled(self, n: int) -> Floats:
        """Draw restart points, shape (restarts, n): within the limits, and over a turn without any."""
        lower, upper = (
            np.full((2, n), np.inf) * [[-1.0], [1.0]] if self.task.limits is None else self.task.limits
        )
        open_below, open_above = np.isneginf(lower), np.isposinf(upper)
        least = np.where(open_below, np.where(open_above, -np.pi, upper - 2.0 * np.pi), lower)
        most = np.where(open_above, np.where(open_below, np.pi, lower + 2.0 * np.pi), upper)
        share = np.random.default_rng(self.seed).random((self.restarts, n))
        # Both ends scaled apart, as limits may be as far apart as floats can be.
        return np.asarray(np.clip(most * (1.0 - share) + least * share, least, most))

    # --- Steps

    def _descends(self) -> bool:
        """Return whether steps that raise the error are rejected."""
        return self.method != 'newton' and self.alpha is None

    def _first_factor(self) -> float:
        return {'newton': 0.0, 'transpose': RELAXED, 'levenberg_marquardt': self.damping}[self.method]

    def _step(self, still: _Open, found: Outcome, J: Floats, gradient: Floats, count: int) -> Floats:
        if self.method == 'transpose':
            if self.alpha is not None:
                return self.alpha * gradient
            along = np.einsum('kmn,kn->km', J, gradient)
            linear = norm(gradient) / norm(along)
            return np.asarray(gradient * (still.factor * linear**2)[:, np.newaxis])
        # With lambda zero it is the pseudo-inverse's.
        lambdas = np.sqrt(still.factor)
        if len(J) == 1:
            # In floats: ten times as fast as a batch of one.
            step = joint_velocities(J[0], still.e[0], lambdas[0, ...])[np.newaxis]
        else:
            step = joint_velocities(J, still.e, lambdas)
        if self.method == 'levenberg_marquardt' and count >= SECOND_ORDER_AFTER:
            late = found.iterations[still.which] - found.began[still.which] >= SECOND_ORDER_AFTER
            if late.any():
                some = _Open._make(values[late] for values in still)._replace(J=J[late])
                self._second_order(step, late, some, gradient[late])
        return step

    def _second_order(self, step: Floats, late: Flags, still: _Open, gradient: Floats) -> None:
        """Write the steps of these rows, with the second derivatives of forward in the Hessian.

        `H = J^T M J - sum (M e)_i d^2 forward_i / dq^2`, with its eigenvalues made positive, so that the
        step `(|H| + lambda I)^-1 J^T M e` is a descent direction. The error of J^T M J alone exceeds its
        smallest eigenvalues where J is nearly singular. A lambda that compensates for it would shorten
        the step in all directions, and hundreds of steps would be needed.
        """
        around, width = self.task.around(still.q, STEP)
        k, n = still.q.shape
        J = self.task.jacobians(around.reshape(-1, n)).reshape(k, 2, n, *still.J.shape[1:])
        bend = np.einsum('klmn,km->kln', J[:, 0] - J[:, 1], still.e)
        bend = np.divide(
            bend, width[:, :, np.newaxis], out=0.0 * bend, where=width[:, :, np.newaxis] > 0
        )
        free = np.any(still.J != 0.0, axis=1)
        bend *= free[:, :, np.newaxis] & free[:, np.newaxis]
        H = np.einsum('kmi,kmj->kij', still.J, still.J) - 0.5 * (bend + np.swapaxes(bend, 1, 2))
        good = np.isfinite(H).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(H[good])
        along = np.einsum('kij,ki->kj', vectors, gradient[good])
        along /= np.abs(values) + still.factor[good][:, np.newaxis]
        step[np.flatnonzero(late)[good]] = np.einsum('kij,kj->ki', vectors, along)

    def _stretched(self, still: _Open, slope: Floats, change: Floats, taken: Flags) -> Floats:
        """Return the line search's factors for the next step from what this one did to `e^T M e`."""
        # As far as would have been best by the parabola through this step's slope and end.
        bend = change + 2.0 * slope
        best = np.where(bend > 0.0, slope / bend, np.inf)
        return np.asarray(still.factor * np.clip(RELAXED * best, 0.1, np.where(taken, 4.0, 0.5)))

    def _damped(self, still: _Open, predicted: Floats, change: Floats, taken: Flags) -> Floats:
        """Return lambda for the next step, lower where the error fell as predicted."""
        gain = np.where(predicted > 0.0, -change / predicted, 0.5)
        lowered = still.factor * np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        # Less would drown in the rounding of J^T M J, and would take long to raise.
        least = EPS * np.einsum('kmn,kmn->k', still.J, still.J)
        return np.asarray(np.fmax(np.where(taken, lowered, 4.0 * still.factor), least))

    def _free(self, still: _Open) -> tuple[Floats, Floats]:
        """Return J and `J^T M e`, zero for joints at a limit that would have to go beyond it."""
        gradient = np.einsum('kmn,km->kn', still.J, still.e)
        if self.task.limits is None:
            return still.J, gradient
        lower, upper = self.task.limits
        blocked = ((still.q <= lower) & (gradient < 0.0)) | ((still.q >= upper) & (gradient > 0.0))
        return np.where(blocked[:, np.newaxis], 0.0, still.J), np.where(blocked, 0.0, gradient)

    def _movable(self, still: _Open, J: Floats, gradient: Floats) -> Flags:
        """Return which joints lower the error to first order. None if a Jacobian is not finite."""
        # Joint by joint, so that their units do not matter.
        most = np.sqrt(np.einsum('kmn,kmn->kn', J, J)) * still.error[:, np.newaxis]
        movable: Flags = (np.abs(gradient) > STATIONARY[self.method] * most).any(axis=-1)
        return np.asarray(movable & np.isfinite(J).all(axis=(1, 2)))

    def _differentiate(self, still: _Open, where: Flags) -> None:
        """Write the Jacobians of these rows."""
        if where.any():
            still.J[where] = self.task.jacobians(still.q[where])
