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

"""Joint velocities from task velocities, for every Jacobian: square, redundant, singular.

Model: `x_dot = J q_dot`, Jacobians J of shape (..., m, n), task velocities x_dot of shape (..., m) and
joint velocities q_dot of shape (..., n), in whatever units J has. Everything broadcasts over leading
axes. Wrong shapes, shapes that do not broadcast, values that are not finite, and results that overflow
raise ValueError.

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

**Manipulability.** With `J = U diag(s) V^T`, joint velocities of norm 1 give task velocities on an
ellipsoid with the semi-axes `s_i u_i`. Yoshikawa's measure, the product of the s_i, is its volume but
for a constant factor. The smallest singular value and the condition number describe its shape. Joint
torques of norm 1 balance forces on the ellipsoid with the semi-axes `u_i / s_i`: where an arm is slow it
is strong. All measures depend on the units of J: scale its rows and columns before metres are compared
with radians, or joints that have different limits.

**Secondary tasks** are gradients over the configuration q. A mobile manipulator's inputs are fewer than
its coordinates: with its `configuration_jacobian` G the gradient over the inputs is `G^T gradient`.

**Weights.** Joint i counts with the weight w_i > 0: solutions are least in `sum_i w_i q_dot_i^2`, so a
joint with a larger weight moves less. In the formulas and bounds J then stands for `J W^-1/2` and q_dot
for `W^1/2 q_dot`, and lambda has the units of `J W^-1/2`.

Without damping a singular value counts as zero if it is below `CUTOFF max(m, n)` times the largest one.
One below 1e-150 always does, because its square has no digits.

Source: document A, 3.2.1 and 3.2.5; document C, "Redundancy and singularity" and "Contact constraints";
document D, 3; doc/mathematics.md, "Manipulators". Filtering by singular direction: A. A. Maciejewski, C.
A. Klein, "Numerical filtering for the operation of robotic manipulators through kinematically singular
configurations", 1988. Weights: D. E. Whitney, "Resolved motion rate control of manipulators and human
prostheses", 1969; B. Siciliano et al., *Robotics: Modelling, Planning and Control*, 2009, 3.5.1.
Priorities: B. Siciliano, J.-J. Slotine, "A general framework for managing multiple tasks in highly
redundant robotic systems", 1991. Manipulability: T. Yoshikawa, "Manipulability of robotic mechanisms",
1985. Joint limits: A. Liegeois, "Automatic supervisory control of the configuration and behavior of
multibody mechanisms", 1977.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics.differentiation import STEP
from diffdrive_jacobian.kinematics.singular_values import (
    CUTOFF,
    EPS,
    FILTER,
    column,
    norm,
    product,
    refuse_singular,
    root,
    svd,
    times,
)
from diffdrive_jacobian.numerics.checks import (
    array,
    finite,
    floats,
    leading,
    not_negative,
    number,
    positive,
    positive_or_infinite,
    shaped,
    short,
)
from diffdrive_jacobian.numerics.elementary import minimum
from diffdrive_jacobian.numerics.formula import (
    Array,
    Number,
    Rows,
    Scalar,
    Vector,
    entries_first,
    entries_last,
    formula,
)

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

    For `J = [[a, b], [c, d]]`, shape (..., 2, 2). (With larger ones the adjugate loses digits that
    `numpy.linalg.inv` keeps.) One that is singular to working precision raises LinAlgError with its
    determinant: the entries of an inverse would be rounding errors.
    """
    (a, b), (c, d) = J
    determinant = a * d - b * c
    # The condition number is |J|^2 / |det| (in the norm of Frobenius).
    square = a * a + b * b + c * c + d * d
    if not np.isfinite(square).all():
        raise OverflowError('|J|^2 must be finite')
    refuse_singular(determinant, abs(determinant) <= 4.0 * EPS * square + TINY)
    return [
        [d / determinant, -b / determinant],
        [-c / determinant, a / determinant],
    ]


