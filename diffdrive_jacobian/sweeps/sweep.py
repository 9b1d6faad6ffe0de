"""Sweeps of the gains of a controller over a grid, simulated as one batch of closed loops."""

from __future__ import annotations

import csv
import io
import math
import pickle
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival, Controller
from diffdrive_jacobian.control.controllers import BUILT_IN, CONTROLLERS
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.simulation import RobotModel, closed_loops
from diffdrive_jacobian.simulation._batch import Outcomes
from diffdrive_jacobian.simulation._block import LOST

Array = NDArray[np.float64]

SWEPT_GAINS = ('kp', 'kv')
"""Gains that a controller must have to be swept."""
MEASURES = ('time', 'path_length', 'overshoot')
"""Fields of `Outcomes` that are drawn and written."""
COLUMNS = (
    *('kp_per_s', 'kv_per_s', 'starts', 'arrived', 'time_mean_s', 'time_max_s'),
    *('path_length_mean_m', 'path_length_max_m', 'overshoot_mean_m', 'overshoot_max_m'),
)
"""Columns of the CSV table."""
LOOPS_PER_TASK = 4096
"""Number of loops, at least a row of the grid, in one task of an executor. Fewer take longer each."""
MIN_GAIN, MAX_GAIN = 1e-3, 100.0
"""Smallest and largest gain; the nodes accept no larger ones (1/s)."""
MIN_LIMIT = 1e-6
"""Smallest velocity limit other than 0 (m/s, rad/s)."""
MAX_LOOPS, MAX_SAMPLES = 1_000_000, 10_000_000_000
"""Largest number of loops and of samples: more would need too much memory or time."""


class SweptControllers(Collection[str]):
    """Names of the controllers that can be swept: those with the gains kp and kv.

    Of installed controllers the gains are unknown until they are imported, so all of them are included.
    """

    def __contains__(self, name: object) -> bool:
        """Return whether the controller of that name may be swept, without importing it."""
        if isinstance(name, str) and name in BUILT_IN:
            return _has_gains(BUILT_IN[name])
        return name in CONTROLLERS

    def __iter__(self) -> Iterator[str]:
        """Return the names, sorted."""
        return (name for name in CONTROLLERS if name in self)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(list(iter(self)))


