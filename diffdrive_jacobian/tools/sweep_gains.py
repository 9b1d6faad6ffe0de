"""Sweep the gains of a control law over a grid, as one batch of closed loops: a picture and a table."""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import from_ros
from diffdrive_jacobian.parameters.file import robot_parameters
from diffdrive_jacobian.parameters.nodes import VirtualRobotParameters
from diffdrive_jacobian.plots import sweep_figure
from diffdrive_jacobian.plots.output_files import FORMATS, create
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation import RobotModel
from diffdrive_jacobian.sweeps.sweep import Setup, Sweep, SweptControllers, describe, sweep, table
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._progress import Batch

Array = NDArray[np.float64]

PROGRAM = 'sweep_gains'


class UsageError(Exception):
    """What was asked for cannot be."""


class InterruptedByUserError(Exception):
    """A signal came."""


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
        drawn = b'' if picture is None else sweep_figure.draw(swept, _ending(picture))
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
        choices=SweptControllers(),
        metavar='NAME',
        default=usual.controller,
        help='controller with the gains kp and kv: %(choices)s (default: %(default)s)',
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
