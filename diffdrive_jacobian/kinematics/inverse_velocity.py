"""Joint velocities from task velocities, for every Jacobian: square, redundant, singular.

Model: `x_dot = J q_dot`, J of shape (..., m, n), m task velocities and n joint velocities, in whatever
units J has. Everything broadcasts over leading axes. Wrong shapes, shapes that do not broadcast and
values that are not finite raise ValueError.

**Damping.** Without it a task is done as well as the Jacobian allows, however fast the joints must move
for it. With the damping lambda > 0 joint velocities are bounded and continuous in J. The task is then
done by the factor `s^2 / (s^2 + lambda^2)` along each singular vector.

**Null space.** Near a loss of rank a projector is either strict or continuous: `I - J^+ J` jumps where a
singular value s becomes 0. Here, with `J = sum s_i u_i v_i^T`,

    N = I - sum_i f_i v_i v_i^T,    f_i = 1 without damping, min(s_i / (FILTER lambda), 1) with damping.

So null-space velocities do not disturb the task, `J N = 0`, without damping, and with damping wherever
each singular value is 0 or at least `FILTER lambda`, a tenth of lambda. Elsewhere
`|J N q_dot_0| <= FILTER lambda / 4 |q_dot_0|`, and N is continuous in J:
`|dN| <= sqrt(2) / (FILTER lambda) |dJ|` in the Frobenius norm.

**Weights.** Joint i counts with the weight w_i > 0: solutions are least in `sum_i w_i q_dot_i^2`, so a
joint with a larger weight moves less. In the formulas and bounds J then stands for `J W^-1/2` and q_dot
for `W^1/2 q_dot`, and lambda has the units of `J W^-1/2`.

Source: document A, 3.2.1 and 3.2.5; document C, "Redundancy and singularity" and "Contact constraints";
document D, 3; doc/mathematics.md, "Manipulators". Filtering by singular direction: A. A.
Maciejewski, C. A. Klein, "Numerical filtering for the operation of robotic manipulators through
kinematically singular configurations", 1988. Weights: D. E. Whitney, "Resolved motion rate control of
manipulators and human prostheses", 1969; B. Siciliano et al., *Robotics: Modelling, Planning and
Control*, 2009, 3.5.1. Without damping a singular value counts as zero if it is below
`CUTOFF max(m, n)` times the largest one.
"""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics import _singular_values
from diffdrive_jacobian.kinematics._adjugate import EPS, adjugate, refuse_singular
from diffdrive_jacobian.kinematics._singular_values import CUTOFF, FILTER, joint_velocities
from diffdrive_jacobian.kinematics._task_checks import (
    checked_damping,
    checked_task,
    finite_result,
    weighted,
)
from diffdrive_jacobian.kinematics.secondary_tasks import (
    joint_limit_cost,
    joint_limit_gradient,
    manipulability,
    manipulability_gradient,
)
from diffdrive_jacobian.kinematics.task_priority import limit_velocity, prioritized
from diffdrive_jacobian.numerics.checks import array, leading, not_negative, positive
from diffdrive_jacobian.numerics.elementary import agree, matrix, operand

__all__ = [
    'CUTOFF',
    'FILTER',
    'adjugate_inverse',
    'damped_least_squares',
    'damping',
    'joint_limit_cost',
    'joint_limit_gradient',
    'limit_velocity',
    'manipulability',
    'manipulability_gradient',
    'null_space_projector',
    'prioritized',
    'pseudoinverse',
    'redundant',
]

Array = NDArray[np.float64]