def _has_gains(controller: Controller) -> bool:
    return set(SWEPT_GAINS) <= set(controller.gains)


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Settings of a sweep.

    Raises:
        ValueError: A value is invalid; the message names it.
        ControllerError: The controller cannot be loaded.
    """

    controller: str | Controller = 'go_to_goal'
    """A controller with the gains kp and kv, or the name of one."""
    kp: tuple[float, float] = (0.2, 6.0)
    """First and last gain on the heading error (1/s)."""
    kv: tuple[float, float] = (0.1, 3.0)
    """First and last gain on the distance (1/s)."""
    grid: int = 59
    """Number of values of each gain; 59: steps of 0.1 and 0.05."""
    starts: int = 12
    """Number of start poses for each pair of gains."""
    distance: float = 2.0
    """Distance of the starts from the goal (m)."""
    rate: float = 50.0
    """Control rate (Hz)."""
    duration: float = 60.0
    """Time after which a robot is given up (s)."""
    tolerance: float = 0.02
    """Distance that counts as arrived (m)."""
    offset: float = 0.1
    """X coordinate in the body frame of the driven point, for controllers that take it (m)."""
    robot: RobotModel = field(default_factory=RobotModel)
    """The robot; its wheels and limits are used."""

    def __post_init__(self) -> None:
        """Check every value, and that the sweep is not too large."""
        if not isinstance(self.controller, Controller):
            names = SweptControllers()
            if self.controller not in names:
                raise ValueError(
                    f'controller must be one of {", ".join(names)}, got {self.controller!r}'
                )
        if not _has_gains(self.resolved_controller):
            name, gains = self.resolved_controller.name, self.resolved_controller.gains
            raise ValueError(
                f'controller must have the gains kp and kv to be swept, but {name!r} has '
                f'{", ".join(gains) or "none"}'
            )
        for name, least in (('grid', 2), ('starts', 1)):
            if getattr(self, name) < least:
                raise ValueError(f'{name} must be at least {least}, got {getattr(self, name)}')
        for name in ('distance', 'rate', 'duration', 'tolerance'):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f'{name} must be positive and finite, got {getattr(self, name):g}')
        if not self.tolerance < self.distance < LOST:
            raise ValueError(
                f'distance must be larger than tolerance, {self.tolerance:g} m, and less than '
                f'{LOST:g} m, got {self.distance:g}'
            )
        small = [limit for limit in self.robot.limits.all() if 0.0 < abs(limit) < MIN_LIMIT]
        if small:
            raise ValueError(f'limits must be at least {MIN_LIMIT:g}, got {abs(small[0]):g}')
        if self.loops > MAX_LOOPS:
            raise ValueError(
                f'grid {self.grid} with {self.starts} starts gives {self.loops} closed loops; at most '
                f'{MAX_LOOPS} are possible, because they need up to a gigabyte of memory'
            )
        if self.loops * self.duration * self.rate > MAX_SAMPLES:
            raise ValueError(
                f'{self.loops} closed loops of {self.duration:g} s at {self.rate:g} Hz have more than '
                f'{MAX_SAMPLES} samples, which may take an hour; choose a smaller grid, fewer starts, '
                'a shorter duration or a lower rate'
            )
        for name in ('kp', 'kv'):
            first, last = self.kp if name == 'kp' else self.kv
            if not MIN_GAIN <= first < last <= MAX_GAIN:
                raise ValueError(
                    f'{name} must be MIN MAX with {MIN_GAIN:g} <= MIN < MAX <= {MAX_GAIN:g}, '
                    f'got {first:g} {last:g}'
                )
            if not (np.diff(self.gains(name)) > 0.0).all():
                raise ValueError(f'{name} must have {self.grid} different values, got {first} {last}')

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
            offset=self.offset if controller.offset else 0.0,
        )

    def gains(self, name: str) -> Array:
        """Return the values of `kp` or `kv`, evenly spaced and rounded to 9 decimals (1/s)."""
        first, last = self.kp if name == 'kp' else self.kv
        return np.asarray(np.linspace(first, last, self.grid).round(9), dtype=np.float64)

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


class Sweep(NamedTuple):
    """Outcomes of every pair of gains from every start."""

    setup: Setup
    kp: Array
    """Shape (n,) (1/s)."""
    kv: Array
    """Shape (n,) (1/s)."""
    outcomes: Outcomes
    """Shape (n, n, starts): kv, kp, starts."""

    @property
    def arrived(self) -> NDArray[np.int_]:
        """Number of starts from which the robot arrived, shape (n, n): kv, kp."""
        return np.asarray(np.count_nonzero(self.outcomes.arrived, axis=-1))

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether the robot arrived from all starts, shape (n, n): kv, kp."""
        return np.asarray(self.outcomes.arrived.all(axis=-1))

    def mean(self, measure: str) -> Array:
        """Return the mean over the starts that arrived, shape (n, n): kv, kp; NaN: none arrived."""
        arrived = self.outcomes.arrived
        total = np.where(arrived, getattr(self.outcomes, measure), 0.0).sum(axis=-1)
        return np.asarray(total / np.where(self.arrived > 0, self.arrived, np.nan))

    def largest(self, measure: str) -> Array:
        """Return the maximum over the starts that arrived, shape (n, n): kv, kp; NaN: none arrived."""
        values = np.where(self.outcomes.arrived, getattr(self.outcomes, measure), -np.inf)
        return np.where(self.arrived > 0, values.max(axis=-1), np.nan)

    def fastest(self) -> tuple[int, int] | None:
        """Return the indices of kv and kp with the least mean time among those that arrived from all
        starts; None: there are none.
        """
        if not self.complete.any():
            return None
        best = int(np.argmin(np.where(self.complete, self.mean('time'), np.inf)))
        row, column = divmod(best, len(self.kp))
        return row, column