@formula('(m,n),(n) -> (n,m)', weights=positive)
def pseudoinverse(J: Any, *, weights: Vector = None) -> Array:
    """Return the Moore-Penrose pseudo-inverse J^+ (A, C), or the weighted one.

    Where J is singular, `J^+ x_dot` minimises `|x_dot - J q_dot|`. Where it is redundant, `|q_dot|`, or
    with weights, shape (..., n), `sum_i w_i q_dot_i^2`: `W^-1/2 (J W^-1/2)^+`. Shape (..., n, m).
    """
    W_half = root(weights)
    J_plus = svd(J / W_half).inverse()  # (J W^-1/2)^+
    return J_plus / column(W_half)  # W^-1/2 (J W^-1/2)^+


@formula('(m,n),(m),(m) -> (m,n),(m)', mask=not_negative)
def masked_task(J: Any, x_dot: Vector, mask: Vector) -> tuple[Array, Array]:
    """Weigh the entries of a task, or omit some: `sqrt(M) J` and `sqrt(M) x_dot`.

    An arm with fewer joints than entries of the task can only control some of them (D, 2.2). The result
    is a task for all functions of this module, with rows of zeros for omitted entries. They then
    minimise `e^T M e` with the error `e = x_dot - J q_dot`: `damped_least_squares(*masked_task(J, x_dot,
    mask), damping)`. The mask is the diagonal of M, zero or positive, shape (..., m). Zero omits an
    entry.
    """
    M_half = root(mask)
    return column(M_half) * J, M_half * x_dot  # sqrt(M) J, sqrt(M) x_dot


@formula('(),(),() -> ()', manipulability=not_negative, threshold=positive, maximum=not_negative)
def damping(manipulability: Number, threshold: Number, maximum: Number) -> Scalar:
    """Return a lambda that grows as the manipulability falls: `lambda_max (1 - w / w_0)`, or 0.

    Document A asks for such a lambda without a formula. It has the units of J (Nakamura and Hanafusa
    1986 square it). The manipulability w and the largest lambda, that of a singular Jacobian, are zero
    or positive; the threshold w_0, below which there is damping, is positive; each of shape (...).
    """
    return maximum * (1.0 - minimum(manipulability / threshold, 1.0))


@formula('(m,n),(m),(),(n) -> (n)', damping=not_negative, weights=positive)
def damped_least_squares(J: Any, x_dot: Vector, damping: Number, *, weights: Vector = None) -> Array:
    """Return bounded joint velocities: `J^T (J J^T + lambda^2 I)^-1 x_dot` (A).

    `|q_dot| <= |x_dot| / (2 lambda)` for every J. With lambda = 0 this is `J^+ x_dot`. The damping
    lambda, shape (...), is zero or positive, in the units of J. Weights have the shape (..., n).
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
    in J and leaks where singular values are below `FILTER lambda`, see the module. N, shape (..., n, n),
    is symmetric; with weights, shape (..., n), `W N` is.
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
    the same damping. The secondary velocities q_dot_0, shape (..., n), then move the task by at most
    `lambda / 40 |q_dot_0|`, and not at all while no singular value is between 0 and `lambda / 10`. To go
    uphill along the gradient of a function with weights, shape (..., n), divide the gradient by them.
    """
    W_half = root(weights)
    J, q_dot_0 = J / W_half, W_half * q_dot_0  # J W^-1/2 and W^1/2 q_dot_0
    values = svd(J)
    J_damped = values.damped_inverse(damping)  # J^+, with damping J^T (J J^T + lambda^2 I)^-1
    N_q_dot_0 = values.projected(q_dot_0, damping)  # (I - J^+ J) q_dot_0, with damping filtered
    q_dot = times(J_damped, x_dot) + N_q_dot_0
    return q_dot / W_half


# --- Priorities


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

    From `q_dot = 0` and `N = I`, for each task: `q_dot += N (J_k N)^+ (x_k_dot - J_k q_dot)`, then `N =
    N N_k` with the projector `N_k` of `J_k N`. Constraints such as contacts that must not move come
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
    damping = entries_first(damping, 0, axes)
    W_half = root(None if weights is None else entries_first(weights, 1, axes))
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


