"""Steps of `levenberg_marquardt` for a single target in floats: several times as fast as a batch of one.

They are those of `_ik_search`, as long as nothing but a step is needed: no joint at a limit, no end of a
search, no second derivatives. The search goes on from there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_jacobian.kinematics._ik_task import EPS, Floats, Task, returned
from diffdrive_jacobian.kinematics._singular_values import joint_velocities

if TYPE_CHECKING:
    from diffdrive_jacobian.kinematics._ik_search import Outcome, Search, _Open


def take_steps(
    search: Search, still: _Open, found: Outcome, steps: int, stationary: float
) -> tuple[_Open, int]:
    """Take up to so many steps towards the only target that is open, and store them in `found`.

    Returns:
        The state after them, and how many were tried.
    """
    q, J, count = still.q, still.J[0], 0
    e, (error,), (factor,) = still.e[0].tolist(), still.error.tolist(), still.factor.tolist()
    (which,) = still.which.tolist()
    while count < steps and error > search.tolerance:
        columns = list(zip(*J.tolist(), strict=True))
        squares = [_dot(column, column) for column in columns]
        gradient = [_dot(column, e) for column in columns]
        if not math.isfinite(sum(squares)) or not any(
            abs(slope) > stationary * (math.sqrt(square) * error)
            for slope, square in zip(gradient, squares, strict=True)
        ):
            break
        tried = q + joint_velocities(J, np.array(e), np.asarray(math.sqrt(factor)))
        (here,), (there,) = q.tolist(), tried.tolist()
        by = [b - a for a, b in zip(here, there, strict=True)]
        slope, length = _dot(by, gradient), math.sqrt(_dot(by, by))
        predicted = slope + factor * (length * length)
        if (
            length <= max(EPS * math.sqrt(_dot(here, here)), search.step_tolerance)
            or not predicted > 4.0 * EPS * (error * error)
            or not _inside(search.task, here)
            or not _inside(search.task, there)
        ):
            break
        e_tried = _error(search.task, tried, which)
        tried_error = math.sqrt(_dot(e_tried, e_tried))
        if not math.isfinite(tried_error):
            break
        count += 1
        change = (tried_error - error) * (tried_error + error)
        least = EPS * sum(squares)
        if change < 0.0:
            # The power by products: one of floats raises an error where it overflows.
            by_gain = 2.0 * (-change / predicted) - 1.0
            factor = max(factor * max(1.0 / 3.0, 1.0 - by_gain * by_gain * by_gain), least)
            q, e, error = tried, e_tried, tried_error
            found.lowered[which] = count
            if error > search.tolerance:
                J = search.task.jacobians(q)[0]
        else:
            factor = max(4.0 * factor, least)
    found.q[which], found.error[which], found.iterations[which] = q[0], error, count
    state = still._replace(
        q=q.copy(),
        e=np.array([e]),
        error=np.array([error]),
        J=J[np.newaxis].copy(),
        factor=np.array([factor]),
    )
    return state, count


def _inside(task: Task, joints: list[float]) -> bool:
    """Return whether joints are finite, and none of them is at a limit."""
    if not math.isfinite(sum(joints)):
        return False
    if task.limits is None:
        return True
    lower, upper = (side.tolist() for side in task.limits)
    return all(low < joint < high for low, joint, high in zip(lower, joints, upper, strict=True))


def _error(task: Task, q: Floats, which: int) -> list[float]:
    """Return the weighted errors, NaN if forward is not finite."""
    target = task.targets[which : which + 1]
    pose = returned('forward', task.forward(q.copy()), target.shape, q)
    if not all(map(math.isfinite, pose.tolist()[0])):
        return [math.nan]
    difference = returned('difference', task.difference(target.copy(), pose), pose.shape, q)
    entries: list[float] = task.weighted(difference)[0].tolist()
    return entries


def _dot(a: list[float] | tuple[float, ...], b: list[float] | tuple[float, ...]) -> float:
    total = 0.0
    for first, second in zip(a, b, strict=True):
        total += first * second
    return total
