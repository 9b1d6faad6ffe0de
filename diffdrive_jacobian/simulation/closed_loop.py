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

"""Closed loops in batches: thousands of unicycles under a control law, simulated together.

The loop is that of go_to_goal and virtual_robot: at each sample of the control rate a robot has arrived,
or its law returns a body twist `[v, omega]` (m/s, rad/s), which is saturated and applied until the next
one. Starts, goals, gains, robots and limits broadcast; the batch is their leading axes.

Source: doc/mathematics.md, "Motion" and "Control laws".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_jacobian.control.controller import Controller, Law
from diffdrive_jacobian.control.waypoints import Arrival
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import function
from diffdrive_jacobian.simulation.actuators import IDEAL, Actuators
from diffdrive_jacobian.simulation.rollout import NO_LIMITS, Array, Keep, Loops, Outcomes, Rollout, Rows

BLOCK = 8192
"""Number of robots that are advanced together; their states fit into the processor's cache."""
MAX_SAMPLES = 1e9
"""Largest number of samples that are kept, in 40 GB, and while they are put in order in 72 GB."""


class Trajectories(NamedTuple):
    """All k + 1 samples of every robot. A robot that has arrived stands still.

    Attributes:
        times: Shape (k + 1,) (s).
        poses: Shape (k + 1, ..., 3): time first, then the batch.
        twists: `[v, omega]` as commanded at each sample until the next, shape (k, ..., 2) (m/s, rad/s).
        outcomes: Outcome of each robot, as `closed_loops` returns it.
    """

    times: Array
    poses: Array
    twists: Array
    outcomes: Outcomes


def closed_loops(
    law: Law | Controller | str,
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
    actuators: Actuators = IDEAL,
    progress: Callable[[int], object] | None = None,
    on_step: Callable[[int], object] | None = None,
) -> Outcomes:
    """Drive every robot to its goal and return the outcomes. Memory does not grow with the duration.

    Args:
        law: The control law, `law(poses, goals, *gains)`, or a `Controller`, or its name, one of
            `control.controller_names()`.
        starts: Poses, shape (..., 3).
        goals: Positions or poses, shape (..., 2) or (..., 3), as the law requires.
        gains: Further arguments of the law, each of shape (...). None for a `Controller`: its defaults.
        rate: Control rate (Hz).
        duration: Time after which a robot is given up (s).
        arrival: Arrival criterion. If the heading counts (`use_heading=True`), a robot that has reached
            its position turns in place. None: the defaults of `Arrival`, for a Controller with the
            heading if it takes one, and with the point that it drives.
        turning_gain: Gain of the turn in place, shape (...) (1/s).
        limits: Velocity limits.
        r: Wheel radius, shape (...) (m).
        L: Wheel separation, shape (...) (m).
        actuators: How all robots follow commands: limits of the acceleration, lag and delay. A robot
            that has arrived then rolls on until it is at rest or the duration ends. By default they
            follow at once.
        progress: Called from time to time with the number of robots that are finished.
        on_step: Called with that number at every step of every block of robots. An exception that it
            raises ends the batch and is passed on.

    Returns:
        The outcomes. A robot that its law drives away has not arrived; this raises no error.

    Raises:
        ValueError: An argument has a wrong shape or value, the law returns something invalid, or an
            outcome overflows.
    """
    loops = Loops(
        law=law,  # type: ignore[arg-type]
        starts=starts,
        goals=goals,
        gains=gains,
        rate=rate,
        duration=duration,
        arrival=arrival,
        turning_gain=turning_gain,
        limits=limits,
        r=r,
        L=L,
        actuators=actuators,
    )
    if progress is not None:
        function('progress', progress)
    if on_step is not None:
        function('on_step', on_step)
    return _drive(loops, None, progress, on_step)


def trajectories(
    law: Law | Controller | str, starts: ArrayLike, goals: ArrayLike, *gains: ArrayLike, **settings: Any
) -> Trajectories:
    """Drive every robot to its goal and return every sample until the last robot is finished.

    Arguments and errors are those of `closed_loops`, without `progress` and `on_step`.
    """
    try:
        loops = Loops(law=law, starts=starts, goals=goals, gains=gains, **settings)  # type: ignore[arg-type]
    except TypeError as error:
        raise TypeError(str(error).replace('Loops.__init__', 'trajectories')) from None
    count = loops.columns.starts.shape[1]
    if (loops.steps + 1) * count > MAX_SAMPLES:
        raise ValueError(
            f'duration must be shorter, because at most {MAX_SAMPLES:g} samples are kept, '
            f'got {loops.duration:g} with {count} robots'
        )
    poses = np.empty((loops.steps + 1, count, 3))
    twists = np.zeros((loops.steps, count, 2))
    last = np.zeros(count, dtype=np.intp)

    def keep(step: int, rows: Rows, at: Array, v: Any, omega: Any) -> None:
        poses[step, rows], last[rows] = at, step
        if v is not None:
            twists[step, rows, 0], twists[step, rows, 1] = v, omega

    outcomes = _drive(loops, keep)
    steps = int(max(last, default=0))
    held = np.minimum(np.arange(steps + 1)[:, np.newaxis], last)
    poses = poses[held, np.arange(count)]
    return Trajectories(
        np.arange(steps + 1) / loops.rate,
        poses.reshape(steps + 1, *loops.shape, 3),
        twists[:steps].reshape(steps, *loops.shape, 2),
        outcomes,
    )


def _drive(
    loops: Loops,
    keep: Keep | None,
    progress: Callable[[int], object] | None = None,
    on_step: Callable[[int], object] | None = None,
) -> Outcomes:
    """Drive a batch block by block and return its outcomes."""
    columns = loops.columns
    if hasattr(loops.law.law, 'formula'):
        # The law checks its arguments, the equation does not.
        try:
            state = {'state': np.array(loops.law.state), 'dt': 0.0} if loops.law.state else {}
            loops.law.law(columns.starts.T, columns.goals.T, *columns.gains, **state)
        except (TypeError, ValueError) as error:
            raise ValueError(f'law rejects the starts, goals and gains: {error}') from error
    count = loops.columns.starts.shape[1]
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
        for finished, values in Rollout(loops, rows).drive(keep, at_step):
            for field, value in zip(found, values, strict=True):
                field[finished] = value
            done += len(finished)
            if progress is not None:
                progress(done)
    return Outcomes._make(field.reshape((*loops.shape, *field.shape[1:])) for field in found)