# --- Manipulability


@formula('(m,n) -> ()')
def manipulability(J: Any) -> Scalar:
    """Return Yoshikawa's distance of a Jacobian from singular: `w = sqrt(det(J J^T))`.

    It is the product of the singular values, shape (...), 0 where J is singular. Also 0 where it has
    more rows than columns, because some velocities cannot be produced then.
    """
    if len(J) == 2:
        # Cauchy and Binet: det(J J^T) is the sum of the squared minors. `hypot` squares none that
        # overflows or vanishes.
        minors = [a * d - b * c for (a, c), (b, d) in combinations(zip(*J, strict=True), 2)]
        return np.asarray(reduce(np.hypot, minors, 0.0))
    # And the product of the squared singular values.
    s = np.linalg.svd(np.moveaxis(J, (0, 1), (-2, -1)), compute_uv=False)
    return np.asarray(s.prod(axis=-1) * (len(J) <= len(J[0])))


def manipulability_gradient(jacobian: Callable[[Array], ArrayLike], q: ArrayLike) -> Array:
    """Return the gradient of the manipulability, `dw / dq`: a motion away from singularities.

    It is computed by central differences, which are accurate to about ten digits. At a singular
    configuration, where w is not differentiable, they return the mean of both sides. As a secondary
    task: `redundant(J, x_dot, k * manipulability_gradient(arm.jacobian, q))`, k > 0 (A, 3.2.5).

    The function returns Jacobians, shape (..., m, inputs), of configurations, shape (..., n) (rad; the
    base of a mobile manipulator also m). The gradients have the shape (..., n).
    """
    q = array('q', q, 'n')
    steps = STEP * np.eye(q.shape[-1])
    around = q[..., np.newaxis, :]
    up, down = around + steps, around - steps
    above, below = manipulability(jacobian(up)), manipulability(jacobian(down))
    if np.shape(above) != q.shape:
        raise ValueError(
            f'jacobian must return one Jacobian for each configuration, shape (*{q.shape}, m, n), got '
            f'manipulabilities of shape {np.shape(above)}'
        )
    # The distance that is left after rounding.
    width = np.diagonal(up - down, axis1=-2, axis2=-1)
    return np.asarray((above - below) / np.where(width > 0.0, width, np.inf))


class Ellipsoid(NamedTuple):
    """An ellipsoid about zero.

    Attributes:
        directions: Directions of its axes, unit vectors in the columns of U, shape (..., m, m).
        semi_axes: Lengths of its semi-axes, shape (..., m). 0 or infinite in a singular direction.
    """

    directions: Array
    semi_axes: Array


def velocity_ellipsoid(J: ArrayLike) -> Ellipsoid:
    """Return the task velocities `J q_dot` of joint velocities with `|q_dot| <= 1`.

    For joints of different speeds give `J diag(q_dot_max)`. The axes are `s_i u_i`, the longest first. A
    semi-axis of 0 is a direction in which the task cannot move.
    """
    U, s = _axes(J)
    return Ellipsoid(U, s)


def force_ellipsoid(J: ArrayLike) -> Ellipsoid:
    """Return the forces W that joint torques `tau = J^T W` with `|tau| <= 1` balance.

    The axes are `u_i / s_i`, those of the velocity ellipsoid in the same order, the shortest first. A
    semi-axis is infinite where the structure carries the force without any torque.
    """
    U, s = _axes(J)
    with np.errstate(divide='ignore', over='ignore'):
        return Ellipsoid(U, 1.0 / s)


def smallest_singular_value(J: ArrayLike) -> Array:
    """Return the shortest semi-axis of the velocity ellipsoid, the speed in the slowest direction.

    s_m, shape (...), is 0 where J is singular or has more rows than columns.
    """
    _, s = _axes(J)
    return np.asarray(s[..., -1])


