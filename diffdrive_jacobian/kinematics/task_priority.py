"""Several tasks at once, in the order of their priority, and limits of the joint velocities.

Models, damping, weights and null-space projectors are those of `inverse_velocity`, which also exports
these functions. Everything broadcasts over leading axes. Wrong shapes, shapes that do not broadcast and
values that are not finite raise ValueError.

Source: document C, "Contact constraints"; doc/mathematics.md, "Manipulators". B. Siciliano,
J.-J. Slotine, "A general framework for managing multiple tasks in highly redundant robotic systems",
1991.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._checks import array, floats, leading, number, positive
from diffdrive_jacobian.kinematics._singular_values import gains, negligible, projector, removals
from diffdrive_jacobian.kinematics._task_checks import checked_damping, checked_task, weighted

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
        ValueError: There is no task, a task is not a pair, or the numbers of joints differ.
    """
    cutoff = number('cutoff', cutoff, positive)
    if cutoff >= 1.0:
        raise ValueError(f'cutoff must be below 1, got {cutoff}')
    factor = checked_damping(damping)
    pairs = _checked(tasks)
    n = pairs[0][0].shape[-1]
    roots = None
    if weights is not None:
        scaled = [weighted(J, weights) for J, _ in pairs]
        pairs = [(J, x_dot) for (J, _), (_, x_dot) in zip(scaled, pairs, strict=True)]
        roots = scaled[0][1]
    batch = leading(
        **{f'task {k} J': J.shape[:-2] for k, (J, _) in enumerate(pairs)},
        **{f'task {k} x_dot': x_dot.shape[:-1] for k, (_, x_dot) in enumerate(pairs)},
        damping=factor.shape,
        weights=() if roots is None else roots.shape[:-1],
    )
    q_dot, free = np.zeros((*batch, n)), np.eye(n)
    for k, (J, x_dot) in enumerate(pairs):
        left, values, right = np.linalg.svd(J @ free if k else J, full_matrices=False)
        norm = np.linalg.norm(J, ord=2, axis=(-2, -1)) if k else values[..., 0]
        least = negligible(norm, cutoff)
        missing = x_dot - (J @ q_dot[..., np.newaxis])[..., 0] if k else x_dot
        along = gains(values, factor, least) * (missing[..., np.newaxis, :] @ left)[..., 0, :]
        step = np.swapaxes(right, -1, -2) @ along[..., np.newaxis]
        q_dot = q_dot + (free @ step if k else step)[..., 0]
        if k < len(pairs) - 1:
            free = free @ projector(right, removals(values, factor, least))
    if roots is not None:
        q_dot = q_dot / roots
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
    q_dot, most = array('q_dot', q_dot, 'n'), floats('max_velocity', max_velocity)
    if most.shape[-1:] not in ((), q_dot.shape[-1:]):
        raise ValueError(
            f'max_velocity must have shape () or (..., {q_dot.shape[-1]}), got {most.shape}'
        )
    if not (most > 0.0).all():
        raise ValueError(f'max_velocity must be positive, got {most}')
    leading(q_dot=q_dot.shape, max_velocity=most.shape)
    excess = (np.abs(q_dot) / most).max(axis=-1, keepdims=True)
    return np.asarray(np.clip(q_dot / np.maximum(excess, 1.0), -most, most))


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
