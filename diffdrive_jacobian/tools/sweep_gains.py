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

"""Sweep the gains of a control law over a grid, as one batch of closed loops."""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from diffdrive_jacobian.control import Controller
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.plots.output_files import FORMATS, extension, free_stem, new_file
from diffdrive_jacobian.plots.sweep_pictures import sweep_figure
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation import RobotModel
from diffdrive_jacobian.simulation.gain_sweep import (
    MAX_LOOPS,
    Sweep,
    SweepSetup,
    describe_sweep,
    sweep,
    sweep_table,
)
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED

PROGRAM = 'sweep_gains'
NOTHING = 'nothing was written'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser(_controller(arguments))
    options = parser.parse(arguments, ros=False)
    parser.refuse_without(options, '--force', '--output', '--csv')
    # Before the sweep, which takes a while.
    picture, table = _files(options)
    _output.check(signals, NOTHING)
    if picture is not None:
        # Slow.
        with _output.explaining_no_matplotlib('; the table alone, --csv FILE, does not need it'):
            importlib.import_module('matplotlib.figure')
    swept = _sweep(options, signals)
    drawn = b''
    if picture is not None:
        drawn = _output.drawn(PROGRAM, signals, extension(picture), lambda: sweep_figure(swept))
    rows = b'' if table is None else sweep_table(swept).encode()
    _output.check(signals, NOTHING)
    if options.output is None and options.csv is None:
        # Other processes that started in the same second may have taken the names meanwhile.
        picture, table = _files(options)
    code, written = DONE, []
    for path, content in ((table, rows), (picture, drawn)):
        if path is None:
            continue
        try:
            _output.write(path, content, replace=options.force)
            written.append(path)
        except NotDoneError as error:
            # The other file is still written.
            code = _output.complain(PROGRAM, error, FAILED)
    # Only now: the reader of the output may go away.
    for path in written:
        _output.say(path)
    print(describe_sweep(swept))
    return code


def _controller(arguments: Sequence[str]) -> Controller:
    """Return the controller that is chosen on the command line: its gains are options.

    Raises:
        ControllerError: There is none of that name, or it cannot be loaded.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument('--controller', nargs='?', default=SweepSetup().controller)
    name = parser.parse_known_args(arguments)[0].controller
    return CONTROLLERS.find(name or '')


def _files(options: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Return the files to write, the picture and the table. None: it is not written.

    Raises:
        UserError, NotDoneError: As for `new_file`.
    """
    output, csv, force = options.output, options.csv, options.force
    if output is None and csv is None:
        stem = free_stem('sweep', ('png', 'csv'))
        output, csv = f'{stem}.png', f'{stem}.csv'
    return (
        None if output is None else new_file(output, FORMATS, 'picture', replace=force),
        None if csv is None else new_file(csv, ('csv',), 'table', replace=force),
    )


def _sweep(options: argparse.Namespace, signals: Signals) -> Sweep:
    """Sweep the gains, with a progress bar.

    Raises:
        UserError: The options are invalid together, the parameter file is, or the law cannot be swept.
        InterruptionError: A signal was caught.
    """
    gains: dict[str, float | tuple[float, float]] = {}
    for gain in CONTROLLERS.find(options.controller).gains:
        values = getattr(options, f'gain_{gain.name}')
        if values is not None:
            gains[gain.name] = values[0] if len(values) == 1 else tuple(values)
    names = ('controller', 'grid', 'starts', 'distance', 'rate', 'duration', 'tolerance')
    given = {name: getattr(options, name) for name in names}
    robot, started = _robot(options), time.monotonic()
    try:
        setup = SweepSetup(gains=gains, robot=robot, **given)
        _output.check(signals, NOTHING)
        with closing(_output.Bar()) as bar:

            def progress(done: int) -> None:
                _output.check(signals, NOTHING)
                seconds = time.monotonic() - started
                bar.show('sweeping', done / setup.loops, f'{done} of {setup.loops}, {seconds:.0f} s')

            return sweep(setup, progress)
    except ValueError as error:
        raise UserError(str(error)) from error


