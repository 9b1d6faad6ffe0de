"""From the velocity of the task back to that of the joints, for every Jacobian: square, redundant,
singular, and for several tasks in the order of their priority.

Model: `x_dot = J q_dot`, J of shape (..., m, n), m task velocities and n joint velocities, in whatever
units J has. Everything broadcasts over leading axes. Wrong shapes, shapes that do not broadcast and
values that are not finite raise ValueError.

Source: document A, 3.2.1 and 3.2.5; document C, "Redundancy and singularity" and "Contact constraints";
document D, 3; MATH.md, "Manipulators and inverse velocity". A singular value counts as zero if it is
below `CUTOFF max(m, n)` times the largest one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._adjugate import adjugate, refuse_singular
from diffdrive_jacobian.kinematics._checks import array, floats, leading, not_negative, number, positive

CUTOFF = 1e-15
_EPSILON = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
"""What is smaller has no inverse that is a number."""
_STEP = _EPSILON ** (1.0 / 3.0)
"""Of central differences: where rounding and truncation are alike."""

Array = NDArray[np.float64]


def adjugate_inverse(J: ArrayLike) -> Array:
    """Invert by the adjugate: `J^-1 = [[d, -b], [-c, a]] / det(J)` (A, 3.2.1).

    Args:
        J: Jacobians `[[a, b], [c, d]]`, shape (..., 2, 2). (With larger ones the adjugate loses digits
            that `numpy.linalg.inv` keeps.)

    Returns:
        The inverses, same shape.

    Raises:
        LinAlgError: A Jacobian is singular to working precision: what an inverse would hold is
            rounding error. The message gives its determinant.
        ValueError: J has another shape.
    """
    J = array('J', J, 2, 2)
    # By powers of two, so that neither products overflow nor digits are lost.
    _, exponent = np.frexp(np.abs(J).max(axis=(-2, -1)))
    scaled = np.ldexp(J, -exponent[..., np.newaxis, np.newaxis])
    determinant = scaled[..., 0, 0] * scaled[..., 1, 1] - scaled[..., 0, 1] * scaled[..., 1, 0]
    # The condition number is |J|^2 / |det| (in the norm of Frobenius).
    singular = np.abs(determinant) <= 4.0 * _EPSILON * _dot(scaled, scaled).sum(axis=-1)
    regular = np.where(singular, 1.0, determinant)[..., np.newaxis, np.newaxis]
    with np.errstate(over='ignore', under='ignore'):
        inverse: Array = np.ldexp(adjugate(scaled) / regular, -exponent[..., np.newaxis, np.newaxis])
        # Also where the inverse would be larger than any number.
        refuse_singular(
            np.ldexp(determinant, 2 * exponent), singular | ~np.isfinite(inverse).all(axis=(-2, -1))
        )
    return inverse


def pseudoinverse(J: ArrayLike) -> Array:
    """Give the Moore-Penrose pseudo-inverse J^+ (A, C).

    Where J is singular, `J^+ x_dot` minimises `|x_dot - J q_dot|`; where it is redundant, `|q_dot|`.

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        The pseudo-inverses, shape (..., n, m).
    """
    J = array('J', J, 'm', 'n')
    left, values, right = np.linalg.svd(J, full_matrices=False)
    gains = _gains(values, np.zeros_like(values), J.shape[-2:])
    inverse: Array = np.swapaxes(right, -1, -2) * gains[..., np.newaxis, :] @ np.swapaxes(left, -1, -2)
    return inverse


def manipulability(J: ArrayLike) -> Array:
    """Give Yoshikawa's measure of how far from singular a Jacobian is: `w = sqrt(det(J J^T))` (A, D).

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        w, shape (...): the product of the singular values, 0 where J is singular; also where it has
        more rows than columns, for then some velocity cannot be produced.
    """
    J = array('J', J, 'm', 'n')
    rows, columns = J.shape[-2:]
    if rows > columns:
        return np.zeros(J.shape[:-2])

    def by_svd(J: Array) -> Array:
        with np.errstate(over='ignore', under='ignore'):
            return np.asarray(np.linalg.svd(J, compute_uv=False).prod(axis=-1))

    return by_svd(J) if rows != 2 else _each(_minors, by_svd, (J, 2))


def damping(manipulability: ArrayLike, threshold: ArrayLike, maximum: ArrayLike) -> Array:
    """Give a lambda that grows as the manipulability falls: `lambda_max (1 - w / w_0)`, at least 0 (A).

    Args:
        manipulability: w, zero or positive, shape (...).
        threshold: w_0, below which damping sets in, positive, shape (...), in the units of w.
        maximum: lambda_max, that of a singular Jacobian, zero or positive, shape (...).

    Returns:
        lambda, shape (...), in the units of J: not squared (Nakamura and Hanafusa 1986 square it).
    """
    w, w_0 = floats('manipulability', manipulability), floats('threshold', threshold)
    most = floats('maximum', maximum)
    not_negative('manipulability', w)
    positive('threshold', w_0)
    not_negative('maximum', most)
    leading(manipulability=w.shape, threshold=w_0.shape, maximum=most.shape)
    w, w_0 = np.broadcast_arrays(w, w_0)
    return np.asarray(most * (1.0 - np.divide(w, w_0, out=np.ones(w.shape), where=w < w_0)))


def damped_least_squares(J: ArrayLike, x_dot: ArrayLike, damping: ArrayLike) -> Array:
    """Give joint velocities that stay bounded: `J^T (J J^T + lambda^2 I)^-1 x_dot` (A).

    `|q_dot| <= |x_dot| / (2 lambda)`, whatever J is. With lambda = 0 this is `J^+ x_dot`. It is computed
    from singular vectors and values, so that no digits are lost to `J J^T`.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Velocities of the task, shape (..., m).
        damping: lambda, zero or positive, in the units of J, shape (...).

    Returns:
        Joint velocities, shape (..., n).
    """
    J, x_dot = _task(J, x_dot)
    factor = floats('damping', damping)
    not_negative('damping', factor)
    leading(J=J.shape[:-2], x_dot=x_dot.shape[:-1], damping=factor.shape)
    if J.shape[-2] != 2:
        return _by_svd(J, x_dot, factor)
    return _each(_two_rows, _by_svd, (J, 2), (x_dot, 1), (factor, 0))


def null_space_projector(J: ArrayLike) -> Array:
    """Give what changes the joints and not the task: `N = I - J^+ J`, so that `J N = 0` (A, C).

    Args:
        J: Jacobians, shape (..., m, n).

    Returns:
        N, shape (..., n, n): symmetric, `N N = N`, its rank n less that of J.
    """
    J = array('J', J, 'm', 'n')
    return _projector(J, CUTOFF * max(J.shape[-2:]) * _largest(J))[1]


def manipulability_gradient(jacobian: Callable[[Array], ArrayLike], q: ArrayLike) -> Array:
    """Give how the manipulability changes with the joints: `dw / dq`, a motion away from singularities.

    By central differences, which are right to about ten digits; at a singular configuration, where w has
    an edge, they give the mean of both sides. As a secondary task:
    `redundant(J, x_dot, k * manipulability_gradient(arm.jacobian, q))`, k > 0 (A, 3.2.5).

    Args:
        jacobian: Gives the Jacobians, shape (..., m, n), of configurations of shape (..., n).
        q: Configurations, shape (..., n) (rad).

    Returns:
        The gradients, shape (..., n).
    """
    q = array('q', q, 'n')
    steps = _STEP * np.eye(q.shape[-1])
    around = q[..., np.newaxis, :]
    ahead, behind = (manipulability(jacobian(around + sign * steps)) for sign in (1.0, -1.0))
    if ahead.shape != q.shape:
        raise ValueError(
            f'jacobian must give one Jacobian for each configuration, shape (*{q.shape}, m, n), got '
            f'manipulabilities of shape {ahead.shape}'
        )
    gradient: Array = (ahead - behind) / (2.0 * _STEP)
    return gradient


def joint_limit_cost(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Give how far joints are from the middle of their ranges: `1/(2n) sum(((q - middle) / range)^2)`.

    Source: A. Liegeois, "Automatic supervisory control of the configuration and behavior of multibody
    mechanisms", 1977; A names it as a use of the null space (3.2.5).

    Args:
        q: Joint angles, shape (..., n) (rad).
        lower: Lower limits, shape (..., n), or one for all joints (rad).
        upper: Upper limits, above the lower ones, shape (..., n), or one for all joints (rad).

    Returns:
        The cost, shape (...): 0 in the middle, 1/8 with every joint at a limit.
    """
    away, _ = _from_the_middle(q, lower, upper)
    cost: Array = (away * away).mean(axis=-1) / 2.0
    return cost


