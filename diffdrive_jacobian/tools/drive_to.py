"""Drive the virtual robot to goals or along a path, with robot and controller in one process."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path as PlannedPath
from diffdrive_jacobian.control.controllers import ALL_PATH_CONTROLLERS
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.nodes import CONTROLLERS, NODE_PARAMETERS
from diffdrive_jacobian.plots.output_files import NOT_OVERWRITTEN
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _options, _page
from diffdrive_jacobian.tools._messages import NO_MATPLOTLIB, busy, describe_distances
from diffdrive_jacobian.tools._startup import long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.drives import Outcome
    from diffdrive_jacobian.live.goal_progress import GoalEnd
    from diffdrive_jacobian.recording.recording import Recording

PROGRAM = 'drive_to'
Goals: TypeAlias = NDArray[np.float64] | PlannedPath


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own, parameters=NODE_PARAMETERS)
    if len(options.coordinates) % 2:
        parser.error(f'coordinates must be pairs X Y, got {len(options.coordinates)} of them')
    if options.path is None:
        for option in ('--speed', '--path-controller'):
            _cli.refuse_without(parser, options, option, '--path')
    elif options.coordinates or options.heading is not None:
        parser.error('--path excludes X Y and --heading')
    heading = _options.given_heading(parser, options)
    for option in ('--output', '--force'):
        _cli.refuse_with(parser, options, option, '--no-record')
    _cli.refuse_without(parser, options, '--force', '--output')
    if options.lockstep and options.open:
        parser.error('--lockstep and --open exclude each other: other processes have another clock')
    if not options.live:
        if not options.coordinates and options.path is None:
            parser.error(
                'the following arguments are required: X Y or --path (only --live needs no goal)'
            )
        if options.port or options.no_browser:
            parser.error('--port and --no-browser are options of --live')
    elif options.timeout != parser.get_default('timeout'):
        parser.error('--timeout has no effect with --live, which ends by Ctrl-C')
    path = None if options.path is None else _options.given_path(parser, options)
    ros = ['--ros-args', '--log-level', 'warn', '--', *_options.with_params_file(ros, options)]
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.drives import DriveError, drive, waypoints_through
        from diffdrive_jacobian.recording.recording import saved_on_error

    goals: Goals = np.empty((0, 3))
    if path is not None:
        goals = path
    elif options.coordinates:
        goals = waypoints_through(np.reshape(options.coordinates, (-1, 2)), heading or 0.0)
    relative = path is not None and _options.is_relative(options.path)
    if options.live:
        return _drive_with_page(options, goals, relative, ros, signals)
    try:
        recording = _recording(options)
    except OSError as error:
        return _cli.complain(PROGRAM, error)
    kept = recording is None or options.no_plot or options.force
    if recording is not None and not kept and os.path.lexists(picture := _picture(recording)):
        recording.discard()
        return _cli.complain(PROGRAM, f'{picture} exists already; {NOT_OVERWRITTEN}')
    outcome = None
    try:
        with (
            saved_on_error(recording),
            _Progress(goals, options.path, ros, wall=not options.lockstep) as progress,
        ):
            try:
                outcome = drive(
                    goals,
                    relative=relative,
                    lockstep=options.lockstep,
                    isolated=not options.open,
                    timeout=options.timeout,
                    parameters=_controller_parameters(options),
                    robot_parameters=_options.following_parameters(options),
                    recording=recording,
                    ros_arguments=ros,
                    signals=signals,
                    progress=progress,
                )
            except DriveError as error:
                # The recording shows what led to it.
                print(f'{PROGRAM}: error: {error}', file=sys.stderr)
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    code = _cli.FAILED if outcome is None else _print_outcome(outcome, options)
    if recording is None:
        return code
    saved = _save(recording, plot=not options.no_plot, replace=options.force)
    # An interruption remains one.
    return code if code == _cli.INTERRUPTED else saved or code


def _drive_with_page(
    options: argparse.Namespace,
    goals: Goals,
    relative: bool,
    ros: Sequence[str],
    signals: Signals,
) -> int:
    """Drive with the page until Ctrl-C; return the exit code.

    Args:
        options: The options.
        goals: Goals, or a path.
        relative: Whether they are in the body frame of the robot where it starts.
        ros: ROS arguments of all nodes.
        signals: Counter of the signals.
    """
    # Not above: --help needs no ROS.
    from diffdrive_jacobian.drives import DriveError
    from diffdrive_jacobian.recording.recording import saved_on_error

    recording, given = None, bool(options.coordinates or options.path)
    try:
        with _page.explaining_page_errors(options.port):
            from diffdrive_jacobian.live.running import drive_live

        recording = _recording(options)
        # Where the page cannot be served, the recording is discarded.
        with saved_on_error(recording), _page.explaining_page_errors(options.port):
            drive_live(
                goals,
                relative=relative,
                lockstep=options.lockstep,
                isolated=not options.open,
                parameters=_controller_parameters(options),
                robot_parameters=_options.following_parameters(options),
                recording=recording,
                ros_arguments=ros,
                port=options.port,
                signals=signals,
                ready=_page.announcing(
                    options,
                    waiting='the drive starts' if given else '',
                    notice=_page.DRIVES if given else _page.STEERS,
                ),
                nodes_created=lambda names: _options.warn_of_unused_files(PROGRAM, ros, names),
                goal_ended=_print_goal_end,
            )
    except _page.PageError as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    except (DriveError, OSError) as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)
    return _cli.DONE if recording is None else _save(recording, plot=False, replace=options.force)


def _recording(options: argparse.Namespace) -> Recording | None:
    """Open the recording of the drive; None: none is wanted.

    Raises:
        OSError: It cannot be written, or exists.
    """
    if options.no_record:
        return None
    from diffdrive_jacobian.recording.recording import open_recording

    return open_recording(
        'drive', options.output, 'mcap', lossless=options.lockstep, replace=options.force
    )


class _Progress:
    """Prints the progress of a drive."""

    def __init__(self, goals: Goals, path: str | None, ros: Sequence[str], *, wall: bool) -> None:
        # Slow to import.
        from diffdrive_jacobian.tools._progress import GoalBar

        self._goals, self._path = goals, path
        self._ros = ros
        self._seconds = 0.0
        self._bar = GoalBar() if wall else GoalBar(lambda: self._seconds)

    def __enter__(self) -> _Progress:
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.__exit__()

    def nodes_created(self, names: Sequence[str]) -> None:
        _options.warn_of_unused_files(PROGRAM, self._ros, names)

    def driving(self, seconds: float, index: int, distance: float, wheels: tuple[float, float]) -> None:
        self._seconds = seconds
        what = f'path {self._path}'
        if not isinstance(self._goals, PlannedPath):
            x, y, _ = self._goals[index]
            what = f'goal {index + 1}/{len(self._goals)} ({x:g}, {y:g})'
        self._bar.show(what, distance, wheels)


def _controller_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the controller's parameters that were given by an option of their own."""
    given = {
        **_options.following_parameters(options),
        'xy_goal_tolerance': options.tolerance,
        'controller': options.controller,
        'path_controller': options.path_controller,
        'path_speed': options.speed,
    }
    if options.heading is not None:
        given['use_goal_heading'] = True
    return {name: value for name, value in given.items() if value is not None}