def _robot(options: argparse.Namespace) -> RobotModel:
    """Return the robot of a parameter file. The options take precedence.

    Raises:
        ParameterError: A parameter is invalid.
        UserError: The file is not a file of parameters.
    """
    values: dict[str, Any] = {}
    if options.params_file is not None:
        # Slow to import.
        from diffdrive_jacobian.parameters.file import robot_parameters

        values.update(robot_parameters(options.params_file))
    for name, limit in (('linear.x', options.max_velocity), ('angular.z', options.max_yaw_rate)):
        if limit is not None:
            values |= {f'{name}.max_velocity': limit, f'{name}.min_velocity': -limit}
    values |= _cli.following_parameters(options)
    return VirtualRobotParameters().changed(values).model()


def _parser(controller: Controller = CONTROLLERS.built_in['go_to_goal']) -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [options]',
        description='Sweep two gains of a control law over a grid: thousands of closed loops '
        'are simulated at once, from starts all around the goal. Time to the goal, path length and '
        'overshoot are drawn as heat maps, with the boundary that the controller declares, and '
        'written as CSV. Without -o and --csv both are written, as sweep_DATE-TIME.png and .csv. '
        'Existing files are not overwritten without --force. Exit code 0: done; 1: a file cannot be '
        'written; 2: wrong arguments; 130: interrupted, and nothing was written.',
    )
    usual = SweepSetup()
    text = 'number of values of each gain'
    parser.add_value('--grid', 'N', text, default=usual.grid, kind=_cli.integer_from(2, MAX_LOOPS))
    text = 'number of start poses, evenly spaced around the goal, with headings in all directions'
    parser.add_value('--starts', 'N', text, default=usual.starts, kind=_cli.integer_from(1, MAX_LOOPS))
    text = 'distance of the start poses from the goal (m)'
    parser.add_value('--distance', 'M', text, default=usual.distance)
    parser.add_argument(
        '--controller',
        choices=CONTROLLERS,
        metavar='NAME',
        default=usual.controller,
        help='controller, whose gains are options, too: %(choices)s (default: %(default)s)',
    )
    parser.add_value('--rate', 'HZ', 'control rate (Hz)', default=usual.rate)
    text = 'longest duration of a closed loop (s)'
    parser.add_value('--duration', 'S', text, default=usual.duration)
    text = 'distance that counts as arrived (m)'
    parser.add_value('--tolerance', 'M', text, default=usual.tolerance, kind=_cli.tolerance)
    parser.add_value('--max-velocity', 'V', 'limit of the speed (m/s) (default: no limit)')
    parser.add_value('--max-yaw-rate', 'W', 'limit of the yaw rate (rad/s) (default: no limit)')
    parser.add_following()
    parser.add_params_file(
        'parameter file (YAML) with the limits and wheels of virtual_robot, as in config/ '
        '(default: the defaults of virtual_robot)'
    )
    unless = 'sweep_DATE-TIME.{}, unless {} is given'
    parser.add_output(
        'FILE', f'picture, .{", .".join(FORMATS)} (default: {unless.format("png", "--csv")})'
    )
    parser.add_force('the picture and the table')
    parser.add_argument(
        '--csv', metavar='FILE', help=f'table, .csv (default: {unless.format("csv", "-o")})'
    )
    for gain in controller.gains:
        unit = f' ({gain.unit})' if gain.unit else ''
        # It may have the name of another option.
        taken = {f'--{gain.name}', f'--{gain.name.replace("_", "-")}'} & set(parser.long_options)
        parser.add_argument(
            f'--gain-{gain.name}' if taken else f'--{gain.name}',
            dest=f'gain_{gain.name}',
            nargs='+',
            metavar='VALUE',
            type=_cli.number,
            help=f'{gain.description}{unit}: MIN MAX to sweep it, or one value (default: the first two '
            f'gains are swept, this one over {gain.usual[0]:g} to {gain.usual[1]:g}; else '
            f'{gain.default:g})',
        )
    return parser
