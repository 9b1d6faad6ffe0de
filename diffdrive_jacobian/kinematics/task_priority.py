"""Several tasks at once, in the order of their priority, and limits of the joint velocities.

Models, damping, weights and null-space projectors are those of `inverse_velocity`, which also exports
these functions. Everything broadcasts over leading axes. Wrong shapes, shapes that do not broadcast and
values that are not finite raise ValueError.

Source: document C, "Contact constraints"; doc/mathematics.md, "Manipulators". B. Siciliano,
J.-J. Slotine, "A general framework for managing multiple tasks in highly redundant robotic systems",
1991.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._singular_values import (
    gains,
    is_large,
    large_exponent,
    negligible,
    projector,
    removals,
)
from diffdrive_jacobian.kinematics._task_checks import (
    checked_damping,
    checked_task,
    finite_result,
    weighted,
)
from diffdrive_jacobian.numerics.checks import array, leading, number, positive, positive_or_infinite
from diffdrive_jacobian.numerics.elementary import operand, vector

Array = NDArray[np.float64]


def prioritized(
    tasks: Sequence[tuple[ArrayLike, ArrayLike]],
    damping: ArrayLike = 0.0,
    *,
    cutoff: float = 1e-9,
    weights: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
) -> Array:
    """Do tasks in the order of their priority, each as well as those before it allow (C).

    From `q_dot = 0` and `N = I`, for each task: `q_dot += N (J_k N)^+ (x_k_dot - J_k q_dot)`, then
    `N = N N_k` with the projector `N_k` of `J_k N`. Constraints such as contacts that must not move come
    first, with the velocity 0.

    Without damping joints move as fast as tasks that nearly conflict demand, up to the cutoff. With the
    damping lambda, the inverse and `N_k` are those of `redundant`. Then

    - q_dot is continuous in every J_k and x_k_dot;
    - task k contributes at most `|x_k_dot - J_k q_dot| / (2 lambda)`, where q_dot is the sum of the
      contributions before it; that is `|x_k_dot| / (2 lambda)` where those do not move task k;
    - no task is done exactly: along each singular vector of `J_k N` the part
      `lambda^2 / (s^2 + lambda^2)` of its velocity is missing. Contacts with the velocity 0 that come
      first lose nothing by it;
    - later tasks do not disturb earlier ones, except along singular vectors with s below
      `FILTER lambda`: there by at most `FILTER / 8` (1.25 %) of the velocity that the later task lacks.

    Args:
        tasks: `(J_k, x_k_dot)`, the most important first, shapes (..., m_k, n) and (..., m_k).
        damping: lambda for all tasks, zero or positive, in the units of the J_k, shape (...).
        cutoff: Without damping, singular values of `J_k N` below this, relative to the norm of J_k,
            count as zero: what a task demands there is dropped. Must be above rounding error.
        weights: Weights of the joints, positive, shape (..., n). None: all 1.
        max_velocity: Largest joint speeds, see `limit_velocity`. None: no limits.

    Returns:
        Joint velocities, shape (..., n).

    Raises:
        ValueError: There is no task, a task is not a pair, the numbers of joints differ, or the joint
            velocities overflow.
    """
    cutoff = number('cutoff', cutoff, positive)
    if cutoff >= 1.0:
        raise ValueError(f'cutoff must be below 1, got {cutoff}')
    factor = checked_damping(damping)
    pairs = _checked(tasks)
    roots = None
    if weights is not None:
        scaled = [weighted(J, weights, f'J of task {k}') for k, (J, _) in enumerate(pairs)]
        pairs = [(J, x_dot) for (J, _), (_, x_dot) in zip(scaled, pairs, strict=True)]
        roots = scaled[0][1]
    batch = leading(
        **{f'task {k} J': J.shape[:-2] for k, (J, _) in enumerate(pairs)},
        **{f'task {k} x_dot': x_dot.shape[:-1] for k, (_, x_dot) in enumerate(pairs)},
        damping=factor.shape,
        weights=() if roots is None else roots.shape[:-1],
    )
    with np.errstate(all='ignore'):
        q_dot = None
        if not any(is_large(J) for J, _ in pairs):
            q_dot = _in_order([(J, x_dot, factor) for J, x_dot in pairs], batch, cutoff)
        if q_dot is None or not np.isfinite(q_dot).all():
            q_dot = _scaled_in_order(pairs, factor, batch, cutoff)
            finite_result('tasks and damping', 'result', q_dot)
        if roots is not None:
            q_dot = q_dot / roots
            finite_result('tasks, damping and weights', 'result', q_dot)
    return q_dot if max_velocity is None else limit_velocity(q_dot, max_velocity)


def limit_velocity(q_dot: ArrayLike, max_velocity: ArrayLike) -> Array:
    """Scale joint velocities by the largest factor up to 1 with which no joint exceeds its limit.

    All are scaled alike. So every task keeps its direction, a task of velocity 0 is kept, and the result
    is continuous. The price: tasks of all priorities slow down, also those that do not need the joint
    at its limit.

    Args:
        q_dot: Joint velocities, shape (..., n).
        max_velocity: Largest speeds, positive or infinite, shape (..., n), or one for all joints.

    Returns:
        Joint velocities, shape (..., n), no entry larger than its limit, not even by rounding.
    """
    q_dot = array('q_dot', q_dot, 'n')
    most = np.asarray(operand('max_velocity', max_velocity, positive_or_infinite))
    if most.shape[-1:] not in ((), q_dot.shape[-1:]):
        raise ValueError(
            f'max_velocity must have shape () or (..., {q_dot.shape[-1]}), got {most.shape}'
        )
    if q_dot.ndim == 1 and most.ndim < 2:
        speeds = q_dot.tolist()
        limits = most.tolist() if most.ndim else [float(most)] * len(speeds)
        ratio = max([1.0, *(abs(a) / b for a, b in zip(speeds, limits, strict=True))])
        if ratio < math.inf:
            pairs = zip(speeds, limits, strict=True)
            return vector(*(min(max(a / ratio, -b), b) for a, b in pairs))
    leading(q_dot=q_dot.shape, max_velocity=most.shape)
    with np.errstate(over='ignore'):
        excess = (np.abs(q_dot) / most).max(axis=-1, keepdims=True)
    limited = q_dot / np.maximum(excess, 1.0)
    if not (excess < np.inf).all():
        limited = np.where(excess < np.inf, limited, _scaled_limit(q_dot, most))
    return np.asarray(np.clip(limited, -most, most))


def _in_order(tasks: list[tuple[Array, Array, Array]], batch: tuple[int, ...], cutoff: float) -> Array:
    """Compute joint velocities, shape (*batch, n), from J_k, x_k_dot and the damping of each task."""
    n = tasks[0][0].shape[-1]
    q_dot, free = np.zeros((*batch, n)), np.eye(n)
    for k, (J, x_dot, factor) in enumerate(tasks):
        left, values, right = np.linalg.svd(J @ free if k else J, full_matrices=False)
        norm = np.linalg.norm(J, ord=2, axis=(-2, -1)) if k else values[..., 0]
        least = negligible(norm, cutoff)
        missing = x_dot - (J @ q_dot[..., np.newaxis])[..., 0] if k else x_dot
        along = gains(values, factor, least) * (missing[..., np.newaxis, :] @ left)[..., 0, :]
        step = np.swapaxes(right, -1, -2) @ along[..., np.newaxis]
        q_dot = q_dot + (free @ step if k else step)[..., 0]
        if k < len(tasks) - 1:
            free = free @ projector(right, removals(values, factor, least))
    return q_dot


def _scaled_in_order(
    pairs: list[tuple[Array, Array]], damping: Array, batch: tuple[int, ...], cutoff: float
) -> Array:
    """Compute the same without overflow in between.

    A task is the same one if its Jacobian, velocity and damping are divided by the same number, and
    joint velocities are proportional to the velocities of all tasks together.
    """
    speeds = np.zeros(batch, dtype=np.int32)
    for _, x_dot in pairs:
        speeds = np.maximum(speeds, large_exponent(x_dot, 1))
    tasks = []
    for J, x_dot in pairs:
        units = large_exponent(J, 2)
        scaled = np.ldexp(x_dot, -(units + speeds)[..., np.newaxis])
        tasks.append(
            (np.ldexp(J, -units[..., np.newaxis, np.newaxis]), scaled, np.ldexp(damping, -units))
        )
    return np.asarray(np.ldexp(_in_order(tasks, batch, cutoff), speeds[..., np.newaxis]))


def _scaled_limit(q_dot: Array, most: Array) -> Array:
    """Divide joint velocities by their largest excess, computed apart from its binary exponent."""
    (speeds, speed_powers), (limits, limit_powers) = np.frexp(q_dot), np.frexp(most)
    ratios, powers = np.abs(speeds) / limits, speed_powers - limit_powers
    # Of joints at rest and of those without a limit, the exponent has no meaning.
    top = np.where(ratios > 0.0, powers, -5000).max(axis=-1, keepdims=True)
    with np.errstate(all='ignore'):
        excess = np.ldexp(ratios, np.minimum(powers - top, 0)).max(axis=-1, keepdims=True)
        return np.asarray(np.ldexp(speeds / np.where(excess > 0.0, excess, 1.0), speed_powers - top))


def _checked(tasks: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[Array, Array]]:
    """Check a list of tasks."""
    try:
        pairs = [(J, x_dot) for J, x_dot in tasks]
    except (TypeError, ValueError):
        raise ValueError(f'tasks must be pairs (J, x_dot), got {tasks!r:.60}') from None
    if not pairs:
        raise ValueError('tasks must contain at least one (J, x_dot), got none')
    checked = [
        checked_task(J, x_dot, f'J of task {k}', f'x_dot of task {k}')
        for k, (J, x_dot) in enumerate(pairs)
    ]
    joints = [J.shape[-1] for J, _ in checked]
    if len(set(joints)) > 1:
        raise ValueError(f'tasks must all be about the same joints, got Jacobians with {joints} columns')
    return checked
