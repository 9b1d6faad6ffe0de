"""Closed loops in batches: thousands of unicycles, each under a control law, at once.

Every robot is sampled at a rate. At each sample it either has arrived, or its law gives a body twist
`[v, omega]` (m/s, rad/s), which is held within the limits and driven along the exact arc until the next
one: the loop of go_to_goal and virtual_robot, without delay.

Starts, goals, gains, robots and limits broadcast with each other; the batch is their leading axes.

Source: MATH.md, "Motion of a virtual robot" and "Control laws".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control.arrival import Arrival
from diffdrive_jacobian.control.saturation import VelocityLimits
from diffdrive_jacobian.kinematics._checks import function
from diffdrive_jacobian.simulation._batch import Array, Batch, Law, Outcomes, Rows
from diffdrive_jacobian.simulation._block import Block, Keep, steered

BLOCK = 8192
"""Robots that are advanced together: as many as fit into the processor's cache."""
MAX_SAMPLES = 1e9
"""As many are kept: 40 GB."""
NO_LIMITS = VelocityLimits()


class Trajectories(NamedTuple):
    """Every sample of every robot, k + 1 of them; who has arrived stands still.

    Attributes:
        times: Shape (k + 1,) (s).
        poses: Shape (k + 1, ..., 3): time first, then the batch.
        twists: `[v, omega]` held from each sample to the next, shape (k, ..., 2) (m/s, rad/s).
        outcomes: What became of each robot, as `closed_loops` gives it.
    """

    times: Array
    poses: Array
    twists: Array
    outcomes: Outcomes


def closed_loops(
    law: Law,
    starts: ArrayLike,
    goals: ArrayLike,
    *gains: ArrayLike,
    rate: float = 50.0,
    duration: float = 60.0,
    arrival: Arrival | None = None,
    turning_gain: ArrayLike = 3.0,
    limits: VelocityLimits = NO_LIMITS,
    r: ArrayLike = 0.033,
    L: ArrayLike = 0.16,
    progress: Callable[[int], object] | None = None,
    on_step: Callable[[int], object] | None = None,
) -> Outcomes:
    """Drive every robot to its goal and tell what became of it; memory does not grow with the time.

    Args:
        law: The controller, `law(poses, goals, *gains)`.
        starts: Poses, shape (..., 3).
        goals: Positions or poses, shape (..., 2) or (..., 3), as the law wants them.
        gains: Whatever else the law takes, each of shape (...).
        rate: How often the law is asked (Hz).
        duration: After how long a robot is given up (s).
        arrival: What counts as having arrived, a `control.Arrival`; None: its defaults. If the heading
            counts (`use_heading=True`, as with go_to_pose), a robot that has reached its position turns
            in place. With the law offset_point give its offset, for the point arrives, not the axle.
        turning_gain: Gain of that turn, shape (...) (1/s).
        limits: What the drives can do.
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).
        progress: Called now and then with the number of robots that are done.
        on_step: Called with that number at every step of every block of robots, so that a computation
            can be interrupted: an exception that it raises ends the batch and is passed on.

    Returns:
        The outcomes. A law that drives a robot away has not arrived; nothing is raised.

    Raises:
        ValueError: An argument has a wrong shape or value, the law returns something that does not fit,
            or an outcome overflows.
    """
    batch = Batch.of(law, starts, goals, gains, rate, duration, arrival, turning_gain, limits, r, L)
    if progress is not None:
        function('progress', progress)
    if on_step is not None:
        function('on_step', on_step)
    return _drive(batch, None, progress, on_step)


def trajectories(
    law: Law,
    starts: ArrayLike,
    goals: ArrayLike,
    *gains: ArrayLike,
    rate: float = 50.0,
    duration: float = 60.0,
    arrival: Arrival | None = None,
    turning_gain: ArrayLike = 3.0,
    limits: VelocityLimits = NO_LIMITS,
    r: ArrayLike = 0.033,
    L: ArrayLike = 0.16,
) -> Trajectories:
    """Drive every robot to its goal and keep every sample, until the last one is done.

    Arguments and errors are those of `closed_loops`.
    """
    batch = Batch.of(law, starts, goals, gains, rate, duration, arrival, turning_gain, limits, r, L)
    if (batch.steps + 1) * batch.size > MAX_SAMPLES:
        raise ValueError(
            f'duration must be shorter, for at most {MAX_SAMPLES:g} samples are kept, got {duration:g} '
            f'with {batch.size} robots'
        )
    poses = np.empty((batch.steps + 1, batch.size, 3))
    twists = np.zeros((batch.steps, batch.size, 2))
    last = np.zeros(batch.size, dtype=np.intp)

    def keep(step: int, rows: Rows, at: Array, v: Any, omega: Any) -> None:
        poses[step, rows], last[rows] = at, step
        if v is not None:
            twists[step, rows, 0], twists[step, rows, 1] = v, omega

    outcomes = _drive(batch, keep)
    steps = int(max(last, default=0))
    held = np.minimum(np.arange(steps + 1)[:, np.newaxis], last)
    poses = poses[held, np.arange(batch.size)]
    return Trajectories(
        np.arange(steps + 1) / rate,
        poses.reshape(steps + 1, *batch.shape, 3),
        twists[:steps].reshape(steps, *batch.shape, 2),
        outcomes,
    )


def _drive(
    batch: Batch,
    keep: Keep | None,
    progress: Callable[[int], object] | None = None,
    on_step: Callable[[int], object] | None = None,
) -> Outcomes:
    """Drive a batch, block by block."""
    if steered(batch.law) is not None:
        # The laws of this package check their arguments, but not what `steered` evaluates.
        try:
            batch.law(batch.starts, batch.goals, *batch.gains)
        except ValueError as error:
            raise ValueError(f'law cannot take the starts, goals and gains: {error}') from error
    count = batch.size
    found = Outcomes(
        np.zeros(count, dtype=np.bool_),
        np.full(count, np.nan),
        np.zeros(count),
        np.zeros(count),
        np.zeros(count),
        np.empty((count, 3)),
    )
    done = 0
    at_step = None if on_step is None else lambda: on_step(done)
    for begin in range(0, count, BLOCK):
        rows = np.arange(begin, min(begin + BLOCK, count))
        for finished, values in Block(batch.some(rows), rows).drive(keep, at_step):
            for field, value in zip(found, values, strict=True):
                field[finished] = value
            done += len(finished)
            if progress is not None:
                progress(done)
    made = [field.reshape((*batch.shape, *field.shape[1:])) for field in found]
    return Outcomes._make(made)