def joint_limit_gradient(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Give the gradient of `joint_limit_cost`, which points towards the limits.

    As a secondary task: `redundant(J, x_dot, -k * joint_limit_gradient(q, lower, upper))`, k > 0.

    Args:
        q: Joint angles, shape (..., n) (rad).
        lower: Lower limits, shape (..., n), or one for all joints (rad).
        upper: Upper limits, above the lower ones, shape (..., n), or one for all joints (rad).

    Returns:
        The gradients, shape (..., n) (1/rad).
    """
    away, span = _from_the_middle(q, lower, upper)
    gradient: Array = away / (span * away.shape[-1])
    return gradient


def redundant(J: ArrayLike, x_dot: ArrayLike, q_dot_0: ArrayLike, damping: ArrayLike = 0.0) -> Array:
    """Do a task, and come near to other joint velocities: `J^+ x_dot + N q_dot_0` (A, C).

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Velocities of the task, shape (..., m).
        q_dot_0: Joint velocities that are wished for besides, shape (..., n).
        damping: lambda of damped least squares, in the place of J^+, shape (...).

    Returns:
        Joint velocities, shape (..., n): with `q_dot_0 = 0` the least ones.
    """
    J, x_dot = _task(J, x_dot)
    wish = array('q_dot_0', q_dot_0, J.shape[-1])
    leading(J=J.shape[:-2], x_dot=x_dot.shape[:-1], q_dot_0=wish.shape[:-1])
    # J^+ (x_dot - J q_dot_0) + q_dot_0, which needs no projector.
    missing = x_dot - (J @ wish[..., np.newaxis])[..., 0]
    return wish + damped_least_squares(J, missing, damping)


def prioritized(tasks: Sequence[tuple[ArrayLike, ArrayLike]], *, cutoff: float = 1e-9) -> Array:
    """Do tasks in the order of their priority, each as well as those before it allow (C).

    `q_dot += N (J_k N)^+ (x_k - J_k q_dot)`, then `N -= (J_k N)^+ (J_k N)`, from `q_dot = 0` and
    `N = I`. Constraints such as contacts that must not move come first, with the velocity 0.

    Args:
        tasks: `(J_k, x_k_dot)`, the most important first, shapes (..., m_k, n) and (..., m_k).
        cutoff: What a task asks of joints that are not free is dropped: singular values of `J_k N` below
            this, relative to the norm of J_k. Larger than rounding error; the smaller, the faster may
            joints have to move to do tasks that nearly conflict.

    Returns:
        Joint velocities, shape (..., n).

    Raises:
        ValueError: There is no task, something is no pair, or the numbers of joints differ.
    """
    cutoff = number('cutoff', cutoff, positive)
    if cutoff >= 1.0:
        raise ValueError(f'cutoff must be below 1, got {cutoff}')
    try:
        pairs = [(J, x_dot) for J, x_dot in tasks]
    except (TypeError, ValueError):
        raise ValueError(f'tasks must be pairs (J, x_dot), got {tasks!r:.60}') from None
    if not pairs:
        raise ValueError('tasks must hold at least one (J, x_dot), got none')
    read = [
        _task(J, x_dot, f'J of task {index}', f'x_dot of task {index}')
        for index, (J, x_dot) in enumerate(pairs)
    ]
    joints = [J.shape[-1] for J, _ in read]
    if len(set(joints)) > 1:
        raise ValueError(f'tasks must all be about the same joints, got Jacobians with {joints} columns')
    batch = leading(
        **{f'task {index} J': J.shape[:-2] for index, (J, _) in enumerate(read)},
        **{f'task {index} x_dot': x_dot.shape[:-1] for index, (_, x_dot) in enumerate(read)},
    )
    q_dot, free = (
        np.zeros((*batch, joints[0])),
        np.broadcast_to(np.eye(joints[0]), (*batch,) + (joints[0],) * 2),
    )
    for J, x_dot in read:
        inverse, left_over = _projector(J @ free, cutoff * _largest(J))
        missing = x_dot - (J @ q_dot[..., np.newaxis])[..., 0]
        q_dot = q_dot + (free @ (inverse @ missing[..., np.newaxis]))[..., 0]
        free = free @ left_over
    return q_dot


def _dot(one: Array, other: Array) -> Array:
    product: Array = np.einsum('...i,...i->...', one, other)
    return product


def _largest(J: Array) -> Array:
    """Give the largest singular value, shape (...)."""
    return np.asarray(np.linalg.norm(J, ord=2, axis=(-2, -1)))


def _each(
    usual: Callable[..., Array],
    careful: Callable[..., Array],
    *arguments: tuple[Array, int],
) -> Array:
    """Treat each Jacobian the usual way, unless squares would overflow or vanish: then carefully. So
    what becomes of one does not depend on its company.

    Args:
        usual: Of arguments with the same leading axes, or with some that broadcast.
        careful: Likewise.
        arguments: Each with the number of its last axes that belong to one robot; the first is J.
    """
    J, _ = arguments[0]
    with np.errstate(over='ignore', under='ignore'):
        squares = _dot(J, J).sum(axis=-1)
    moderate = (squares > 1e-60) & (squares < 1e60)
    if moderate.all():
        return usual(*(one for one, _ in arguments))
    batch = np.broadcast_shapes(*(one.shape[: one.ndim - own] for one, own in arguments))
    own_shapes = [one.shape[one.ndim - own :] for one, own in arguments]
    flat = [
        np.broadcast_to(one, (*batch, *shape)).reshape(-1, *shape)
        for (one, _), shape in zip(arguments, own_shapes, strict=True)
    ]
    which = np.broadcast_to(moderate, batch).reshape(-1)
    parts = [(rows, way) for rows, way in ((which, usual), (~which, careful)) if rows.any()]
    given = [(rows, way(*(one[rows] for one in flat))) for rows, way in parts]
    whole = np.empty((len(which), *given[0][1].shape[1:]))
    for rows, values in given:
        whole[rows] = values
    return whole.reshape((*batch, *whole.shape[1:]))


def _minors(J: Array) -> Array:
    """Give the manipulability of two rows: the root of the sum of all squared minors (Cauchy and Binet),
    which loses no digits.
    """
    squares: Any = 0.0
    for i in range(J.shape[-1]):
        for j in range(i):
            minor = J[..., 0, i] * J[..., 1, j] - J[..., 0, j] * J[..., 1, i]
            squares = squares + minor * minor
    return np.asarray(np.sqrt(squares))


def _by_svd(J: Array, x_dot: Array, damping: Array) -> Array:
    """Damped least squares by singular vectors and values."""
    left, values, right = np.linalg.svd(J, full_matrices=False)
    along = (x_dot[..., np.newaxis, :] @ left)[..., 0, :]
    gains = _gains(values, damping[..., np.newaxis], J.shape[-2:])
    q_dot: Array = ((gains * along)[..., np.newaxis, :] @ right)[..., 0, :]
    return q_dot


def _task(
    J: ArrayLike, x_dot: ArrayLike, name_J: str = 'J', name_x_dot: str = 'x_dot'
) -> tuple[Array, Array]:
    J = array(name_J, J, 'm', 'n')
    x_dot = array(name_x_dot, x_dot, J.shape[-2])
    leading(**{name_J: J.shape[:-2], name_x_dot: x_dot.shape[:-1]})
    return J, x_dot


def _gains(values: Array, damping: Array, shape: tuple[int, ...]) -> Array:
    """Give s / (s^2 + lambda^2); without damping 1/s, and 0 for what counts as zero."""
    least = CUTOFF * max(shape) * values.max(axis=-1, keepdims=True)
    kept = (values > _TINY) & ((damping > 0.0) | (values > least))
    safe = np.where(kept, values, 1.0)
    with np.errstate(over='ignore', under='ignore'):
        return np.where(kept, 1.0 / (safe + damping * (damping / safe)), 0.0)


def _two_rows(J: Array, x_dot: Array, damping: Array) -> Array:
    """Damped least squares of two rows, in closed form: a turn of the task's plane makes the rows
    orthogonal, and so singular vectors (Jacobi, one-sided). Many times as fast as LAPACK on batches.
    """
    # Column by column, for loops over the short last axis take longer.
    columns: list[tuple[Any, Any]] = [(J[..., 0, k], J[..., 1, k]) for k in range(J.shape[-1])]
    one, other = x_dot[..., 0], x_dot[..., 1]
    for _ in range(2):  # the second turn mends the rounding of the first where J is nearly singular
        first, second, both = _products(columns)
        angle = 0.5 * np.arctan2(2.0 * both, first - second)
        c, s = np.cos(angle), np.sin(angle)
        one, other = c * one + s * other, c * other - s * one
        columns = [(c * a + s * b, c * b - s * a) for a, b in columns]
    first, second, _ = _products(columns)
    values = np.stack([np.sqrt(first), np.sqrt(second)], axis=-1)
    weights = _gains(values, damping[..., np.newaxis], J.shape[-2:])
    weights /= np.where(values > 0.0, values, 1.0)
    one, other = weights[..., 0] * one, weights[..., 1] * other
    return np.stack([one * a + other * b for a, b in columns], axis=-1)


def _products(columns: Sequence[tuple[Any, Any]]) -> tuple[Any, Any, Any]:
    """Give the squares of two rows, and their product."""
    return (
        sum(a * a for a, _ in columns),
        sum(b * b for _, b in columns),
        sum(a * b for a, b in columns),
    )


def _projector(J: Array, least: Array) -> tuple[Array, Array]:
    """Give J^+ and I - J^+ J, with singular values up to `least` counted as zero."""
    left, values, right = np.linalg.svd(J, full_matrices=False)
    kept = values > np.maximum(least, _TINY)[..., np.newaxis]
    gains = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    columns = np.swapaxes(right, -1, -2)
    inverse = columns * gains[..., np.newaxis, :] @ np.swapaxes(left, -1, -2)
    projector = np.eye(J.shape[-1]) - columns * kept[..., np.newaxis, :] @ right
    return inverse, projector


def _from_the_middle(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    """Give the way of each joint from the middle of its range, relative to that range, and the range."""
    q = array('q', q, 'n')
    lower, upper = (array(name, value) for name, value in (('lower', lower), ('upper', upper)))
    for name, value in (('lower', lower), ('upper', upper)):
        if value.shape[-1:] not in ((), q.shape[-1:]):
            raise ValueError(f'{name} must have shape () or (..., {q.shape[-1]}), got {value.shape}')
    leading(q=q.shape, lower=lower.shape, upper=upper.shape)
    span = upper - lower
    if not (span > 0.0).all():
        raise ValueError(f'upper must be above lower for every joint, got {upper} and {lower}')
    return (q - (lower + upper) / 2.0) / span, span
