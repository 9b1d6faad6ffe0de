"""Sweep the gains of a control law over a grid, as one batch of closed loops."""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diffdrive_jacobian.control import Controller, ControllerError
from diffdrive_jacobian.control.controllers import BUILT_IN, CONTROLLERS
from diffdrive_jacobian.errors import DiffdriveError, UserError
from diffdrive_jacobian.parameters.declaration import from_ros
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.plots import sweep_figure
from diffdrive_jacobian.plots.output_files import FORMATS, create, extension, free_stem, new_file
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
from diffdrive_jacobian.tools import _cli, _options
from diffdrive_jacobian.tools._messages import busy, explaining_no_matplotlib

PROGRAM = 'sweep_gains'


class SweepInterruptedError(DiffdriveError):
    """A signal was caught."""


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    try:
        parser = _parser(_controller(own))
    except (ControllerError, argparse.ArgumentError) as error:
        return _cli.complain(PROGRAM, error)
    options = _cli.parse(parser, [*own, *ros], ros=False)
    _cli.refuse_without(parser, options, '--force', '--output', '--csv')
    try:
        # Before the sweep, which takes a while.
        picture, numbers = _files(options)
        _check(signals)
        if picture is not None:
            # Slow.
            with explaining_no_matplotlib('; the table alone, --csv FILE, does not need it'):
                importlib.import_module('matplotlib.figure')
        swept = _sweep(options, signals)
        with busy(PROGRAM, 'drawing'):
            drawn = b'' if picture is None else sweep_figure.draw(swept, extension(picture))
        rows = b'' if numbers is None else sweep_table(swept).encode()
        _check(signals)
        if options.output is None and options.csv is None:
            # Other processes that started in the same second may have taken the names meanwhile.
            picture, numbers = _files(options)
    except SweepInterruptedError:
        return _cli.interrupted(PROGRAM, 'nothing was written')
    except (ValueError, UserError, FileExistsError) as error:
        return _cli.complain(PROGRAM, error)
    except OSError as error:
        return _cli.cannot_write(PROGRAM, error.filename, error)
    code = _write([(numbers, rows), (picture, drawn)], replace=options.force)
    print(describe_sweep(swept))
    return code


def _sweep(options: argparse.Namespace, signals: Signals) -> Sweep:
    """Sweep the gains, with a progress bar.

    Raises:
        ValueError: The options are invalid together.
        UserError: The parameter file is invalid.
        SweepInterruptedError: A signal was caught.
    """
    setup = SweepSetup(
        controller=options.controller,
        gains=_gains(options),
        grid=options.grid,
        starts=options.starts,
        distance=options.distance,
        rate=options.rate,
        duration=options.duration,
        tolerance=options.tolerance,
        robot=_robot(options),
    )
    _check(signals)
    # Slow to import.
    from diffdrive_jacobian.tools._progress import Bar

    started = time.monotonic()
    with Bar() as bar:

        def progress(done: int) -> None:
            _check(signals)
            seconds = time.monotonic() - started
            bar.show('sweeping', done / setup.loops, f'{done} of {setup.loops}, {seconds:.0f} s')

        return sweep(setup, progress)


