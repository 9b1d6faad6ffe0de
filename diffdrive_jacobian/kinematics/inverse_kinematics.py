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

A search ends unsuccessfully where to first order no joint lowers the error: at the nearest reachable
point, in a local minimum, or at a singular start, such as a stretched arm with the target on its own
line. It is then restarted from random joints. Thousands of targets are solved at once, each with an
outcome of its own, which but for rounding does not depend on the others. A target that is not reached is
a result, not an exception. Units are those of forward and q. q may contain rad and m.

Source: document C, "Inverse kinematics" (its update lost the minus of `r_goal - r_i`); document D, 6.
How lambda is lowered: H. B. Nielsen, *Damping Parameter in Marquardt's Method*, IMM-REP-1999-05. Why the
line search stops short of the least error: M. Raydan, B. F. Svaiter, *Relaxed Steepest Descent and
Cauchy-Barzilai-Borwein Method*, 2002. Steps projected onto the limits: C. Kanzow, N. Yamashita, M.
Fukushima, *Levenberg-Marquardt methods with strong local convergence properties for solving nonlinear
equations with convex constraints*, 2004.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.search import Difference, Floats, Function, Search, Task
from diffdrive_jacobian.numerics.checks import array, floats, leading, not_negative, number, positive
from diffdrive_jacobian.numerics.elementary import wrap
from diffdrive_jacobian.numerics.fields import integer
from diffdrive_jacobian.numerics.formula import Entries, Vector, formula

__all__ = ['METHODS', 'IKResult', 'pose_difference', 'solve']

METHODS = ('newton', 'transpose', 'levenberg_marquardt')
"""Names of the methods that solve for a configuration."""


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
    converged: NDArray[np.bool_]
    iterations: NDArray[np.int64]
    error: Floats
    restarts: NDArray[np.int64]
    start: NDArray[np.int64]


@formula('(3),(3) -> (3)')
def pose_difference(target: Vector, pose: Vector) -> Entries:
    """Return the error of planar poses, for `solve(..., difference=pose_difference)`.

    Args:
        target: `[x, y, heading]` wanted, shape (..., 3) (m, m, rad).
        pose: `[x, y, heading]` that is, shape (..., 3) (m, m, rad).

    Returns:
        `target - pose`, shape (..., 3), the heading wrapped to (-pi, pi].
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
    difference: Difference | None = None,
    alpha: float | None = None,
    step_tolerance: float = 0.0,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
    restarts: int = 20,
    seed: int | np.random.Generator | None = 0,
) -> IKResult:
    """Find joints at which forward is the target, for one target or for thousands (C, D).

    A search ends when the target is reached, when to first order no joint lowers its error, when a step
    is too small, and, where steps may raise the error (`newton`, `transpose` with alpha), after 30 steps
    in a row without a lower one. It is then restarted: from random joints within the limits, or, if it
    could not take a single step, a tenth of the distance from there. All targets use the same restart
    points.

    The search for a target ends after `max_iterations` steps over all its searches, after `restarts`
    restarts, when a function returns something that is not finite, and, without limits, when three
    searches ended at the same lowest error: that is taken for the distance of the nearest reachable
    point. (Limits leave local minima, in which many searches end alike.) `levenberg_marquardt`, and
    `transpose` without alpha, never let the error grow within a search, and end at a point without a
    nearer one around it if the steps suffice. The result is the best q of all searches.

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

    Returns:
        Joints, whether they converged, after how many steps and restarts, with what error. NumPy's
        warnings are suppressed.

    Raises:
        ValueError: An argument has a wrong shape or value, or a function returns a wrong shape.
    """
    target, q0 = array('target', target, 'm'), array('q0', q0, 'n')
    (m,), (n,) = target.shape[-1:], q0.shape[-1:]
    batch = leading(target=target.shape[:-1], q0=q0.shape[:-1])
    if method not in METHODS:
        raise ValueError(f'method must be one of {", ".join(METHODS)}, got {method!r}')
    if alpha is not None:
        if method != 'transpose':
            raise ValueError(f'alpha is for the method transpose alone, got method {method!r}')
        alpha = number('alpha', alpha, positive)
    integer('max_iterations', max_iterations, 1)
    integer('restarts', restarts, 0)
    if seed is not None and not isinstance(seed, np.random.Generator):
        integer('seed', seed, 0)
    weights = _weights(mask, m)
    task = Task(
        forward=forward,
        jacobian=jacobian,
        difference=np.subtract if difference is None else difference,
        rows=weights > 0.0,
        roots=np.sqrt(weights[weights > 0.0]),
        targets=np.broadcast_to(target, (*batch, m)).reshape(-1, m),
        limits=None if limits is None else _limits(limits, n),
    )
    search = Search(
        task=task,
        method=method,
        joints=n,
        tolerance=number('tolerance', tolerance, positive),
        step_tolerance=number('step_tolerance', step_tolerance, not_negative),
        damping=number('damping', damping, positive),
        alpha=alpha,
        restarts=int(restarts),
        seed=seed,
    )
    # Of the caller's functions, too: what they return is checked.
    with np.errstate(all='ignore'):
        found = search.run(np.broadcast_to(q0, (*batch, n)).reshape(-1, n), int(max_iterations))
        converged = found.error <= search.tolerance
    fields = (found.q.T, converged, found.iterations, found.error, found.restarts, found.start)
    # [()] converts the result of a single target to a scalar.
    return IKResult._make(values.reshape((*batch, *values.shape[1:]))[()] for values in fields)


def _weights(mask: ArrayLike | None, m: int) -> Floats:
    weights = np.ones(m) if mask is None else floats('mask', mask)
    if weights.shape != (m,):
        raise ValueError(f'mask must have shape ({m},), as target has m = {m}, got {weights.shape}')
    not_negative('mask', weights)
    if not weights.any():
        raise ValueError(f'mask must have an entry that is not zero, got {weights.tolist()}')
    return weights


def _limits(limits: tuple[ArrayLike, ArrayLike], n: int) -> tuple[Floats, Floats]:
    """Return lower and upper limits, shape (n,) each."""
    try:
        sides = [floats(name, side) for name, side in zip(('lower', 'upper'), limits, strict=True)]
    except (TypeError, ValueError) as error:
        raise ValueError(f'limits must be a pair (lower, upper): {error}') from None
    for side in sides:
        if side.shape not in ((), (n,)):
            raise ValueError(f'limits must have shape () or ({n},), as q0 has n = {n}, got {side.shape}')
    lower, upper = (np.broadcast_to(side, n) for side in sides)
    # Not for NaN either.
    if not np.all((lower <= upper) & (lower < np.inf) & (upper > -np.inf)):
        raise ValueError(
            f'limits must be numbers with lower <= upper, got {lower.tolist()} and {upper.tolist()}'
        )
    return lower, upper
