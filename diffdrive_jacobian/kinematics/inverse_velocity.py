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
`CUTOFF max(m, n)` times the largest one. One below 1e-150 always does, because its square has no digits.
"""

from __future__ import annotations

from typing import Any

from diffdrive_jacobian.kinematics.joint_limits import (
    joint_limit_cost,
    joint_limit_gradient,
    limit_velocity,
)
from diffdrive_jacobian.kinematics.manipulability import (
    Ellipsoid,
    condition_number,
    force_ellipsoid,
    manipulability,
    manipulability_gradient,
    smallest_singular_value,
    velocity_ellipsoid,
)
from diffdrive_jacobian.kinematics.singular_values import (
    CUTOFF,
    EPS,
    FILTER,
    column,
    refuse_singular,
    root,
    svd,
    times,
)
from diffdrive_jacobian.kinematics.task_priority import prioritized
from diffdrive_jacobian.numerics.checks import finite, not_negative, positive
from diffdrive_jacobian.numerics.elementary import minimum
from diffdrive_jacobian.numerics.formula import Array, Number, Rows, Vector, formula

__all__ = [
    'CUTOFF',
    'FILTER',
    'Ellipsoid',
    'adjugate_inverse',
    'condition_number',
    'damped_least_squares',
    'damping',
    'force_ellipsoid',
    'joint_limit_cost',
    'joint_limit_gradient',
    'limit_velocity',
    'manipulability',
    'manipulability_gradient',
    'masked_task',
    'null_space_projector',
    'prioritized',
    'pseudoinverse',
    'redundant',
    'smallest_singular_value',
    'velocity_ellipsoid',
]

TINY = 1e-290
"""Determinants up to this have lost digits to underflow."""


@formula('(2,2) -> (2,2)')
def adjugate_inverse(J: Any) -> Rows:
    """Invert by the adjugate: `J^-1 = [[d, -b], [-c, a]] / det(J)` (A, 3.2.1).

    Args:
        J: Jacobians `[[a, b], [c, d]]`, shape (..., 2, 2). (With larger ones the adjugate loses digits
            that `numpy.linalg.inv` keeps.)

    Returns:
        The inverses, same shape.

    Raises:
        LinAlgError: A Jacobian is singular to working precision: the entries of an inverse would be
            rounding errors. The message contains its determinant.
        ValueError: J has another shape, or its determinant overflows.
    """
    (a, b), (c, d) = J
    determinant = a * d - b * c
    # The condition number is |J|^2 / |det| (in the norm of Frobenius).
    square = a * a + b * b + c * c + d * d
    finite('|J|^2', square)
    refuse_singular(determinant, abs(determinant) <= 4.0 * EPS * square + TINY)
    return [
        [d / determinant, -b / determinant],
        [-c / determinant, a / determinant],
    ]


@formula('(m,n),(n) -> (n,m)', weights=positive)
def pseudoinverse(J: Any, *, weights: Vector = None) -> Array:
    """Return the Moore-Penrose pseudo-inverse J^+ (A, C), or the weighted one.

    Where J is singular, `J^+ x_dot` minimises `|x_dot - J q_dot|`. Where it is redundant, `|q_dot|`, or
    with weights `sum_i w_i q_dot_i^2`: `W^-1/2 (J W^-1/2)^+`.

    Args:
        J: Jacobians, shape (..., m, n).
        weights: Weights of the joints, positive, shape (..., n). None: all 1.

    Returns:
        The pseudo-inverses, shape (..., n, m).

    Raises:
        ValueError: `J W^-1/2` or the pseudo-inverse overflows.
    """
    W_half = root(weights)
    J_plus = svd(J / W_half).inverse()  # (J W^-1/2)^+
    return J_plus / column(W_half)  # W^-1/2 (J W^-1/2)^+


@formula('(m,n),(m),(m) -> (m,n),(m)', mask=not_negative)
def masked_task(J: Any, x_dot: Vector, mask: Vector) -> tuple[Array, Array]:
    """Weigh the entries of a task, or omit some: `sqrt(M) J` and `sqrt(M) x_dot`.

    An arm with fewer joints than entries of the task can only control some of them (D, 2.2). The result
    is a task for all functions of this module. They then minimise `e^T M e` with the error
    `e = x_dot - J q_dot`: `damped_least_squares(*masked_task(J, x_dot, mask), damping)`.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        mask: Weights of the entries, the diagonal of M, zero or positive, shape (..., m). Zero omits an
            entry.

    Returns:
        The Jacobians and the velocities, same shapes, with rows of zeros for omitted entries.
    """
    M_half = root(mask)
    return column(M_half) * J, M_half * x_dot  # sqrt(M) J, sqrt(M) x_dot


@formula('(),(),() -> ()', manipulability=not_negative, threshold=positive, maximum=not_negative)
def damping(manipulability: Number, threshold: Number, maximum: Number) -> Number:
    """Return a lambda that grows as the manipulability falls: `lambda_max (1 - w / w_0)`, or 0.

    Document A asks for such a lambda without a formula.

    Args:
        manipulability: w, zero or positive, shape (...).
        threshold: w_0, below which there is damping, positive, shape (...), in the units of w.
        maximum: lambda_max, the damping of a singular Jacobian, zero or positive, shape (...).

    Returns:
        lambda, shape (...), in the units of J: not squared (Nakamura and Hanafusa 1986 square it).
    """
    return maximum * (1.0 - minimum(manipulability / threshold, 1.0))


@formula('(m,n),(m),(),(n) -> (n)', damping=not_negative, weights=positive)
def damped_least_squares(J: Any, x_dot: Vector, damping: Number, *, weights: Vector = None) -> Array:
    """Return bounded joint velocities: `J^T (J J^T + lambda^2 I)^-1 x_dot` (A).

    `|q_dot| <= |x_dot| / (2 lambda)` for every J. With lambda = 0 this is `J^+ x_dot`.

    Args:
        J: Jacobians, shape (..., m, n).
        x_dot: Task velocities, shape (..., m).
        damping: lambda, zero or positive, in the units of J, shape (...).
        weights: Weights of the joints, positive, shape (..., n). None: all 1.

    Returns:
        Joint velocities, shape (..., n).

    Raises:
        ValueError: `J W^-1/2` or a joint velocity overflows.
    """
    W_half = root(weights)
    J = J / W_half  # J W^-1/2
    J_damped = svd(J).damped_inverse(damping)  # J^T (J J^T + lambda^2 I)^-1
    q_dot = times(J_damped, x_dot)
    return q_dot / W_half


@formula('(m,n),(),(n) -> (n,n)', damping=not_negative, weights=positive)
def null_space_projector(J: Any, damping: Number = 0.0, *, weights: Vector = None) -> Array:
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
        ValueError: `J W^-1/2` or N overflows.
    """
    W_half = root(weights)
    J = J / W_half  # J W^-1/2
    N = svd(J).projector(damping)  # I - J^+ J, with damping filtered
    return N * W_half / column(W_half)  # W^-1/2 N W^1/2


@formula('(m,n),(m),(n),(),(n) -> (n)', damping=not_negative, weights=positive)
def redundant(
    J: Any, x_dot: Vector, q_dot_0: Vector, damping: Number = 0.0, *, weights: Vector = None
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
        Joint velocities, shape (..., n): with `q_dot_0 = 0` the least ones.

    Raises:
        ValueError: `J W^-1/2` or a joint velocity overflows.
    """
    W_half = root(weights)
    J, q_dot_0 = J / W_half, W_half * q_dot_0  # J W^-1/2 and W^1/2 q_dot_0
    values = svd(J)
    J_damped = values.damped_inverse(damping)  # J^+, with damping J^T (J J^T + lambda^2 I)^-1
    N_q_dot_0 = values.projected(q_dot_0, damping)  # (I - J^+ J) q_dot_0, with damping filtered
    q_dot = times(J_damped, x_dot) + N_q_dot_0
    return q_dot / W_half
