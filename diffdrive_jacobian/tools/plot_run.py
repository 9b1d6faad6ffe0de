"""Draw recorded runs, and export their numbers."""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.plots.output_files import FORMATS, create
from diffdrive_jacobian.plots.run_figure import draw, names
from diffdrive_jacobian.reading.reader import BagError, Run, Series, read_run
from diffdrive_jacobian.reading.trace import Trace, seconds, trace
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.time_units import NANOSECONDS
from diffdrive_jacobian.tools import _cli

PROGRAM = 'plot_run'
TOPICS = (
    'odom',
    'cmd_vel',
    'cmd_vel_out',
    'start_pose',
    'goal_pose',
    'goals',
    'goal_status',
    'joint_command',
    'joint_states',
    'parameter_events',
)
"""What can be told by --topic to have another name in the bag."""
COLUMNS = (
    *('time_s', 'x_m', 'y_m', 'theta_rad', 'v_mps', 'omega_radps'),
    *('distance_m', 'heading_error_rad', 'v_command_mps', 'omega_command_radps'),
    *('omega_right_radps', 'omega_left_radps'),
)
"""Of a CSV file."""
DECIMALS = 9
"""Decimal places of the values in a CSV file; its times are exact to the nanosecond."""


class UsageError(Exception):
    """The files that were named cannot be meant."""


def table(run: Run) -> NDArray[np.float64]:
    """Give a run as numbers, one row for each odometry message, `COLUMNS`; NaN: not known.

    Time counts from the first odometry. The command is the last one until then, as it was applied
    (`cmd_vel_out`) or else as it was sent (`cmd_vel`); the wheel speeds of `joint_states` are
    interpolated linearly between its messages.

    Raises:
        BagError: There is no odometry.
    """
    one = trace(run)
    commands = run.cmd_vel_out if len(run.cmd_vel_out) else run.cmd_vel
    return np.column_stack(
        [
            one.time,
            run.odometry.values,
            one.distance,
            one.heading_error,
            _held(one, commands),
            _interpolated(one, run.wheels),
        ]
    )


def _held(one: Trace, series: Series) -> NDArray[np.float64]:
    """Give the last value until each odometry, NaN before the first, shape (n, 2)."""
    at, known = _clocks(one, series)
    last = np.searchsorted(known, at, side='right')
    return np.vstack([np.full((1, 2), np.nan), series.values])[last]


def _interpolated(one: Trace, series: Series) -> NDArray[np.float64]:
    """Give the value at each odometry, NaN before the first and after the last, shape (n, 2)."""
    at, known = _clocks(one, series)
    if not len(series):
        return np.full((len(at), 2), np.nan)
    columns = [np.interp(at, known, values, np.nan, np.nan) for values in series.values.T]
    return np.column_stack(columns)


def _clocks(one: Trace, series: Series) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give two times that can be compared and do not go back: of the odometry and of a series (s)."""
    times = one.time, seconds(one.run, series)
    if all((np.diff(time) >= 0.0).all() for time in times):
        return times
    begin = one.run.odometry.received[0]
    return (one.run.odometry.received - begin) / NANOSECONDS, (series.received - begin) / NANOSECONDS


def _seconds(nanoseconds: int) -> str:
    """Return a time as an exact decimal number (s)."""
    sign, (whole, rest) = '-' * (nanoseconds < 0), divmod(abs(nanoseconds), NANOSECONDS)
    return f'{sign}{whole}.{rest:09d}'.rstrip('0').rstrip('.')


def _decimal(value: float) -> str:
    """Return a number rounded to `DECIMALS` places; '': NaN."""
    if math.isnan(value):
        return ''
    text = f'{value:.{DECIMALS}f}'.rstrip('0').rstrip('.')
    return '0' if text == '-0' else text


def write_csv(run: Run, path: Path) -> None:
    """Write a run into a new CSV file with a header line; what is not known stays empty.

    Times are exact, values are rounded to `DECIMALS` places.

    Raises:
        BagError: The run has no odometry.
        FileExistsError: The file exists; it stays as it is.
        OSError: It cannot be written; nothing is left of it.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    stamps = (run.odometry.stamps - run.odometry.stamps[0]).tolist()
    for stamp, (_, *values) in zip(stamps, table(run).tolist(), strict=True):
        writer.writerow([_seconds(stamp), *map(_decimal, values)])
    create(path, text.getvalue().encode())


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    options = _parser().parse_args(arguments)
    bags = [Path(bag) for bag in options.bags]
    try:
        if len({bag.resolve() for bag in bags}) < len(bags):
            raise UsageError(f'each bag can be given once, got {" ".join(map(str, bags))}')
        picture = _picture(options.output, bags)
        tables = [] if options.csv is None else _tables(options.csv, bags)
        runs: list[Run] = []
        for bag in bags:
            runs.append(read_run(bag, dict(options.topics)))
            # Before the others are read, which takes a while.
            trace(runs[-1])
            for note in runs[-1].notes:
                print(f'{PROGRAM}: {printable(bag, PATH_LIMIT)}: {note}', file=sys.stderr)
            if signals.count:
                return _interrupted()
        return _write(runs, picture, tables, signals)
    except (BagError, UsageError) as error:
        return _cli.complain(PROGRAM, error)
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'matplotlib':
            raise
        return _cli.complain(
            PROGRAM, "matplotlib is not installed: pip install 'diffdrive_jacobian[plot]'"
        )


