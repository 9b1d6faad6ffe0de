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

"""Drive the virtual robot to goals or along a path, with robot and controller in one process."""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Sequence
from contextlib import closing
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
from diffdrive_jacobian.text import how_to_get_ros
from diffdrive_jacobian.tools import _cli, _output, watch_run
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, INTERRUPTED, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.drives import Outcome
    from diffdrive_jacobian.live.robot_state import GoalEnd
    from diffdrive_jacobian.recording.recording import Recording

PROGRAM = 'drive_to'
DRIVES = 'whoever knows this address can steer the robot; it goes on after the goals, until Ctrl-C'
Goals: TypeAlias = NDArray[np.float64] | PlannedPath


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments, parameters=NODE_PARAMETERS)
    _check(parser, options)
    heading = parser.given_heading(options)
    path = None if options.path is None else parser.given_path(options)
    share = parser.given_share(options)
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.drives import DriveError, drive, waypoints_through
        from diffdrive_jacobian.drives.driving import has_ros
        from diffdrive_jacobian.recording.recording import open_recording, saved_on_error

    if not has_ros():
        _check_without_ros(options)
    goals: Goals = np.empty((0, 3))
    if path is not None:
        goals = path
    elif options.coordinates:
        goals = waypoints_through(np.reshape(options.coordinates, (-1, 2)), heading or 0.0)
    recording = None
    if not options.no_record:
        recording = open_recording(
            'drive', options.output, lossless=options.lockstep, replace=options.force
        )
    picture = None if recording is None or options.no_plot or options.live else _picture(recording)
    if recording is not None and picture and os.path.lexists(picture) and not options.force:
        recording.discard()
        raise UserError(f'{picture} exists already; {NOT_OVERWRITTEN}')
    ros = ['--ros-args', '--log-level', 'warn', '--', *options.ros]
    how: dict[str, Any] = {
        'relative': path is not None and _cli.is_relative(options.path),
        'lockstep': options.lockstep,
        'isolated': not options.open,
        'parameters': _controller_parameters(options),
        'robot_parameters': _cli.following_parameters(options),
        'recording': recording,
        'ros_arguments': ros,
        'signals': signals,
    }
    code = FAILED
    with saved_on_error(recording):
        try:
            if options.live:
                code = _drive_with_page(goals, options, {**how, 'share': share})
            else:
                with closing(_Progress(goals, options, ros)) as progress:
                    outcome = drive(goals, timeout=options.timeout, progress=progress, keep=False, **how)
                code = _print_outcome(outcome, options)
        except DriveError as error:
            # The recording shows what led to it.
            _output.complain(PROGRAM, error)
    if recording is None:
        return code
    saved = _save(recording, picture, replace=options.force)
    # An interruption remains one.
    return code if code == INTERRUPTED else saved or code


def _check(parser: _cli.Parser, options: argparse.Namespace) -> None:
    """Refuse options that have no effect, or exclude each other."""
    if len(options.coordinates) % 2:
        parser.error(f'coordinates must be pairs X Y, got {len(options.coordinates)} of them')
    if options.path is None:
        for option in ('--speed', '--trajectory', '--path-controller'):
            parser.refuse_without(options, option, '--path')
    elif options.coordinates or options.heading is not None:
        parser.error('--path excludes X Y and --heading')
    parser.refuse_with(options, '--speed', '--trajectory')
    for option in ('--output', '--force', '--no-plot'):
        parser.refuse_with(options, option, '--no-record')
    parser.refuse_without(options, '--force', '--output')
    if options.lockstep and options.open:
        parser.error('--lockstep and --open exclude each other: other processes have another clock')
    if not options.live:
        for option in ('--robots', '--share'):
            parser.refuse_without(options, option, '--live')
        if not options.coordinates and options.path is None:
            parser.error(
                'the following arguments are required: X Y or --path (only --live needs no goal)'
            )
        if options.port or options.no_browser:
            parser.error('--port and --no-browser are options of --live')
    elif options.timeout != parser.get_default('timeout'):
        parser.error('--timeout has no effect with --live, which ends by Ctrl-C')
    parser.refuse_with(options, '--no-plot', '--live')


