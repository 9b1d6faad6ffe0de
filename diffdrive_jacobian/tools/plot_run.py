"""Draw recorded runs, and write them as CSV files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from diffdrive_jacobian.bags.bag_reader import BagError, ReadingInterruptedError
from diffdrive_jacobian.bags.run import Run, read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.topics import READABLE
from diffdrive_jacobian.plots.output_files import FORMATS, NOT_OVERWRITTEN, check_directory
from diffdrive_jacobian.plots.run_figure import draw, names
from diffdrive_jacobian.plots.run_table import DECIMALS, write_csv
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli, _options
from diffdrive_jacobian.tools._messages import busy, explaining_no_matplotlib
from diffdrive_jacobian.tools.entry_points import OUTPUT_ERROR

PROGRAM = 'plot_run'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    options = _parser().parse_args(arguments)
    try:
        bags = _options.given_bags(options)
        given = [name for name, _ in options.topics]
        if repeated := [name for name in given if given.count(name) > 1]:
            raise UserError(f'--topic can be given once for each name, got {repeated[0]} again')
        picture = _picture(options, bags)
        tables = [] if options.csv is None else _tables(options, bags)
        # A bag that does not exist is reported when it is read.
        beside = options.output is None and not bags[0].exists()
        for path in (*([] if beside else [picture]), *tables):
            try:
                _check_writable(path, makes_directory=path in tables)
            except OSError as error:
                return _cli.cannot_write(PROGRAM, path, error)
        runs: list[Run] = []
        for bag in bags:
            with busy(PROGRAM, f'reading {printable(bag, PATH_LIMIT)}'):
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
                print(f'{PROGRAM}: {printable(bag, PATH_LIMIT)}: {note}', file=sys.stderr)
            if signals.count:
                return _cli.interrupted(PROGRAM)
        with explaining_no_matplotlib():
            return _write(runs, picture, tables, signals, replace=options.force)
    except ReadingInterruptedError:
        return _cli.interrupted(PROGRAM)
    except (BagError, UserError) as error:
        return _cli.complain(PROGRAM, printable(error, PATH_LIMIT))


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
            return _cli.interrupted(PROGRAM)
        try:
            with busy(PROGRAM, f'writing {printable(path, PATH_LIMIT)}'):
                write()
        except OSError as error:
            return _cli.cannot_write(PROGRAM, path, error)
        try:
            print(printable(path, PATH_LIMIT))
        except BrokenPipeError:
            raise
        except OSError as error:
            # It is not buffered.
            return _cli.complain(PROGRAM, f'{OUTPUT_ERROR}: {error.strerror}', _cli.FAILED)
    return _cli.DONE


def _check_writable(path: Path, *, makes_directory: bool) -> None:
    """Raise OSError, before a picture is drawn, if a file cannot be created."""
    parent = path.parent
    if not path.exists():
        check_directory(parent.parent if makes_directory and not parent.exists() else parent)


def _write_table(run: Run, path: Path, *, replace: bool) -> None:
    path.parent.mkdir(exist_ok=True)
    write_csv(run, path, replace=replace)


def _picture(options: argparse.Namespace, bags: Sequence[Path]) -> Path:
    """Return the path of the picture, which by default is beside the first bag.

    Raises:
        UserError: It exists, is a directory, or has another ending than a picture.
    """
    output = options.output
    name = '_and_'.join(bag.resolve().name for bag in bags)
    if options.namespace not in (None, '/'):
        name += options.namespace.replace('/', '_')
    path = bags[0].resolve().parent / f'{name}.png' if output is None else Path(output)
    if output is not None and (output.endswith('/') or path.is_dir()):
        raise UserError(
            f'the picture must be a file (.{", .".join(FORMATS)}), got a directory: {output!r}'
        )
    if path.suffix.lower().removeprefix('.') not in FORMATS:
        raise UserError(f'the picture must end in .{", .".join(FORMATS)}, got {output!r}')
    return _checked(path, replace=options.force)


def _tables(options: argparse.Namespace, bags: Sequence[Path]) -> list[Path]:
    """Return the paths of the CSV files, one for each run.

    Raises:
        UserError: One of them exists, or `output` is neither a CSV file nor a directory.
    """
    output = options.csv
    path = Path(output)
    if path.is_dir() or output.endswith('/') or not path.suffix:
        if path.exists() and not path.is_dir():
            raise UserError(f'{path} exists already; a CSV file ends in .csv')
        labels = (name.replace('/', '_') for name in names(bags))
        return [_checked(path / f'{label}.csv', replace=options.force) for label in labels]
    if path.suffix.lower() != '.csv':
        raise UserError(
            f'--csv must be a file that ends in .csv or a directory, got {output!r} (a directory exists '
            'already, has a name without an ending, or is given with / at its end)'
        )
    if len(bags) > 1:
        raise UserError(f'--csv must be a directory for {len(bags)} runs, got {output!r}')
    return [_checked(path, replace=options.force)]


def _checked(path: Path, *, replace: bool) -> Path:
    """Return a path, unless something is there that is not to be replaced."""
    if (path.exists() or path.is_symlink()) and not (replace and path.is_file()):
        raise UserError(f'{path} exists already; {NOT_OVERWRITTEN}')
    return path


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
    _options.add_bags(parser)
    _options.add_output(
        parser,
        'FILE',
        f'picture to write, .{", .".join(FORMATS)} (default: BAG.png beside the bag)',
    )
    parser.add_argument(
        '--csv',
        metavar='FILE_OR_DIR',
        help='also write the values over time: to FILE.csv, or to BAG.csv for each bag in a directory. '
        f'Times are exact, values are rounded to {DECIMALS} decimal places (default: none)',
    )
    _options.add_force(parser, 'the picture and the tables')
    _options.add_namespace(parser)
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
