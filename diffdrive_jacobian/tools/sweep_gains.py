"""Sweep the gains of a control law over a grid, as one batch of closed loops: a picture and a table."""

from __future__ import annotations

import argparse
import csv
import errno
import importlib
import io
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Arrival, go_to_goal, go_to_pose
from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.nodes.parameters import VirtualRobotParameters
from diffdrive_jacobian.plots.output_files import FORMATS, create
from diffdrive_jacobian.ros.errors import UserError
from diffdrive_jacobian.ros.parameters import from_ros
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.simulation import RobotModel, closed_loops
from diffdrive_jacobian.simulation._batch import Law, Outcomes
from diffdrive_jacobian.simulation._block import LOST
from diffdrive_jacobian.tools import _cli, _sweep_figure
from diffdrive_jacobian.tools._params_file import robot_parameters
from diffdrive_jacobian.tools._progress import Batch

Array = NDArray[np.float64]

PROGRAM = 'sweep_gains'
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


class UsageError(Exception):
    """What was asked for cannot be."""


class InterruptedByUserError(Exception):
    """A signal came."""


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


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    own, ros = _cli.split_arguments(arguments)
    options = _parser().parse_args([*own, *ros])
    try:
        # Before the batch, which takes a while.
        picture, numbers = _files(options)
        if picture is not None:
            importlib.import_module('matplotlib.figure')
        swept = _sweep(options, signals)
        drawn = b'' if picture is None else _sweep_figure.draw(swept, _ending(picture))
        told = b'' if numbers is None else table(swept).encode()
        if signals.count:
            raise InterruptedByUserError
        if options.output is None and options.csv is None:
            # Others that began in the same second may have taken the names meanwhile.
            picture, numbers = _files(options)
    except InterruptedByUserError:
        print(f'{PROGRAM}: interrupted: nothing was written', file=sys.stderr)
        return _cli.INTERRUPTED
    except (UsageError, UserError) as error:
        return _cli.complain(PROGRAM, error)
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'matplotlib':
            raise
        return _cli.complain(
            PROGRAM,
            "matplotlib is not installed: pip install 'diffdrive_jacobian[plot]'; "
            'the numbers alone, --csv FILE, do not need it',
        )
    except OSError as error:
        return _cannot_write(error.filename, error)
    code = _write([(numbers, told), (picture, drawn)])
    print(describe(swept))
    return code


def _sweep(options: argparse.Namespace, signals: Signals) -> Sweep:
    """Do what was asked for, with a bar.

    Raises:
        UsageError: It cannot be done.
        UserError: The file of parameters is none.
        InterruptedByUserError: A signal came.
    """
    try:
        setup = Setup(
            controller=options.controller,
            kp=tuple(options.kp),
            kv=tuple(options.kv),
            grid=options.grid,
            starts=options.starts,
            distance=options.distance,
            rate=options.rate,
            duration=options.duration,
            tolerance=options.tolerance,
            robot=_robot(options),
        )
        with Batch('sweeping', setup.loops) as bar:

            def progress(done: int) -> None:
                if signals.count:
                    raise InterruptedByUserError
                bar.show(done)

            return sweep(setup, progress)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _robot(options: argparse.Namespace) -> RobotModel:
    """Give the robot: as a file says, and the options above that.

    Raises:
        ParameterError: It cannot be.
        UserError: The file is none of parameters.
    """
    values: dict[str, Any] = {}
    if options.params_file is not None:
        values.update(robot_parameters(options.params_file))
    for name, limit in (('linear.x', options.max_velocity), ('angular.z', options.max_yaw_rate)):
        if limit is not None:
            values |= {f'{name}.max_velocity': limit, f'{name}.min_velocity': -limit}
    return from_ros(VirtualRobotParameters, values).model()