def _check_without_ros(options: argparse.Namespace) -> None:
    """Say that no nodes run, and refuse what needs them."""
    if options.open:
        raise UserError(f'--open needs ROS 2, there is no Python module rclpy: {how_to_get_ros()}')
    _output.note(PROGRAM, 'ROS 2 is not available: the same robot drives by the same laws without nodes')


def _drive_with_page(goals: Goals, options: argparse.Namespace, how: dict[str, Any]) -> int:
    """Drive with the page until Ctrl-C; return the exit code. `how`: arguments of `drive`."""
    given = len(options.coordinates) > 0 or options.path is not None
    with watch_run.explaining_page_errors(options):
        from diffdrive_jacobian.drives.driving import has_ros

        if has_ros():
            from diffdrive_jacobian.live.node import drive_live
        else:
            from diffdrive_jacobian.live.value_page import drive_live
        from diffdrive_jacobian.live.page_drive import PageDrive

        sent = drive_live(
            PageDrive(
                goals=goals,
                port=options.port,
                ready=watch_run.announcing(
                    options,
                    waiting='the drive starts' if given else '',
                    notice=DRIVES if given else watch_run.STEERS,
                ),
                nodes_created=lambda names: _cli.warn_of_unused_files(
                    PROGRAM, how['ros_arguments'], names
                ),
                goal_ended=_print_goal_end,
                robots=options.robots or 1,
                **how,
            )
        )
    if not sent:
        return _output.complain(PROGRAM, 'no page was open: nothing was sent, and nothing drove', FAILED)
    return DONE


class _Progress(_output.GoalBar):
    """Prints the progress of a drive."""

    def __init__(self, goals: Goals, options: argparse.Namespace, ros: Sequence[str]) -> None:
        super().__init__((lambda: self._seconds) if options.lockstep else time.monotonic)
        self._goals, self._path, self._ros = goals, options.path, ros
        self._seconds = 0.0

    def nodes_created(self, names: Sequence[str]) -> None:
        _cli.warn_of_unused_files(PROGRAM, self._ros, names)

    def driving(self, seconds: float, index: int, distance: float, wheels: tuple[float, float]) -> None:
        self._seconds = seconds
        what = f'path {self._path}'
        if not isinstance(self._goals, PlannedPath):
            x, y, _ = self._goals[index]
            what = f'goal {index + 1}/{len(self._goals)} ({x:g}, {y:g})'
        self.show_goal(what, distance, wheels)


def _controller_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the controller's parameters that were given by an option of their own."""
    given = {
        **_cli.following_parameters(options),
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


def _save(recording: Recording, picture: Path | None, *, replace: bool) -> int:
    """Write the bag and its picture, and print their names; return the exit code."""
    from diffdrive_jacobian.bags.bag_reader import BagError
    from diffdrive_jacobian.bags.run import read_run
    from diffdrive_jacobian.plots.rendering import write
    from diffdrive_jacobian.plots.run_pictures import run_figure
    from diffdrive_jacobian.recording.recording import RecordingError

    code = DONE
    try:
        with _output.busy(PROGRAM, f'writing {recording.bag}'):
            recording.finish()
        print(f'recorded: {recording.bag}')
    except RecordingError as error:
        code = _output.complain(PROGRAM, error, FAILED)
        if error.summary is None:
            return code
        print(f'recorded in part: {recording.bag}')
    if picture is None:
        return code
    try:
        with _output.busy(PROGRAM, f'drawing {picture}'):
            write(run_figure(read_run(recording.bag)), picture, replace=replace)
        print(f'drawn: {picture}')
    except ModuleNotFoundError:
        print(f'not drawn: {_output.NO_MATPLOTLIB}')
    except (OSError, BagError) as error:
        return _output.complain(PROGRAM, error, FAILED)
    return code


def _describe_distances(distance: float, true_distance: float, *, path: bool = False) -> str:
    """Return how far a robot is from its goal (m), in words. A true distance of NaN is not known."""
    what = 'end of the path' if path else 'goal'
    if math.isnan(true_distance):
        return f'{distance:.3f} m from the {what}'
    return f'{distance:.3f} m from the {what} by odometry, {true_distance:.3f} m by ground truth'


def _print_outcome(outcome: Outcome, options: argparse.Namespace) -> int:
    """Print the end of a drive in one line; return the exit code."""
    if outcome.pose is None:
        where = 'the robot published no odometry'
    else:
        x, y, theta = outcome.pose
        point = f' with the driven point (x {outcome.offset:g} m in the body frame)'
        point = point if outcome.offset else ''
        simulated = ' of simulated time' if options.lockstep else ''
        distances = _describe_distances(outcome.distance, outcome.true_distance) + point
        if options.path is not None:
            place = outcome.distance, outcome.across, outcome.late
            distances = _output.where_on_path(*place, arrived=outcome.arrived)
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
                'stop_in_time and trans_stopped_velocity avoid that, if go_to_goal knows the limits of '
                'the robot and wheel_bridge has none of its own'
            )
        return DONE
    if outcome.interrupted:
        print(f'interrupted: {where}')
        return INTERRUPTED
    print(f'not arrived ({_reason(outcome, options.timeout)}): {where}')
    return FAILED