def _picture(recording: Recording) -> Path:
    return recording.bag.with_name(recording.bag.name + '.png')


def _save(recording: Recording, *, plot: bool, replace: bool) -> int:
    """Write the bag and its picture, and print their names; return the exit code."""
    from diffdrive_jacobian.bags.bag_reader import BagError
    from diffdrive_jacobian.bags.run import read_run
    from diffdrive_jacobian.plots.run_figure import draw
    from diffdrive_jacobian.recording.recording import RecordingError

    code = _cli.DONE
    try:
        with busy(PROGRAM, f'writing {recording.bag}'):
            recording.finish()
        print(f'recorded: {recording.bag}')
    except RecordingError as error:
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        if error.summary is None:
            return _cli.FAILED
        print(f'recorded in part: {recording.bag}')
        code = _cli.FAILED
    if not plot:
        return code
    picture = _picture(recording)
    try:
        with busy(PROGRAM, f'drawing {picture}'):
            draw([read_run(recording.bag)], picture, replace=replace)
        print(f'drawn: {picture}')
    except ModuleNotFoundError:
        print(f'not drawn: {NO_MATPLOTLIB}')
    except (OSError, BagError) as error:
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        return _cli.FAILED
    return code


def _print_outcome(outcome: Outcome, options: argparse.Namespace) -> int:
    """Print the end of a drive in one line; return the exit code."""
    if outcome.pose is None:
        where = 'the robot published no odometry'
    else:
        x, y, theta = outcome.pose
        point = f' with the driven point (x {outcome.offset:g} m in the body frame)'
        point = point if outcome.offset else ''
        simulated = ' of simulated time' if options.lockstep else ''
        distances = describe_distances(outcome.distance, outcome.true_distance) + point
        if options.path is not None:
            side = 'from' if outcome.arrived else 'before'
            distances = f'{outcome.distance:.3f} m {side} the end of the path'
            if not math.isnan(outcome.across):
                distances += f', after at most {outcome.across:.3f} m from it'
            if not math.isnan(outcome.true_distance):
                distances += f' by odometry, truly {outcome.true_distance:.3f} m from its end'
        did = 'still moved' if outcome.moving else 'stopped'
        where = (
            f'the robot {did} at x {x:.3f} m, y {y:.3f} m, heading {theta:.3f} rad, {distances}, '
            f'after {outcome.seconds:.1f} s{simulated}'
        )
    if outcome.arrived:
        print(f'arrived: {where}')
        if outcome.distance > outcome.tolerance:
            print(
                f'the robot rolled out of the tolerance of {outcome.tolerance:g} m: the parameters '
                'stop_in_time and trans_stopped_velocity avoid that'
            )
        return _cli.DONE
    if outcome.interrupted:
        print(f'interrupted: {where}')
        return _cli.INTERRUPTED
    print(f'not arrived ({_reason(outcome, options.timeout)}): {where}')
    return _cli.FAILED