def _files(options: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Say which files are to be written, the picture and the numbers; None: not asked for.

    Raises:
        UsageError: They cannot be meant.
        OSError: They could not be written.
    """
    if options.output is None and options.csv is None:
        stem = f'sweep_{datetime.now():%Y_%m_%d-%H_%M_%S}'
        for number in count(2):
            both = f'{stem}.png', f'{stem}.csv'
            if not any(os.path.lexists(path) for path in both):
                break
            stem = f'{stem.split("__")[0]}__{number}'
        return _new(both[0], FORMATS), _new(both[1], ('csv',))
    picture = None if options.output is None else _new(options.output, FORMATS)
    return picture, None if options.csv is None else _new(options.csv, ('csv',))


def _new(text: str, endings: Sequence[str]) -> Path:
    """Hold that a file is new, and can be: a batch is not to be lost because of its name."""
    path = Path(text)
    if _ending(path) not in endings:
        what = 'numbers' if endings == ('csv',) else 'picture'
        raise UsageError(f'the {what} must end in .{", .".join(endings)}, got {text!r}')
    try:
        with suppress(FileNotFoundError):
            path.lstat()
            raise UsageError(f'{path} exists already; it is not overwritten')
        if not path.parent.is_dir():
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        error.filename = str(path)
        raise
    return path


def _ending(path: Path) -> str:
    return path.suffix.lower().removeprefix('.')


def _write(contents: Sequence[tuple[Path | None, bytes]]) -> int:
    """Write files and name them; one that cannot be does not keep the others; gives the exit code."""
    code = _cli.DONE
    written = []
    for path, content in contents:
        if path is None:
            continue
        try:
            create(path, content)
            written.append(path)
        except OSError as error:
            code = _cannot_write(path, error)
    # Only now: who reads it may go away.
    for path in written:
        print(path)
    return code


def _cannot_write(path: object, error: OSError) -> int:
    print(f'{PROGRAM}: error: {path} cannot be written: {error.strerror or error}', file=sys.stderr)
    return _cli.FAILED


def _whole(text: str) -> int:
    text = text.strip()
    if not re.fullmatch('-?[0-9]{1,9}', text):
        raise argparse.ArgumentTypeError(f'must be a whole number below a billion, got {text!r}')
    return int(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [options]',
        description='Sweep the gains kp and kv of a control law over a grid: thousands of closed loops '
        'are driven to a goal at once, from starts all around it. Time to goal, path and overshoot '
        'are drawn as heat maps, with the border beyond which the robot spirals in, and written as CSV. '
        'Without -o and --csv both are made, sweep_DATE-TIME.png and .csv; else what these name. '
        'No file is ever overwritten. Exit code 0: done; 1: it cannot be written; 2: wrong arguments; '
        '130: interrupted, and nothing was written.',
    )
    usual = Setup()
    for name, what in (('kp', 'heading error'), ('kv', 'distance')):
        first, last = getattr(usual, name)
        parser.add_argument(
            f'--{name}',
            nargs=2,
            metavar=('MIN', 'MAX'),
            type=_cli.number,
            default=(first, last),
            help=f'gain on the {what} (1/s); {first:g} {last:g}',
        )
    parser.add_argument(
        '--grid', metavar='N', type=_whole, default=usual.grid, help='values of each gain; %(default)s'
    )
    parser.add_argument(
        '--starts',
        metavar='N',
        type=_whole,
        default=usual.starts,
        help='poses to start from, evenly around the goal, facing every way; %(default)s',
    )
    parser.add_argument(
        '--distance',
        metavar='M',
        type=_cli.positive,
        default=usual.distance,
        help='from the starts to the goal (m); %(default)g',
    )
    parser.add_argument(
        '--controller',
        choices=sorted(CONTROLLERS),
        default=usual.controller,
        help="the law: document A's, or pose, which also takes the goal's heading; %(default)s",
    )
    parser.add_argument(
        '--rate',
        metavar='HZ',
        type=_cli.positive,
        default=usual.rate,
        help='how often the law is asked (Hz); %(default)g',
    )
    parser.add_argument(
        '--duration',
        metavar='S',
        type=_cli.positive,
        default=usual.duration,
        help='a robot is given up after this long (s); %(default)g',
    )
    parser.add_argument(
        '--tolerance',
        metavar='M',
        type=_cli.tolerance,
        default=usual.tolerance,
        help='distance that counts as arrived (m); %(default)g',
    )
    parser.add_argument(
        '--max-velocity', metavar='V', type=_cli.positive, help='limit of the speed (m/s); none'
    )
    parser.add_argument(
        '--max-yaw-rate', metavar='W', type=_cli.positive, help='limit of the yaw rate (rad/s); none'
    )
    parser.add_argument(
        '--params-file',
        metavar='FILE',
        type=_cli.readable_file,
        help='limits and wheels of virtual_robot (YAML), as in config/',
    )
    parser.add_argument('-o', '--output', metavar='FILE', help=f'the picture, .{", .".join(FORMATS)}')
    parser.add_argument('--csv', metavar='FILE', help='the numbers, .csv')
    return parser