def _reason(outcome: Outcome, timeout: float) -> str:
    """Return why the robot did not arrive."""
    from diffdrive_jacobian.messages.goal_status import GoalState

    if outcome.seconds > timeout:
        return f'--timeout {timeout:g} s was too short'
    reasons = {
        GoalState.ABORTED: 'goal refused or aborted',
        GoalState.CANCELED: 'goal canceled by another process',
    }
    return reasons.get(GoalState(outcome.status), 'ROS was shut down')


def _print_goal_end(end: GoalEnd) -> None:
    """Print the end of a goal or path in one line."""
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
            f'{_describe_distances(end.distance, end.true_distance, path=end.path)}'
        )
    robot = '' if end.robot == '/' else f'{end.robot}: '
    what = 'path to' if end.path else 'goal'
    x, y, _ = (end.goal.round(6) + 0.0).tolist()
    print(f'{robot}{what} ({x:g}, {y:g}) {ends[end.state]}: {where}', flush=True)


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
        type=_cli.coordinate,
        help='x and y of each goal (m)',
    )
    parser.add_timeout('longest duration of the drive, of all goals together (s)', default=300.0)
    parser.add_value(
        '--tolerance',
        'M',
        'distance to a goal that counts as arrived (m) (default: 0.02, unless a file sets it)',
        kind=_cli.tolerance,
    )
    parser.add_heading(
        'heading at the last goal (rad) (default: any; 0 if the controller always takes one, as pose)'
    )
    parser.add_argument(
        '--controller',
        choices=CONTROLLERS,
        metavar='NAME',
        help='controller: %(choices)s (default: go_to_goal, unless a file names another)',
    )
    parser.add_path('--path', 'drive along a path: ')
    parser.add_value(
        '--speed',
        'M/S',
        'speed along a path without times (m/s) (default: 0.2, unless a file sets it)',
    )
    parser.add_trajectory()
    parser.add_argument(
        '--path-controller',
        choices=ALL_PATH_CONTROLLERS,
        metavar='NAME',
        help='controller of the path: %(choices)s (default: pure_pursuit, unless a file names another)',
    )
    parser.add_following()
    parser.add_params_file()
    parser.add_output(
        'BAG',
        'directory of the rosbag2 bag to record to; the picture is BAG.png (default: drive_DATE-TIME)',
        kind=_cli.bag_folder,
    )
    parser.add_force('BAG and BAG.png, at the end of the drive')
    parser.add_argument('--no-record', action='store_true', help='neither record nor draw')
    parser.add_argument('--no-plot', action='store_true', help='record, but do not draw')
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
    parser.add_value(
        '--robots',
        'N',
        'with --live: this many robots side by side, 1 to 16 (default: 1)',
        kind=_cli.integer_from(1, 16),
    )
    parser.add_page()
    return parser
