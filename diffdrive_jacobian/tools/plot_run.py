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

"""Draw recorded runs, and write them as CSV files."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from diffdrive_jacobian.bags.run import Run, read_run
from diffdrive_jacobian.bags.summary import summary, table_of
from diffdrive_jacobian.bags.table import DECIMALS, csv_text
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.topics import READABLE
from diffdrive_jacobian.plots.output_files import (
    FILM_FORMATS,
    FORMATS,
    cannot_write,
    check_directory,
    extension,
    new_file,
)
from diffdrive_jacobian.plots.run_pictures import names_of, run_figure
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE

PROGRAM = 'plot_run'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    parser = _parser()
    options = parser.parse(arguments, ros=False)
    parser.refuse_without(options, '--speed', '--film')
    bags = _cli.given_bags(options)
    given = [name for name, _ in options.topics]
    if repeated := [name for name in given if given.count(name) > 1]:
        raise UserError(f'--topic can be given once for each name, got {repeated[0]} again')
    film = None
    if options.film is not None:
        film = new_file(options.film, FILM_FORMATS, 'film', replace=options.force)
    # Whoever wants a film need not want a picture.
    drawn = film is None or options.output is not None
    picture = _picture(options, bags) if drawn else None
    tables = _tables(options, bags)
    runs, found = [], []
    for bag in bags:
        with _output.busy(PROGRAM, f'reading {bag}'):
            run = read_run(
                bag,
                dict(options.topics),
                namespace=options.namespace,
                interrupted=lambda: signals.count > 0,
            )
        runs.append(run)
        # A run without odometry is reported before the others are read.
        found.append(summary(run.timeline()))
        for note in run.notes:
            _output.note(PROGRAM, f'{bag}: {note}')
        _output.check(signals)
    if picture is not None:
        content = _output.drawn(PROGRAM, signals, extension(picture), lambda: run_figure(runs))
        _output.write(picture, content, replace=options.force)
        _output.say(picture)
    if film is not None:
        _output.write(film, _filmed(runs, film, options.speed, signals), replace=options.force)
        _output.say(film)
    for run, path in zip(runs, tables, strict=bool(tables)):
        _output.check(signals)
        with _output.busy(PROGRAM, f'writing {path}'):
            _write_table(run, path, replace=options.force)
        _output.say(path)
    print(*table_of(names_of(bags), found), sep='\n')
    return DONE


def _filmed(runs: Sequence[Run], path: Path, speed: float | None, signals: Signals) -> bytes:
    """Return the content of a file with a film, with a progress bar.

    Raises:
        UserError: matplotlib or ffmpeg is not installed, or the film is too long.
        InterruptionError: A signal was caught.
    """
    from diffdrive_jacobian.plots.film import Film

    with _output.explaining_no_matplotlib(), closing(_output.Bar()) as bar:

        def progress(frame: int, frames: int) -> None:
            _output.check(signals)
            bar.show('filming', frame / frames, f'{frame} of {frames} frames')

        try:
            film = Film(runs, speed=speed)
        except ValueError as error:
            raise UserError(str(error)) from error
        return film.content(extension(path), progress)


def _write_table(run: Run, path: Path, *, replace: bool) -> None:
    try:
        path.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error
    _output.write(path, csv_text(run).encode(), replace=replace)


def _picture(options: argparse.Namespace, bags: Sequence[Path]) -> Path:
    """Return the path of the picture, which by default is beside the first bag.

    Raises:
        UserError: It is a directory.
        UserError, NotDoneError: As for `new_file`.
    """
    output = options.output
    if output is None:
        name = '_and_'.join(bag.resolve().name for bag in bags)
        if options.namespace not in (None, '/'):
            name += options.namespace.replace('/', '_')
        path = bags[0].resolve().parent / f'{name}.png'
        # A bag that does not exist is reported when it is read.
        if not os.path.exists(bags[0]):
            return path
        output = str(path)
    elif output.endswith('/') or os.path.isdir(output):
        raise UserError(
            f'the picture must be a file (.{", .".join(FORMATS)}), got a directory: {output!r}'
        )
    return new_file(output, FORMATS, 'picture', replace=options.force)


def _tables(options: argparse.Namespace, bags: Sequence[Path]) -> list[Path]:
    """Return the paths of the CSV files, one for each run. Their directory may still be missing.

    Raises:
        UserError: `--csv` is neither a CSV file nor a directory.
        UserError, NotDoneError: As for `new_file`.
    """
    output = options.csv
    if output is None:
        return []
    path = Path(output)
    if os.path.isdir(path) or output.endswith('/') or not path.suffix:
        if os.path.exists(path) and not os.path.isdir(path):
            raise UserError(f'{path} exists already; a CSV file ends in .csv')
        tables = [path / f'{label.replace("/", "_")}.csv' for label in names_of(bags)]
    elif path.suffix.lower() != '.csv':
        raise UserError(
            f'--csv must be a file that ends in .csv or a directory, got {output!r} (a directory exists '
            'already, has a name without an ending, or is given with / at its end)'
        )
    elif len(bags) > 1:
        raise UserError(f'--csv must be a directory for {len(bags)} runs, got {output!r}')
    else:
        tables = [path]
    if len(set(tables)) < len(tables):
        raise UserError(f'--csv gives two runs the same table: {", ".join(map(str, tables))}')
    for table in tables:
        if os.path.exists(table.parent):
            new_file(str(table), ('csv',), 'table', replace=options.force)
            continue
        try:
            check_directory(table.parent.parent)
        except OSError as error:
            raise cannot_write(table, error) from error
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
        'Several runs are drawn into the same axes, from their first goals on. Durations, lengths and '
        'the greatest errors and speeds are printed. Existing files are not overwritten without '
        '--force. '
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
    parser.add_argument(
        '--film',
        metavar='FILE',
        help=f'write a film, .{", .".join(FILM_FORMATS)}, and a picture only with -o; MP4 needs ffmpeg',
    )
    parser.add_value(
        '--speed', 'X', 'how much faster than it was the film is (default: 1, or more for a long run)'
    )
    parser.add_force('the picture, the film and the tables')
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
