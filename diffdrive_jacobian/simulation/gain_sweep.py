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

"""Sweeps of the gains of a controller over a grid, simulated as one batch of closed loops."""

from __future__ import annotations

import csv
import io
import math
import pickle
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival, Controller
from diffdrive_jacobian.control.controller import KP, Gain
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.numerics.checks import (
    Checked,
    Count,
    Positive,
    array,
    choices,
    instance,
    integer,
    short,
)
from diffdrive_jacobian.simulation import RobotModel, closed_loops
from diffdrive_jacobian.simulation.rollout import LOST, Outcomes

Array = NDArray[np.float64]

MEASURES = {'time': 's', 'path_length': 'm', 'overshoot': 'm'}
"""Fields of `Outcomes` that are drawn and written, and their units."""
_SUFFIXES = {'1/s': '_per_s', '': ''}
"""Units in names of columns."""
LOOPS_PER_TASK = 4096
"""Number of loops, at least a row of the grid, in one task of an executor. Fewer take longer each."""
MIN_LIMIT = 1e-6
"""Smallest velocity limit other than 0 (m/s, rad/s)."""
MAX_LOOPS, MAX_SAMPLES = 1_000_000, 10_000_000_000
"""Largest number of loops and of samples: more would need too much memory or time."""


@dataclass(frozen=True, kw_only=True)
class SweepSetup(Checked):
    """Settings of a sweep.

    Raises:
        ValueError: A value is invalid; the message names it.
        ControllerError: The controller cannot be loaded.
    """

    controller: str | Controller = 'go_to_goal'
    """A controller with at least two gains, or the name of one."""
    gains: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    """By name, the first and the last value of a gain that is swept, or the value of one that is not. Of
    the others the first are swept over their usual range, until two are; the rest has its default."""
    grid: Annotated[int, partial(integer, low=2)] = 59
    """Number of values of each gain; 59: steps of 0.1 and 0.05."""
    starts: Count = 12
    """Number of start poses for each pair of gains."""
    distance: Positive = 2.0
    """Distance of the starts from the goal (m)."""
    rate: Positive = 50.0
    """Control rate (Hz)."""
    duration: Positive = 60.0
    """Time after which a robot is given up (s)."""
    tolerance: Positive = 0.02
    """Distance that counts as arrived (m)."""
    robot: RobotModel = field(default_factory=RobotModel)
    """The robot; its wheels, limits and actuators are used."""

    def __post_init__(self) -> None:
        """Check every value, and that the sweep is not too large."""
        super().__post_init__()
        if not isinstance(self.controller, Controller) and self.controller not in CONTROLLERS:
            raise ValueError(f'controller must be {choices(CONTROLLERS)}, got {self.controller!r}')
        if self.loops > MAX_LOOPS:
            raise ValueError(
                f'grid {self.grid} with {self.starts} starts gives {self.loops} closed loops; at most '
                f'{MAX_LOOPS} are possible, because they need up to a gigabyte of memory'
            )
        self._check_gains()
        if not self.tolerance < self.distance < LOST:
            raise ValueError(
                f'distance must be larger than tolerance, {self.tolerance:g} m, and less than '
                f'{LOST:g} m, got {self.distance:g}'
            )
        small = [limit for limit in self.robot.limits.all() if 0.0 < abs(limit) < MIN_LIMIT]
        if small:
            raise ValueError(f'limits must be at least {MIN_LIMIT:g}, got {abs(small[0]):g}')
        if self.loops * self.duration * self.rate > MAX_SAMPLES:
            raise ValueError(
                f'{self.loops} closed loops of {self.duration:g} s at {self.rate:g} Hz have more than '
                f'{MAX_SAMPLES} samples, which may take an hour; choose a smaller grid, fewer starts, '
                'a shorter duration or a lower rate'
            )

    def _check_gains(self) -> None:
        """Check the names and the values of the gains."""
        controller = self.resolved_controller
        known = {gain.name: gain for gain in controller.gains}
        if len(known) < 2:
            raise ValueError(
                f'controller must have two gains to be swept, but {controller.name!r} has '
                f'{", ".join(known) or "none"}'
            )
        instance('gains', self.gains, Mapping)
        if unknown := self.gains.keys() - known.keys():
            raise ValueError(
                f'gains must be of {", ".join(known)}, those of {controller.name!r}, '
                f'got {", ".join(map(repr, sorted(unknown)))}'
            )
        given = {name: _gain_value(name, value) for name, value in self.gains.items()}
        object.__setattr__(self, 'gains', given)
        ranges = [name for name, value in given.items() if isinstance(value, tuple)]
        if len(ranges) > 2 or len(self.gains) - len(ranges) > len(known) - 2:
            raise ValueError(f'two gains must be swept, got ranges of {", ".join(ranges) or "none"}')
        for name, value in self.gains.items():
            ends = value if isinstance(value, tuple) else (value,)
            if len(ends) == 2 and not ends[0] < ends[1]:
                raise ValueError(f'{name} must be MIN MAX with MIN < MAX, got {value}')
            for end in ends:
                known[name].check(end)
        for gain in self.axes:
            if not (np.diff(self.values(gain)) > 0.0).all():
                raise ValueError(f'{gain.name} must have {self.grid} different values')

    @property
    def axes(self) -> tuple[Gain, Gain]:
        """The two gains that are swept, in the order of the law: along x, and along y."""
        gains = self.resolved_controller.gains
        swept = [gain for gain in gains if isinstance(self.gains.get(gain.name), tuple)]
        swept += [gain for gain in gains if gain.name not in self.gains]
        first, second = sorted(swept[:2], key=gains.index)
        return first, second

    def ends(self, gain: Gain) -> tuple[float, float]:
        """Return the first and the last value of a gain that is swept."""
        given = self.gains.get(gain.name)
        first, last = given if isinstance(given, tuple) else gain.usual
        return first, last

    def values(self, gain: Gain) -> Array:
        """Return the values of a gain that is swept, evenly spaced and rounded to 9 decimals."""
        return np.asarray(np.linspace(*self.ends(gain), self.grid).round(9), dtype=np.float64)

    @property
    def resolved_controller(self) -> Controller:
        """The controller; an installed one is imported."""
        if isinstance(self.controller, Controller):
            return self.controller
        return CONTROLLERS.find(self.controller)

    @property
    def loops(self) -> int:
        """Number of closed loops."""
        return self.grid**2 * self.starts

    @property
    def arrival(self) -> Arrival:
        """Arrival criterion."""
        controller = self.resolved_controller
        return Arrival(
            xy_tolerance=self.tolerance,
            use_heading=controller.takes_heading,
            offset=controller.driven_offset(SimpleNamespace(**self._numbers)),
        )

    @property
    def _numbers(self) -> dict[str, float]:
        """By name, the value of each gain, the default of one that is swept."""
        given = {name: value for name, value in self.gains.items() if not isinstance(value, tuple)}
        return {gain.name: given.get(gain.name, gain.default) for gain in self.resolved_controller.gains}

    def poses(self) -> Array:
        """Return the start poses, shape (starts, 3), evenly spaced around the goal at the origin.

        The heading errors are evenly spaced too, in another order, and shifted by a quarter of their
        spacing. Laws are symmetric in left and right, so only the magnitude of the error matters. With
        this shift all magnitudes are different and evenly spaced between 0 and 180 degrees.
        """
        number = self.starts
        golden = 0.618 * number
        step = min(
            (one for one in range(1, number + 1) if math.gcd(one, number) == 1),
            key=lambda one: abs(one - golden),
        )
        index = np.arange(number)
        bearing = math.tau * index / number
        error = math.tau * (index * step % number + 0.25) / number
        x, y = self.distance * np.cos(bearing), self.distance * np.sin(bearing)
        return np.column_stack([x, y, wrap_angle(bearing + math.pi - error)])