def adjugate_inverse(J: ArrayLike) -> Array:
    """Invert by the adjugate: `J^-1 = [[d, -b], [-c, a]] / det(J)` (A, 3.2.1).

    Args:
        J: Jacobians `[[a, b], [c, d]]`, shape (..., 2, 2). (With larger ones the adjugate loses digits
            that `numpy.linalg.inv` keeps.)

    Returns:
        The inverses, same shape.

    Raises:
        LinAlgError: A Jacobian is singular to working precision: the entries of an inverse would be
            rounding errors. The message contains its determinant.
        ValueError: J has another shape.
    """
    J = array('J', J, 2, 2)
    if J.ndim == 2:
        (a, b), (c, d) = J.tolist()
        if 1e-50 < max(abs(a), abs(b), abs(c), abs(d)) < 1e50:
            single = a * d - b * c
            if abs(single) > 4.0 * EPS * (a * a + b * b + c * c + d * d):
                return matrix(2, 2, d / single, -b / single, -c / single, a / single)
    # By powers of two, so that neither products overflow nor digits are lost.
    _, exponent = np.frexp(np.abs(J).max(axis=(-2, -1)))
    scaled = np.ldexp(J, -exponent[..., np.newaxis, np.newaxis])
    determinant = scaled[..., 0, 0] * scaled[..., 1, 1] - scaled[..., 0, 1] * scaled[..., 1, 0]
    # The condition number is |J|^2 / |det| (in the norm of Frobenius).
    singular = np.abs(determinant) <= 4.0 * EPS * np.einsum('...ij,...ij->...', scaled, scaled)
    regular = np.where(singular, 1.0, determinant)[..., np.newaxis, np.newaxis]
    with np.errstate(over='ignore', under='ignore'):
        inverse: Array = np.ldexp(adjugate(scaled) / regular, -exponent[..., np.newaxis, np.newaxis])
        # Also where the inverse would be larger than any number.
        refuse_singular(
            np.ldexp(determinant, 2 * exponent), singular | ~np.isfinite(inverse).all(axis=(-2, -1))
        )
    return inverse


def pseudoinverse(J: ArrayLike, *, weights: ArrayLike | None = None) -> Array:
    """Return the Moore-Penrose pseudo-inverse J^+ (A, C), or the weighted one.

    Where J is singular, `J^+ x_dot` minimises `|x_dot - J q_dot|`. Where it is redundant, `|q_dot|`, or
    with weights `sum_i w_i q_dot_i^2`: `W^-1/2 (J W^-1/2)^+`.

    Args:
        J: Jacobians, shape (..., m, n).
        weights: Weights of the joints, positive, shape (..., n). None: all 1.

    Returns:
        The pseudo-inverses, shape (..., n, m). With weights infinite where they overflow.

    Raises:
        ValueError: `J W^-1/2` overflows.
    """
    J = array('J', J, 'm', 'n')
    if weights is None:
        return _singular_values.pseudoinverse(J)
    scaled, roots = weighted(J, weights)
    with np.errstate(over='ignore'):
        inverse: Array = _singular_values.pseudoinverse(scaled) / roots[..., np.newaxis]
    return inverse


def damping(manipulability: ArrayLike, threshold: ArrayLike, maximum: ArrayLike) -> Array:
    """Return a lambda that grows as the manipulability falls: `lambda_max (1 - w / w_0)`, or 0 (A).

    Args:
        manipulability: w, zero or positive, shape (...).
        threshold: w_0, below which there is damping, positive, shape (...), in the units of w.
        maximum: lambda_max, the damping of a singular Jacobian, zero or positive, shape (...).

    Returns:
        lambda, shape (...), in the units of J: not squared (Nakamura and Hanafusa 1986 square it).
    """
    w: Any = manipulability
    w_0: Any = threshold
    most: Any = maximum
    single = (
        type(w) is type(w_0) is type(most) is float
        and (w >= 0.0 < w_0 and most >= 0.0)
        and isfinite(w + w_0 + most)
    )
    if not single:
        w, w_0 = operand('manipulability', w, not_negative), operand('threshold', w_0, positive)
        most = operand('maximum', most, not_negative)
        single = agree(manipulability=w, threshold=w_0, maximum=most)
    if single:
        return np.asarray(most * (1.0 - (w / w_0 if w < w_0 else 1.0)))
    w, w_0 = np.broadcast_arrays(w, w_0)
    return np.asarray(most * (1.0 - np.divide(w, w_0, out=np.ones(w.shape), where=w < w_0)))