def _reason(outcome: Outcome, timeout: float) -> str:
    """Return why the robot did not arrive."""
    from action_msgs.msg import GoalStatus

    if outcome.seconds > timeout:
        return f'--timeout {timeout:g} s was too short'
    reasons = {
        GoalStatus.STATUS_ABORTED: 'goal refused or aborted',
        GoalStatus.STATUS_CANCELED: 'goal canceled by another process',
    }
    return reasons.get(outcome.status, 'ROS was shut down')


def _print_goal_end(end: GoalEnd) -> None:
    """Print the end of a goal in one line."""
    from diffdrive_jacobian.messages.goal_status import GoalState

    ends = {
        GoalState.SUCCEEDED: 'arrived',
        GoalState.CANCELED: 'canceled',
        GoalState.ABORTED: 'refused or aborted',
    }
    where = 'there is no odometry'
    if end.pose is not None:
        x, y, theta = end.pose
        where = (
            f'the robot is at x {x:.3f} m, y {y:.3f} m, heading {theta:.3f} rad, '
            f'{describe_distances(end.distance, end.true_distance)}'
        )
    robot = '' if end.robot == '/' else f'{end.robot}: '
    print(f'{robot}goal ({end.goal[0]:g}, {end.goal[1]:g}) {ends[end.state]}: {where}', flush=True)


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} (X Y [X Y ...] | --path PATH) [options] [--ros-args ...]',
        description='Drive the virtual robot to goals, in order, or along a path: robot, controller and '
        'wheel bridge in one process, the whole Jacobian chain in use. Exit code 0: arrived; 1: not '
        'arrived, or the recording is not complete; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument(
        'coordinates',
        metavar='X Y',
        nargs='*',
        type=_options.coordinate,
        help='x and y of each goal (m)',
    )
    _options.add_timeout(
        parser, 'longest duration of the drive, of all goals together (s)', default=300.0
    )
    _options.add_value(
        parser,
        '--tolerance',
        'M',
        'distance to a goal that counts as arrived (m) (default: 0.02, unless a file sets it)',
        kind=_options.tolerance,
    )
    _options.add_heading(parser, 'heading at the last goal (rad) (default: any)')
    _options.add_controller(
        parser,
        CONTROLLERS,
        'controller: %(choices)s (default: go_to_goal, unless a file names another)',
    )
    _options.add_path(parser, '--path', 'drive along a path: ')
    _options.add_value(
        parser,
        '--speed',
        'M/S',
        'speed along a path without times (m/s) (default: 0.2, unless a file sets it)',
    )
    parser.add_argument(
        '--path-controller',
        choices=ALL_PATH_CONTROLLERS,
        metavar='NAME',
        help='controller of the path: %(choices)s (default: pure_pursuit, unless a file names another)',
    )
    _options.add_following(parser)
    _options.add_params_file(parser)
    _options.add_output(
        parser,
        'BAG',
        'directory of the rosbag2 bag to record to; the picture is BAG.png (default: drive_DATE-TIME)',
        kind=_options.bag_folder,
    )
    _options.add_force(parser, 'BAG and BAG.png, at the end of the drive')
    parser.add_argument('--no-record', action='store_true', help='neither record nor draw')
    _options.add_no_plot(parser, 'record, but do not draw')
    parser.add_argument(
        '--lockstep',
        action='store_true',
        help='drive in simulated time, as fast as possible, with the same result each time',
    )
    parser.add_argument(
        '--open',
        action='store_true',
        help='let other processes (RViz, ros2 topic) communicate with the nodes (default: isolated, so '
        'that no real robot on the network can be moved by mistake)',
    )
    parser.add_argument(
        '--live',
        action='store_true',
        help='show the drive on a page in the browser and steer the robot there, until Ctrl-C; without '
        'X Y the robot waits for goals; the bag is recorded, no picture is drawn',
    )
    _options.add_page(parser)
    return parser