def _gain_value(name: str, value: object) -> float | tuple[float, float]:
    """Return a gain, or its range, as floats."""
    made = array(name, value)
    if made.shape not in ((), (2,)):
        raise ValueError(f'{name} must be a number or (MIN, MAX), got {short(value)}')
    if not made.ndim:
        return float(made)
    first, last = made.tolist()
    return first, last


class Sweep(NamedTuple):
    """Outcomes of every pair of gains from every start."""

    setup: SweepSetup
    x: Array
    """Values of the first gain that is swept, shape (n,)."""
    y: Array
    """Values of the second one, shape (n,)."""
    outcomes: Outcomes
    """Shape (n, n, starts): y, x, starts."""

    @property
    def arrived(self) -> NDArray[np.int_]:
        """Number of starts from which the robot arrived, shape (n, n): y, x."""
        return np.asarray(np.count_nonzero(self.outcomes.arrived, axis=-1))

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether the robot arrived from all starts, shape (n, n): y, x."""
        return np.asarray(self.outcomes.arrived.all(axis=-1))

    def mean(self, measure: str) -> Array:
        """Return the mean over the starts that arrived, shape (n, n): y, x; NaN: none arrived."""
        arrived = self.outcomes.arrived
        total = np.where(arrived, getattr(self.outcomes, measure), 0.0).sum(axis=-1)
        return np.asarray(total / np.where(self.arrived > 0, self.arrived, np.nan))

    def largest(self, measure: str) -> Array:
        """Return the maximum over the starts that arrived, shape (n, n): y, x; NaN: none arrived."""
        values = np.where(self.outcomes.arrived, getattr(self.outcomes, measure), -np.inf)
        return np.where(self.arrived > 0, values.max(axis=-1), np.nan)

    def fastest(self) -> tuple[int, int] | None:
        """Return the indices of y and x with the least mean time among those that arrived from all
        starts; None: there are none.
        """
        if not self.complete.any():
            return None
        best = int(np.argmin(np.where(self.complete, self.mean('time'), np.inf)))
        row, column = divmod(best, len(self.x))
        return row, column


def sweep(
    setup: SweepSetup,
    progress: Callable[[int], object] | None = None,
    *,
    executor: Executor | None = None,
) -> Sweep:
    """Drive the robot to the goal with every pair of gains from every start.

    Args:
        setup: Settings of the sweep.
        progress: Called at every step with the number of loops that are finished; with an executor
            whenever some rows are finished. An exception that it raises ends the sweep and is passed on.
        executor: Computes some rows of the grid at a time, for example a ProcessPoolExecutor, or
            `Client.get_executor()` of Dask; None: this thread alone. The result is the same bit for bit.

    Raises:
        ValueError: The law cannot be evaluated for arrays of poses, or outcomes overflow, or the
            controller cannot be sent to another process.
    """
    if executor is None:
        outcomes = _drive(setup, slice(None), progress)
    else:
        outcomes = _drive_on(executor, setup, progress)
    x, y = setup.axes
    return Sweep(setup, setup.values(x), setup.values(y), outcomes)


def _drive(setup: SweepSetup, rows: slice, progress: Callable[[int], object] | None = None) -> Outcomes:
    """Return the outcomes of some rows of the grid, shape (rows, n, starts)."""
    controller = setup.resolved_controller
    x, y = setup.axes
    values: dict[str, Any] = setup._numbers
    values[x.name] = setup.values(x)[np.newaxis, :, np.newaxis]
    values[y.name] = setup.values(y)[rows, np.newaxis, np.newaxis]
    gains = list(values.values())
    arrival = setup.arrival
    if controller.offset:
        arrival = replace(arrival, offset=values[controller.offset])
    starts, goal = setup.poses(), np.zeros(3 if controller.takes_heading else 2)
    return closed_loops(
        controller,
        starts,
        goal,
        *gains,
        rate=setup.rate,
        duration=setup.duration,
        arrival=arrival,
        turning_gain=values.get('kp', KP.default),
        limits=setup.robot.limits,
        r=min(setup.robot.radii),
        L=setup.robot.wheel_separation,
        actuators=setup.robot.actuators,
        on_step=progress,
    )


def _drive_on(
    executor: Executor, setup: SweepSetup, progress: Callable[[int], object] | None
) -> Outcomes:
    """Return the outcomes of all rows, computed by an executor."""
    try:
        pickle.dumps(setup)
    except Exception as error:
        raise ValueError(
            f'controller {setup.resolved_controller.name!r} cannot be sent to another process; give the '
            f'name of an installed one, or functions at the top level of a module: {error}'
        ) from error
    step = max(1, LOOPS_PER_TASK // (setup.grid * setup.starts))
    begins = range(0, setup.grid, step)
    futures = [executor.submit(_drive, setup, slice(begin, begin + step)) for begin in begins]
    parts: list[Outcomes] = []
    try:
        for future in futures:
            parts.append(future.result())
            if progress is not None:
                progress(sum(part.arrived.size for part in parts))
    finally:
        for future in futures:
            future.cancel()
    return Outcomes._make(np.concatenate(fields) for fields in zip(*parts, strict=True))


def columns(setup: SweepSetup) -> tuple[str, ...]:
    """Return the columns of the CSV table of a sweep."""
    gains = [f'{gain.name}{_SUFFIXES.get(gain.unit, "_" + gain.unit)}' for gain in setup.axes]
    measures = [f'{name}_{of}_{unit}' for name, unit in MEASURES.items() for of in ('mean', 'max')]
    return (*gains, 'starts', 'arrived', *measures)


def sweep_table(swept: Sweep) -> str:
    """Return a sweep as CSV, one row for each pair of gains, with `columns`; empty: no start arrived."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(columns(swept.setup))
    y, x = np.meshgrid(swept.y, swept.x, indexing='ij')
    starts = np.full(x.shape, swept.setup.starts)
    measured = [of(measure) for measure in MEASURES for of in (swept.mean, swept.largest)]
    # Sorted by the first gain, then by the second.
    entries = [x, y, starts, swept.arrived, *measured]
    for row in zip(*(one.T.ravel().tolist() for one in entries), strict=True):
        writer.writerow(['' if value != value else repr(value) for value in row])
    return text.getvalue()


def describe_sweep(swept: Sweep) -> str:
    """Return one line about the gains that are the fastest."""
    setup, found = swept.setup, swept.fastest()
    if found is None:
        return f'no gains bring the robot to the goal from every start within {setup.duration:g} s'
    row, column = found
    x, y = setup.axes
    edges = [
        f'{"least" if index == 0 else "largest"} {name}'
        for name, index in ((x.name, column), (y.name, row))
        if index in (0, setup.grid - 1)
    ]
    return (
        f'fastest: {x.name} {swept.x[column]:.4g}, {y.name} {swept.y[row]:.4g}'
        + (f' (the {" and the ".join(edges)} of the grid)' if edges else '')
        + f': at the goal after {swept.mean("time")[found]:.2f} s on average and '
        f'{swept.largest("time")[found]:.2f} s at most, by a path of '
        f'{swept.mean("path_length")[found]:.2f} m'
    )