def damped_least_squares(
    J: ArrayLike, x_dot: ArrayLike, damping: ArrayLike, *, weights: ArrayLike | None = None
) -> Array:
    """Return bounded joint velocities: `J^T (J J^T + lambda^2 I)^-1 x_dot` (A).

    `|q_dot| <= |x_dot| / (2 lambda)` for every J. With lambda = 0 this is `J^+ x_dot`. It is computed
    from singular vectors and values, so that no digits are lost to `J J^T`.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        damping: lambda, zero or positive, in the units of J, shape (...).
        weights: Weights of the joints, positive, shape (..., n). None: all 1.

    Returns:
        Joint velocities, shape (..., n). Infinite where they overflow.

    Raises:
        ValueError: `J W^-1/2` overflows.
    """
    J, x_dot = checked_task(J, x_dot)
    factor = checked_damping(damping)
    if weights is None:
        leading(J=J.shape[:-2], x_dot=x_dot.shape[:-1], damping=factor.shape)
        return joint_velocities(J, x_dot, factor)
    scaled, roots = weighted(J, weights)
    leading(J=scaled.shape[:-2], x_dot=x_dot.shape[:-1], damping=factor.shape)
    q_dot = joint_velocities(scaled, x_dot, factor)
    with np.errstate(over='ignore'):
        return np.asarray(q_dot / roots)


def null_space_projector(
    J: ArrayLike, damping: ArrayLike = 0.0, *, weights: ArrayLike | None = None
) -> Array:
    """Return the projector to joint velocities that do not move the task: `N = I - J^+ J` (A, C).

    Without damping `J N = 0` and `N N = N`, its rank n less the rank of J. With damping N is continuous
    in J and leaks where singular values are below `FILTER lambda`, see the module.

    Args:
        J: Jacobians, shape (..., m, n).
        damping: lambda, zero or positive, in the units of J, shape (...).
        weights: Weights of the joints, positive, shape (..., n). None: all 1.

    Returns:
        N, shape (..., n, n), symmetric. With weights `W N` is symmetric.

    Raises:
        ValueError: With weights, `J W^-1/2` or N overflows.
    """
    J, factor = array('J', J, 'm', 'n'), checked_damping(damping)
    if weights is None:
        leading(J=J.shape[:-2], damping=factor.shape)
        return _singular_values.null_space_projector(J, factor)
    scaled, roots = weighted(J, weights)
    leading(J=scaled.shape[:-2], damping=factor.shape)
    projector = _singular_values.null_space_projector(scaled, factor)
    with np.errstate(over='ignore'):
        oblique: Array = projector * roots[..., np.newaxis, :] / roots[..., np.newaxis]
    finite_result('J and weights', 'projector', oblique)
    return oblique


def redundant(
    J: ArrayLike,
    x_dot: ArrayLike,
    q_dot_0: ArrayLike,
    damping: ArrayLike = 0.0,
    *,
    weights: ArrayLike | None = None,
) -> Array:
    """Do a task, and come near to secondary joint velocities: `J^+ x_dot + N q_dot_0` (A, C).

    With damping, damped least squares takes the place of J^+, and N is the `null_space_projector` with
    the same damping. The secondary velocity then moves the task by at most `lambda / 40 |q_dot_0|`, and
    not at all while no singular value is between 0 and `lambda / 10`.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        q_dot_0: Secondary joint velocities, shape (..., n).
        damping: lambda, zero or positive, in the units of J, shape (...).
        weights: Weights of the joints, positive, shape (..., n). None: all 1. To go uphill along the
            gradient of a function with them, divide the gradient by the weights.

    Returns:
        Joint velocities, shape (..., n): with `q_dot_0 = 0` the least ones. Infinite where they
        overflow.

    Raises:
        ValueError: `J W^-1/2` or `W^1/2 q_dot_0` overflows.
    """
    J, x_dot = checked_task(J, x_dot)
    secondary, factor = array('q_dot_0', q_dot_0, J.shape[-1]), checked_damping(damping)
    scaled, roots = (J, None) if weights is None else weighted(J, weights)
    leading(
        J=scaled.shape[:-2], x_dot=x_dot.shape[:-1], q_dot_0=secondary.shape[:-1], damping=factor.shape
    )
    if roots is None:
        return joint_velocities(J, x_dot, factor, secondary)
    with np.errstate(over='ignore'):
        secondary = secondary * roots
        finite_result('q_dot_0 and weights', 'product', secondary)
        return np.asarray(joint_velocities(scaled, x_dot, factor, secondary) / roots)