def condition_number(J: ArrayLike) -> Array:
    """Return the quotient of the longest and the shortest semi-axis of the velocity ellipsoid.

    `s_1 / s_m`, shape (...), is 1 for a sphere (isotropic) and infinite where J is singular.
    """
    _, s = _axes(J)
    largest, smallest = s[..., 0], s[..., -1]
    with np.errstate(all='ignore'):
        return np.where(smallest > 0.0, largest / smallest, np.inf)


def _axes(J: ArrayLike) -> tuple[Array, Array]:
    """Return U, shape (..., m, m), and the singular values, largest first, shape (..., m)."""
    J = array('J', J, 'm', 'n')
    m, n = J.shape[-2:]
    U, found, _ = np.linalg.svd(J)
    s = np.zeros((*J.shape[:-2], m))
    s[..., : min(m, n)] = np.where(found > CUTOFF * max(m, n) * found[..., :1], found, 0.0)
    return U, s


# --- Joint limits


@np.errstate(all='ignore')
def joint_limit_cost(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return how far joints are from the middle of their ranges: `1/(2n) sum(((q - middle) / range)^2)`.

    For joint angles q, shape (..., n), and limits `lower < upper` of the same shape, or one for all
    joints (rad), it has the shape (...): 0 in the middle, 1/8 with every joint at a limit.
    """
    q, middle, width = _ranges(q, lower, upper)
    cost = np.asarray(np.mean(((q - middle) / width) ** 2, axis=-1) / 2.0)
    finite('joint_limit_cost of q, lower and upper', cost)
    return cost


@np.errstate(all='ignore')
def joint_limit_gradient(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return the gradient of `joint_limit_cost`, which points towards the limits.

    Arguments as those of the cost. The result has the shape (..., n) (1/rad). As a secondary task:
    `redundant(J, x_dot, -k * joint_limit_gradient(q, lower, upper))`, k > 0 (A, 3.2.5).
    """
    q, middle, width = _ranges(q, lower, upper)
    gradient = np.asarray((q - middle) / width / (q.shape[-1] * width))
    finite('joint_limit_gradient of q, lower and upper', gradient)
    return gradient


@np.errstate(all='ignore')
def limit_velocity(q_dot: ArrayLike, max_velocity: ArrayLike) -> Array:
    """Scale joint velocities by the largest factor up to 1 with which no joint exceeds its limit.

    All are scaled alike. So every task keeps its direction, a task of velocity 0 is kept, and the result
    is continuous. The price: tasks of all priorities slow down, also those that do not need the joint at
    its limit. For q_dot, shape (..., n), and largest speeds, positive or infinite, of the same shape, or
    one for all joints, no entry of the result is larger than its limit, not even by rounding.
    """
    q_dot = array('q_dot', q_dot, 'n')
    most = _for_all_joints('max_velocity', max_velocity, q_dot.shape[-1])
    positive_or_infinite('max_velocity', most)
    leading(q_dot=q_dot.shape[:-1], max_velocity=most.shape[:-1])
    excess = np.max(np.abs(q_dot) / most, axis=-1, keepdims=True)
    finite('q_dot / max_velocity', excess)
    return np.asarray(np.clip(q_dot / np.maximum(excess, 1.0), -most, most))


def _ranges(q: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array, Array]:
    """Return checked joint angles, and the middle and the width of their ranges."""
    q = array('q', q, 'n')
    lower, upper = (
        _for_all_joints(name, value, q.shape[-1]) for name, value in (('lower', lower), ('upper', upper))
    )
    finite('lower', lower)
    finite('upper', upper)
    leading(q=q.shape[:-1], lower=lower.shape[:-1], upper=upper.shape[:-1])
    if not (upper > lower).all():
        raise ValueError(f'upper must be above lower for every joint, got {upper} and {lower}')
    width = upper - lower
    finite('upper - lower', width)
    return q, lower + width / 2.0, width


def _for_all_joints(name: str, value: ArrayLike, n: int) -> Array:
    """Return an array of shape (..., n). A single number is for all joints."""
    given = floats(name, value)
    return shaped(name, np.full(n, given) if given.ndim == 0 else given, n)