def sweep(
    setup: Setup,
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
    return Sweep(setup, setup.gains('kp'), setup.gains('kv'), outcomes)


def _drive(setup: Setup, rows: slice, progress: Callable[[int], object] | None = None) -> Outcomes:
    """Return the outcomes of some rows of the grid, shape (rows, n, starts)."""
    controller = setup.resolved_controller
    values: dict[str, Any] = {
        'kp': setup.gains('kp')[np.newaxis, :, np.newaxis],
        'kv': setup.gains('kv')[rows, np.newaxis, np.newaxis],
        'offset': setup.offset,
    }
    gains = [values[name] for name in controller.gains]
    starts, goal = setup.poses(), np.zeros(3 if controller.takes_heading else 2)
    _check_law(controller, starts, goal, gains)
    return closed_loops(
        controller,
        starts,
        goal,
        *gains,
        rate=setup.rate,
        duration=setup.duration,
        arrival=setup.arrival,
        turning_gain=values['kp'],
        limits=setup.robot.limits,
        r=min(setup.robot.radii),
        L=setup.robot.wheel_separation,
        on_step=progress,
    )


def _drive_on(executor: Executor, setup: Setup, progress: Callable[[int], object] | None) -> Outcomes:
    """Return the outcomes of all rows, computed by an executor."""
    try:
        pickle.dumps(setup)
    except Exception as error:
        raise ValueError(
            f'controller {setup.resolved_controller.name!r} cannot be sent to another process; give the '
            f'name of an installed one, or functions at the top level of a module: {error}'
        ) from error
    row_loops = setup.grid * setup.starts
    step = max(1, LOOPS_PER_TASK // row_loops)
    slices = [slice(begin, begin + step) for begin in range(0, setup.grid, step)]
    futures = [executor.submit(_drive, setup, rows) for rows in slices]
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


def _check_law(controller: Controller, starts: Array, goal: Array, gains: list[Any]) -> None:
    """Evaluate a law once for all starts.

    Raises:
        ValueError: It raises an exception; laws for single poses do so when they are given arrays.
    """
    first = [float(np.ravel(gain)[0]) for gain in gains]
    goals = np.broadcast_to(goal, (len(starts), len(goal)))
    try:
        controller.law(starts, goals, *first)
    except Exception as error:
        raise ValueError(
            f'the law of controller {controller.name!r} must accept poses of shape '
            f'{starts.shape} to be swept, but failed: {type(error).__name__}: {error}'
        ) from error


def table(swept: Sweep) -> str:
    """Return a sweep as CSV, one row for each pair of gains, with `COLUMNS`; empty: no start arrived."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    kv, kp = np.meshgrid(swept.kv, swept.kp, indexing='ij')
    starts = np.full(kp.shape, swept.setup.starts)
    measured = [of(measure) for measure in MEASURES for of in (swept.mean, swept.largest)]
    columns = [kp, kv, starts, swept.arrived, *measured]
    # Sorted by kp, then by kv.
    for row in zip(*(column.T.ravel().tolist() for column in columns), strict=True):
        writer.writerow(['' if value != value else repr(value) for value in row])
    return text.getvalue()


def describe(swept: Sweep) -> str:
    """Return one line about the gains that are the fastest."""
    setup, found = swept.setup, swept.fastest()
    if found is None:
        return f'no gains bring the robot to the goal from every start within {setup.duration:g} s'
    row, column = found
    edges = [
        f'{"least" if index == 0 else "largest"} {name}'
        for name, index in (('kp', column), ('kv', row))
        if index in (0, setup.grid - 1)
    ]
    return (
        f'fastest: kp {swept.kp[column]:.4g}, kv {swept.kv[row]:.4g}'
        + (f' (the {" and the ".join(edges)} of the grid)' if edges else '')
        + f': at the goal after {swept.mean("time")[found]:.2f} s on average and '
        f'{swept.largest("time")[found]:.2f} s at most, by a path of '
        f'{swept.mean("path_length")[found]:.2f} m'
    )
