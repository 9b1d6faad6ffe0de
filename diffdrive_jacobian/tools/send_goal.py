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

"""Send a goal to a controller in another process, and wait until it has ended."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, INTERRUPTED, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.nodes.remote_goal import GoalResult

PROGRAM = 'send_goal'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments)
    heading = parser.given_heading(options)
    parser.refuse_with(options, '--timeout', '--no-wait')
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.nodes.remote_goal import send_goal

    return send(
        PROGRAM,
        f'goal ({options.x:g}, {options.y:g})',
        send_goal,
        options,
        signals,
        goal=[options.x, options.y, heading or 0.0],
        heading_matters=heading is not None,
    )


def send(
    program: str,
    what: str,
    sending: Callable[..., GoalResult],
    options: argparse.Namespace,
    signals: Signals,
    **arguments: Any,
) -> int:
    """Send, follow and report a goal or a path; return the exit code.

    Args:
        program: Name of the program.
        what: What is sent, in words.
        sending: `send_goal` or `send_path`.
        options: The options of `add_options`.
        signals: Counter of the signals that cancel it.
        arguments: Further arguments of `sending`.
    """
    options.timeout = math.inf if options.timeout is None else options.timeout
    with closing(Progress(program, what)) as progress:
        result = sending(
            frame=options.frame,
            readers=options.readers or 1,
            patience=options.wait,
            timeout=options.timeout,
            follow=not options.no_wait,
            ros_arguments=options.ros,
            signals=signals,
            progress=progress,
            **arguments,
        )
    print(*report(result, options, what), sep='\n')
    if result.interrupted:
        return INTERRUPTED
    return DONE if result.arrived or result.acknowledged else FAILED


class Progress(_output.GoalBar):
    """Prints the progress of a goal or a path."""

    def __init__(self, program: str, what: str) -> None:
        """Start without progress. Arguments as for `send`."""
        super().__init__()
        self._program, self._what = program, what
        self.waiting = _output.Waiting().show

    def heading_ignored(self, controller: str) -> None:
        """Warn that a controller ignores the heading."""
        _output.note(
            self._program,
            f'warning: {controller} ignores --heading: set its parameter use_goal_heading to true, or '
            'its controller to pose',
        )

    def driving(self, distance: float) -> None:
        """Show the distance to the goal (m)."""
        self.show_goal(self._what, distance)

    def no_odometry(self, topic: str, seconds: float) -> None:
        """Report that no odometry is received."""
        print(f'no odometry on {topic} for {seconds:g} s: is the robot running?', flush=True)

    def standing(self, seconds: float) -> None:
        """Report that the robot does not move."""
        print(f'the robot has not moved for {seconds:g} s: call doctor to find out why', flush=True)


def report(result: GoalResult, options: argparse.Namespace, what: str) -> list[str]:
    """Return lines that describe what became of a goal or a path, `what` in words."""
    from diffdrive_jacobian.nodes.remote_goal import ANSWER_PATIENCE, Result

    where = ''
    if result.across is not None:
        late = math.nan if result.late is None else result.late
        assert result.distance is not None
        place = result.distance, result.across, late
        where = f', {_output.where_on_path(*place, arrived=result.arrived)}'
    elif result.distance is not None and not result.topic.endswith('path'):
        where = f', {result.distance:.3f} m from the goal'
    reasons = {
        GoalState.ABORTED: " (the controller's log says why)",
        GoalState.CANCELED: ' (by another process, by commands of another node, replaced by another '
        'goal, or because the controller was shut down)',
    }
    lines = {
        Result.NOT_SENT: f'not sent within {options.wait:g} s: {result.reason}',
        Result.SEVERAL: f'not sent: {result.reason}',
        Result.UNCONFIRMED: f'sent, but not acknowledged by every subscription to {result.topic}',
        Result.SENT: f'sent: {what} on {result.topic}',
        Result.NO_ANSWER: f'no answer: the controller published no goal_status within '
        f'{ANSWER_PATIENCE:g} s; it was asked to cancel the goal',
        Result.ENDED: f'{result.status.word}{where}{reasons.get(result.status, "")}',
        Result.LOST: f'lost: {result.reason}{where}',
        Result.TIMEOUT: f'not arrived within --timeout {options.timeout:g} s{where}',
        Result.INTERRUPTED: 'interrupted: nothing was sent' if result.canceled is None else '',
    }
    line = lines[result.result]
    if result.canceled is None:
        return [line]
    if not result.canceled:
        stopped = 'the controller has not confirmed that it canceled: the robot may still drive'
    elif result.distance is None:
        stopped = (
            f'{result.status.word}: no odometry was received, so it is not known whether a robot drove'
        )
    else:
        _, _, rolls = result.reason.partition('; ')
        stopped = f'{result.status.word}: {rolls or "the robot was stopped"}'
    return [line, stopped] if line else [stopped]


def add_options(parser: _cli.Parser, topic: str, what: str) -> None:
    """Add the options of sending `what`, a goal or a path, on a topic."""
    parser.add_wait_matching(f'{topic} has', '1')
    parser.add_argument(
        '--frame', default='', help=f'frame of the {what} (default: the frame of the odometry)'
    )
    parser.add_value(
        '--wait',
        'SECONDS',
        'longest wait for a controller and for the subscriptions of -w (s)',
        default=10.0,
    )
    parser.add_timeout(f'cancel the {what} after this time (s) (default: never)')
    parser.add_argument(
        '--no-wait', action='store_true', help=f'only send the {what}, do not wait until it has ended'
    )


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} X Y [options] [--ros-args ...]',
        description='Send a goal to a running go_to_goal and wait until it has ended. Ctrl-C cancels '
        'the goal. Exit code 0: arrived; 1: not arrived; 2: wrong arguments; 130: interrupted.',
    )
    for axis in 'xy':
        parser.add_argument(
            axis, metavar=axis.upper(), type=_cli.coordinate, help=f'{axis} of the goal (m)'
        )
    parser.add_heading(
        'heading at the goal (rad), used if the controller has use_goal_heading or is pose '
        '(default: 0.0)'
    )
    add_options(parser, 'goal_pose', 'goal')
    return parser