def _controller(own: Sequence[str]) -> Controller:
    """Return the controller that is chosen on the command line: its gains are options.

    Raises:
        ControllerError: There is none of that name, or it cannot be loaded.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument('--controller', nargs='?', default=SweepSetup().controller)
    name = parser.parse_known_args(own)[0].controller
    return CONTROLLERS.find(name or '')


def _gains(options: argparse.Namespace) -> dict[str, float | tuple[float, float]]:
    """Return the gains that are given: a value, or a range."""
    found: dict[str, float | tuple[float, float]] = {}
    for gain in CONTROLLERS.find(options.controller).gains:
        values = getattr(options, f'gain_{gain.name}')
        if values is not None:
            found[gain.name] = values[0] if len(values) == 1 else tuple(values)
    return found


def _check(signals: Signals) -> None:
    """Raise SweepInterruptedError if a signal was caught."""
    if signals.count:
        raise SweepInterruptedError


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
    values |= _options.following_parameters(options)
    return from_ros(VirtualRobotParameters, values).model()


def _files(options: argparse.Namespace) -> tuple[Path | None, Path | None]:
    """Return the files to write, the picture and the table. None: it is not written.

    Raises:
        ValueError: A file name has the wrong extension.
        FileExistsError: A file exists.
        OSError: A file cannot be written.
    """
    output, csv = options.output, options.csv
    if output is None and csv is None:
        stem = free_stem('sweep', ('png', 'csv'))
        output, csv = f'{stem}.png', f'{stem}.csv'
    return (
        None if output is None else new_file(output, FORMATS, 'picture', replace=options.force),
        None if csv is None else new_file(csv, ('csv',), 'table', replace=options.force),
    )


def _write(contents: Sequence[tuple[Path | None, bytes]], *, replace: bool) -> int:
    """Write files and print their names; return the exit code.

    A file that cannot be written does not prevent the others from being written.
    """
    code = _cli.DONE
    written = []
    for path, content in contents:
        if path is None:
            continue
        try:
            create(path, content, replace=replace)
            written.append(path)
        except OSError as error:
            code = _cli.cannot_write(PROGRAM, path, error)
    # Only now: the reader of the output may go away.
    for path in written:
        print(path)
    return code


def _parser(controller: Controller = BUILT_IN['go_to_goal']) -> _cli.Parser:
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
    _options.add_value(
        parser,
        '--grid',
        'N',
        'number of values of each gain',
        default=usual.grid,
        kind=_options.integer_from(2, MAX_LOOPS),
    )
    _options.add_value(
        parser,
        '--starts',
        'N',
        'number of start poses, evenly spaced around the goal, with headings in all directions',
        default=usual.starts,
        kind=_options.integer_from(1, MAX_LOOPS),
    )
    _options.add_value(
        parser,
        '--distance',
        'M',
        'distance of the start poses from the goal (m)',
        default=usual.distance,
    )
    _options.add_controller(
        parser,
        CONTROLLERS,
        'controller, whose gains are options, too: %(choices)s',
        default=usual.controller,
    )
    _options.add_value(parser, '--rate', 'HZ', 'control rate (Hz)', default=usual.rate)
    _options.add_value(
        parser, '--duration', 'S', 'longest duration of a closed loop (s)', default=usual.duration
    )
    _options.add_value(
        parser,
        '--tolerance',
        'M',
        'distance that counts as arrived (m)',
        default=usual.tolerance,
        kind=_options.tolerance,
    )
    _options.add_value(parser, '--max-velocity', 'V', 'limit of the speed (m/s) (default: no limit)')
    _options.add_value(
        parser, '--max-yaw-rate', 'W', 'limit of the yaw rate (rad/s) (default: no limit)'
    )
    _options.add_following(parser)
    _options.add_params_file(
        parser,
        'parameter file (YAML) with the limits and wheels of virtual_robot, as in config/ '
        '(default: the defaults of virtual_robot)',
    )
    default = 'sweep_DATE-TIME.{}, unless {} is given'
    _options.add_output(
        parser, 'FILE', f'picture, .{", .".join(FORMATS)} (default: {default.format("png", "--csv")})'
    )
    _options.add_force(parser, 'the picture and the table')
    parser.add_argument(
        '--csv', metavar='FILE', help=f'table, .csv (default: {default.format("csv", "-o")})'
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
            type=_options.number,
            help=f'{gain.description}{unit}: MIN MAX to sweep it, or one value (default: the first two '
            f'gains are swept, this one over {gain.usual[0]:g} to {gain.usual[1]:g}; else '
            f'{gain.default:g})',
        )
    return parser
