"""Gains of a control law swept over a grid, as one batch of closed loops."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival, go_to_goal, go_to_pose
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.simulation import RobotModel, closed_loops
from diffdrive_jacobian.simulation._batch import Law, Outcomes
from diffdrive_jacobian.simulation._block import LOST

Array = NDArray[np.float64]

CONTROLLERS: dict[str, Law] = {'go_to_goal': go_to_goal, 'pose': go_to_pose}
"""As the parameter `controller` of go_to_goal; offset_point has no kp."""
MEASURES = ('time', 'path_length', 'overshoot')
"""Fields of `Outcomes` that are drawn and written."""
COLUMNS = (
    *('kp_per_s', 'kv_per_s', 'starts', 'arrived', 'time_mean_s', 'time_max_s'),
    *('path_length_mean_m', 'path_length_max_m', 'overshoot_mean_m', 'overshoot_max_m'),
)
"""Of a CSV file."""
MIN_GAIN, MAX_GAIN = 1e-3, 100.0
"""The nodes take no larger ones (1/s)."""
MIN_LIMIT = 1e-6
"""Nothing moves slower (m/s, rad/s)."""
MAX_LOOPS, MAX_SAMPLES = 1_000_000, 10_000_000_000
"""More would need too much memory, or time."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What is swept, and how.

    Raises:
        ValueError: Something cannot be; the message names it.
    """

    controller: str = 'go_to_goal'
    """One of `CONTROLLERS`."""
    kp: tuple[float, float] = (0.2, 6.0)
    """First and last gain on the heading error (1/s)."""
    kv: tuple[float, float] = (0.1, 3.0)
    """First and last gain on the distance (1/s)."""
    grid: int = 59
    """How many gains there are of each; 59: steps of 0.1 and 0.05."""
    starts: int = 12
    """From how many poses each pair of gains is tried."""
    distance: float = 2.0
    """How far the starts are from the goal (m)."""
    rate: float = 50.0
    """How often the law is asked (Hz)."""
    duration: float = 60.0
    """After how long a robot is given up (s)."""
    tolerance: float = 0.02
    """Distance that counts as arrived (m)."""
    robot: RobotModel = field(default_factory=RobotModel)
    """Its wheels and limits count."""

    def __post_init__(self) -> None:
        """Check every value, and that all together can be computed."""
        if self.controller not in CONTROLLERS:
            raise ValueError(
                f'controller must be one of {", ".join(CONTROLLERS)}, got {self.controller!r}'
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
                f'grid {self.grid} with {self.starts} starts makes {self.loops} closed loops; at most '
                f'{MAX_LOOPS} are swept, for they need up to a gigabyte of memory'
            )
        if self.loops * self.duration * self.rate > MAX_SAMPLES:
            raise ValueError(
                f'{self.loops} closed loops of {self.duration:g} s at {self.rate:g} Hz have more than '
                f'{MAX_SAMPLES} samples, which may take an hour: choose a smaller grid, fewer starts, '
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
                raise ValueError(
                    f'{name} must have {self.grid} values that can be told apart, got {first} {last}'
                )

    @property
    def loops(self) -> int:
        """How many closed loops that makes."""
        return self.grid**2 * self.starts

    @property
    def arrival(self) -> Arrival:
        """What counts as arrived."""
        return Arrival(xy_tolerance=self.tolerance, use_heading=self.controller == 'pose')

    def gains(self, name: str) -> Array:
        """Give the gains `kp` or `kv`, evenly spaced, as decimals that people write (1/s)."""
        first, last = self.kp if name == 'kp' else self.kv
        return np.asarray(np.linspace(first, last, self.grid).round(9), dtype=np.float64)

    def poses(self) -> Array:
        """Give the starts, shape (starts, 3): evenly around the goal, which lies at the origin.

        The heading errors are spread evenly, too, in another order. They stand a quarter of their
        spacing off zero: a law treats left and right alike, so what counts is the size of the error,
        and so these sizes are all different and spread evenly between 0 and 180 degrees.
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
    """What became of every pair of gains, from every start."""

    setup: Setup
    kp: Array
    """Shape (n,) (1/s)."""
    kv: Array
    """Shape (n,) (1/s)."""
    outcomes: Outcomes
    """Shape (n, n, starts): kv, kp, starts."""

    @property
    def arrived(self) -> NDArray[np.int_]:
        """How many starts arrived, shape (n, n): kv, kp."""
        return np.asarray(np.count_nonzero(self.outcomes.arrived, axis=-1))

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Where all starts arrived, shape (n, n): kv, kp."""
        return np.asarray(self.outcomes.arrived.all(axis=-1))

    def mean(self, measure: str) -> Array:
        """Give the mean over the starts that arrived, shape (n, n): kv, kp; NaN: none has."""
        arrived = self.outcomes.arrived
        total = np.where(arrived, getattr(self.outcomes, measure), 0.0).sum(axis=-1)
        return np.asarray(total / np.where(self.arrived > 0, self.arrived, np.nan))

    def largest(self, measure: str) -> Array:
        """Give the largest of the starts that arrived, shape (n, n): kv, kp; NaN: none has."""
        values = np.where(self.outcomes.arrived, getattr(self.outcomes, measure), -np.inf)
        return np.where(self.arrived > 0, values.max(axis=-1), np.nan)

    def fastest(self) -> tuple[int, int] | None:
        """Find the least mean time where all starts arrived, as indices of kv and kp; None: nowhere."""
        if not self.complete.any():
            return None
        best = int(np.argmin(np.where(self.complete, self.mean('time'), np.inf)))
        row, column = divmod(best, len(self.kp))
        return row, column


def sweep(setup: Setup, progress: Callable[[int], object] | None = None) -> Sweep:
    """Drive every pair of gains from every start to the goal.

    Args:
        setup: What is swept, and how.
        progress: Called at every step with the number of loops that are done. An exception that it
            raises ends the sweep and is passed on.

    Raises:
        ValueError: The robot cannot be, or its numbers overflow.
    """
    arrival = setup.arrival
    kp, kv = setup.gains('kp'), setup.gains('kv')
    gains = kp[np.newaxis, :, np.newaxis], kv[:, np.newaxis, np.newaxis]
    outcomes = closed_loops(
        # The law itself: a wrapper of it would not be recognized as one that has a faster form.
        CONTROLLERS[setup.controller],
        setup.poses(),
        np.zeros(3 if arrival.use_heading else 2),
        *gains,
        rate=setup.rate,
        duration=setup.duration,
        arrival=arrival,
        turning_gain=gains[0],
        limits=setup.robot.limits,
        r=setup.robot.wheel_radius,
        L=setup.robot.wheel_separation,
        on_step=progress,
    )
    return Sweep(setup, kp, kv, outcomes)


def table(swept: Sweep) -> str:
    """Give a sweep as CSV, one row for each pair of gains, `COLUMNS`; empty: no start arrived."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    kv, kp = np.meshgrid(swept.kv, swept.kp, indexing='ij')
    starts = np.full(kp.shape, swept.setup.starts)
    measured = [of(measure) for measure in MEASURES for of in (swept.mean, swept.largest)]
    columns = [kp, kv, starts, swept.arrived, *measured]
    # By kp first.
    for row in zip(*(column.T.ravel().tolist() for column in columns), strict=True):
        writer.writerow(['' if value != value else repr(value) for value in row])
    return text.getvalue()


def describe(swept: Sweep) -> str:
    """Say in one line which gains are the fastest."""
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