def _write(runs: Sequence[Run], picture: Path, tables: Sequence[Path], signals: Signals) -> int:
    """Write what was asked for, the picture first; gives the exit code."""
    path = picture
    try:
        draw(runs, picture)
        print(picture)
        for run, path in zip(runs, tables, strict=bool(tables)):
            if signals.count:
                return _interrupted()
            path.parent.mkdir(exist_ok=True)
            write_csv(run, path)
            print(path)
    except OSError as error:
        print(f'{PROGRAM}: error: {path} cannot be written: {error.strerror or error}', file=sys.stderr)
        return _cli.FAILED
    return _cli.DONE


def _interrupted() -> int:
    print(f'{PROGRAM}: interrupted', file=sys.stderr)
    return _cli.INTERRUPTED


def _picture(output: str | None, bags: Sequence[Path]) -> Path:
    """Say which file is to be drawn: without a name, it lies beside the first bag.

    Raises:
        UsageError: It cannot be.
    """
    name = '_and_'.join(bag.resolve().name for bag in bags)
    path = bags[0].resolve().parent / f'{name}.png' if output is None else Path(output)
    if output is not None and (output.endswith('/') or path.is_dir()):
        raise UsageError(
            f'the picture must be a file (.{", .".join(FORMATS)}), got a directory: {output!r}'
        )
    if path.suffix.lower().removeprefix('.') not in FORMATS:
        raise UsageError(f'the picture must end in .{", .".join(FORMATS)}, got {output!r}')
    return _new(path)


def _tables(output: str, bags: Sequence[Path]) -> list[Path]:
    """Say into which files the numbers go, one for each run.

    Raises:
        UsageError: They cannot be.
    """
    path = Path(output)
    if path.is_dir() or output.endswith('/') or not path.suffix:
        if path.exists() and not path.is_dir():
            raise UsageError(f'{path} exists already; a file for the numbers ends in .csv')
        labels = (name.replace('/', '_') for name in names(bags))
        return [_new(path / f'{label}.csv') for label in labels]
    if path.suffix.lower() != '.csv':
        raise UsageError(
            f'the file for the numbers must end in .csv, got {output!r} (a directory exists '
            'already, has a name without an ending, or is given with / at its end)'
        )
    if len(bags) > 1:
        raise UsageError(f'the numbers of {len(bags)} runs need a directory, got {output!r}')
    return [_new(path)]


def _new(path: Path) -> Path:
    if path.exists() or path.is_symlink():
        raise UsageError(f'{path} exists already; it is not overwritten')
    return path


def _topic(text: str) -> tuple[str, str]:
    name, separator, topic = text.partition('=')
    if name not in TOPICS or not separator or not topic:
        raise argparse.ArgumentTypeError(
            f'must be NAME=TOPIC with NAME one of {", ".join(TOPICS)}, got {text!r}'
        )
    return name, topic if topic.startswith('/') else f'/{topic}'


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description='Draw runs that record_run or ros2 bag record has written: the path with its goals, '
        'and over time the distance, the heading error, the speeds and their limits; several over each '
        'other. No file is ever overwritten. Exit code 0: drawn; 1: it cannot be written; 2: wrong '
        'arguments, or no such run; 130: interrupted.',
    )
    parser.add_argument('bags', metavar='BAG', nargs='+', help='the directory of a bag')
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help=f'the picture, .{", .".join(FORMATS)}; else BAG.png beside the bag',
    )
    parser.add_argument(
        '--csv',
        metavar='FILE_OR_DIR',
        help='write the numbers, too: FILE.csv, or in the directory BAG.csv for each bag; times are '
        f'exact, values rounded to {DECIMALS} decimal places',
    )
    parser.add_argument(
        '--topic',
        dest='topics',
        metavar='NAME=TOPIC',
        action='append',
        type=_topic,
        default=[],
        help='a topic that has another name in the bag, as odom=/robot1/odometry; may be repeated',
    )
    return parser
