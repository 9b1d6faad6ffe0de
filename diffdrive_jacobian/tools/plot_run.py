"""Draw recorded runs, and write them as CSV files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from diffdrive_jacobian.bags.bag_reader import BagError, ReadingInterruptedError
from diffdrive_jacobian.bags.run import Run, read_run
from diffdrive_jacobian.bags.table import DECIMALS, csv_text
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.topics import READABLE
from diffdrive_jacobian.plots.output_files import FORMATS, check_directory, create, new_file
from diffdrive_jacobian.plots.run_figure import draw, names
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, OUTPUT_ERROR

PROGRAM = 'plot_run'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    options = _parser().parse(arguments, ros=False)
    try:
        bags = _cli.given_bags(options)
        given = [name for name, _ in options.topics]
        if repeated := [name for name in given if given.count(name) > 1]:
            raise UserError(f'--topic can be given once for each name, got {repeated[0]} again')
        picture, tables = _picture(options, bags), _tables(options, bags)
    except (UserError, ValueError, FileExistsError) as error:
        return _output.complain(PROGRAM, error)
    except OSError as error:
        return _output.cannot_write(PROGRAM, error.filename, error)
    runs: list[Run] = []
    try:
        for bag in bags:
            with _output.busy(PROGRAM, f'reading {bag}'):
                runs.append(
                    read_run(
                        bag,
                        dict(options.topics),
                        namespace=options.namespace,
                        interrupted=lambda: signals.count > 0,
                    )
                )
            # A run without odometry is reported before the others are read.
            timeline(runs[-1])
            for note in runs[-1].notes:
                _output.note(PROGRAM, f'{bag}: {note}')
            if signals.count:
                return _output.interrupted(PROGRAM)
        with _output.explaining_no_matplotlib():
            return _write(runs, picture, tables, signals, replace=options.force)
    except ReadingInterruptedError:
        return _output.interrupted(PROGRAM)
    except (BagError, UserError) as error:
        return _output.complain(PROGRAM, error)


def _write(
    runs: Sequence[Run], picture: Path, tables: Sequence[Path], signals: Signals, *, replace: bool
) -> int:
    """Write the picture, then the tables, and return the exit code."""
    # Drawing takes a second.
    writers = [partial(draw, runs, picture, replace=replace, drawing=signals.ending_at_once())]
    writers += [
        partial(_write_table, *pair, replace=replace) for pair in zip(runs, tables, strict=bool(tables))
    ]
    for path, write in zip([picture, *tables], writers, strict=True):
        if signals.count:
            return _output.interrupted(PROGRAM)
        try:
            with _output.busy(PROGRAM, f'writing {path}'):
                write()
        except OSError as error:
            return _output.cannot_write(PROGRAM, path, error)
        try:
            print(printable(path, PATH_LIMIT))
        except BrokenPipeError:
            raise
        except OSError as error:
            # It is not buffered.
            return _output.complain(PROGRAM, f'{OUTPUT_ERROR}: {error.strerror}', FAILED)
    return DONE


def _write_table(run: Run, path: Path, *, replace: bool) -> None:
    path.parent.mkdir(exist_ok=True)
    create(path, csv_text(run).encode(), replace=replace)


def _picture(options: argparse.Namespace, bags: Sequence[Path]) -> Path:
    """Return the path of the picture, which by default is beside the first bag.

    Raises:
        UserError: It is a directory.
        ValueError, FileExistsError, OSError: As for `new_file`.
    """
    output = options.output
    if output is None:
        name = '_and_'.join(bag.resolve().name for bag in bags)
        if options.namespace not in (None, '/'):
            name += options.namespace.replace('/', '_')
        path = bags[0].resolve().parent / f'{name}.png'
        # A bag that does not exist is reported when it is read.
        if not bags[0].exists():
            return path
        output = str(path)
    elif output.endswith('/') or Path(output).is_dir():
        raise UserError(
            f'the picture must be a file (.{", .".join(FORMATS)}), got a directory: {output!r}'
        )
    return new_file(output, FORMATS, 'picture', replace=options.force)


def _tables(options: argparse.Namespace, bags: Sequence[Path]) -> list[Path]:
    """Return the paths of the CSV files, one for each run. Their directory may still be missing.

    Raises:
        UserError: `--csv` is neither a CSV file nor a directory.
        FileExistsError, OSError: As for `new_file`.
    """
    output = options.csv
    if output is None:
        return []
    path = Path(output)
    if path.is_dir() or output.endswith('/') or not path.suffix:
        if path.exists() and not path.is_dir():
            raise UserError(f'{path} exists already; a CSV file ends in .csv')
        tables = [path / f'{label.replace("/", "_")}.csv' for label in names(bags)]
    elif path.suffix.lower() != '.csv':
        raise UserError(
            f'--csv must be a file that ends in .csv or a directory, got {output!r} (a directory exists '
            'already, has a name without an ending, or is given with / at its end)'
        )
    elif len(bags) > 1:
        raise UserError(f'--csv must be a directory for {len(bags)} runs, got {output!r}')
    else:
        tables = [path]
    for table in tables:
        if table.parent.exists():
            new_file(str(table), ('csv',), 'table', replace=options.force)
            continue
        try:
            check_directory(table.parent.parent)
        except OSError as error:
            error.filename = str(table)
            raise
    return tables


def _topic(text: str) -> tuple[str, str]:
    name, separator, topic = text.partition('=')
    if name not in READABLE or not separator or not topic:
        raise argparse.ArgumentTypeError(
            f'must be NAME=TOPIC with NAME one of {", ".join(READABLE)}, got {text!r}'
        )
    return name, topic if topic.startswith('/') else f'/{topic}'


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        description='Draw runs that record_run or ros2 bag record has written: the path with its goals, '
        'and over time the distance to the goal, the bearing error, the speeds and their limits. '
        'Several runs are drawn into the same axes. Existing files are not overwritten without --force. '
        'Exit code 0: drawn; 1: a file cannot be written; 2: wrong arguments, or a bag cannot be read; '
        '130: interrupted.',
    )
    parser.add_bags()
    parser.add_output(
        'FILE', f'picture to write, .{", .".join(FORMATS)} (default: BAG.png beside the bag)'
    )
    parser.add_argument(
        '--csv',
        metavar='FILE_OR_DIR',
        help='also write the values over time: to FILE.csv, or to BAG.csv for each bag in a directory. '
        f'Times are exact, values are rounded to {DECIMALS} decimal places (default: none)',
    )
    parser.add_force('the picture and the tables')
    parser.add_namespace()
    parser.add_argument(
        '--topic',
        dest='topics',
        metavar='NAME=TOPIC',
        action='append',
        type=_topic,
        default=[],
        help='topic with another name in the bag, such as odom=/robot1/odometry; may be repeated',
    )
    return parser
