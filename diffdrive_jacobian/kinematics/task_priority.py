"""Several tasks at once, in the order of their priority.

Models, damping, weights and null-space projectors are those of `inverse_velocity`, which also exports
this function.

Source: document C, "Contact constraints"; doc/mathematics.md, "Manipulators". B. Siciliano,
J.-J. Slotine, "A general framework for managing multiple tasks in highly redundant robotic systems",
1991.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics.joint_limits import limit_velocity
from diffdrive_jacobian.kinematics.singular_values import norm, product, root, svd, times
from diffdrive_jacobian.numerics.checks import array, finite, leading, not_negative, number, positive
from diffdrive_jacobian.numerics.fields import short
from diffdrive_jacobian.numerics.formula import Array, entries_first, entries_last


@np.errstate(all='ignore')
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
        cutoff: Without damping, singular values of `J_k N` below this, relative to the norm of
            J_k (of Frobenius), count as zero: what a task demands there is dropped. Must be above
            rounding error.
        weights: Weights of the joints, positive, shape (..., n). None: all 1.
        max_velocity: Largest joint speeds, see `limit_velocity`. None: no limits.

    Returns:
        Joint velocities, shape (..., n).

    Raises:
        ValueError: There is no task, a task is not a pair, the numbers of joints differ, shapes do not
            broadcast, a value is not finite, or the joint velocities overflow.
    """
    cutoff = number('cutoff', cutoff, positive)
    if cutoff >= 1.0:
        raise ValueError(f'cutoff must be below 1, got {cutoff}')
    damping = array('damping', damping)
    not_negative('damping', damping)
    pairs = _checked(tasks)
    n = pairs[0][0].shape[-1]
    if weights is not None:
        weights = array('weights', weights, n)
        positive('weights', weights)
    batch = leading(
        **{f'task {k} J': J.shape[:-2] for k, (J, _) in enumerate(pairs)},
        **{f'task {k} x_dot': x_dot.shape[:-1] for k, (_, x_dot) in enumerate(pairs)},
        damping=damping.shape,
        weights=() if weights is None else weights.shape[:-1],
    )
    axes = len(batch)
    damping, W_half = entries_first(damping, 0, axes), root(entries_first(weights, 1, axes))
    q_dot, N = np.zeros((n, *batch)), np.eye(n).reshape(n, n, *[1] * axes)
    for k, (J_k, x_k) in enumerate(pairs):
        J, x_dot = entries_first(J_k, 2, axes) / W_half, entries_first(x_k, 1, axes)
        finite(f'J of task {k} and weights', norm(J))
        values, least = svd(product(J, N)), cutoff * norm(J)
        J_N_plus, N_k = values.damped_inverse(damping, least), values.projector(damping, least)
        # q_dot += N (J N)^+ (x_dot - J q_dot), N = N N_k
        q_dot += times(N, times(J_N_plus, x_dot - times(J, q_dot)))
        N = product(N, N_k)
    q_dot = entries_last(q_dot / W_half, 1)
    finite('result of tasks, damping and weights', q_dot)
    return q_dot if max_velocity is None else limit_velocity(q_dot, max_velocity)


def _checked(tasks: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[Array, Array]]:
    """Check a list of tasks."""
    try:
        pairs = [(J, x_dot) for J, x_dot in tasks]
    except (TypeError, ValueError):
        raise ValueError(f'tasks must be pairs (J, x_dot), got {short(tasks, repr)}') from None
    if not pairs:
        raise ValueError('tasks must contain at least one (J, x_dot), got none')
    checked = []
    for k, (J, x_dot) in enumerate(pairs):
        jacobian = array(f'J of task {k}', J, 'm', 'n')
        checked.append((jacobian, array(f'x_dot of task {k}', x_dot, jacobian.shape[-2])))
    joints = [J.shape[-1] for J, _ in checked]
    if len(set(joints)) > 1:
        raise ValueError(f'tasks must all be about the same joints, got Jacobians with {joints} columns')
    return checked
