"""Send a goal to a controller in another process, and wait until it has ended."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._startup import long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.nodes.remote_goal import GoalResult

PROGRAM = 'send_goal'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
    heading = _cli.given_heading(parser, options)
    _cli.refuse_with(parser, options, '--timeout', '--no-wait')
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.nodes.remote_goal import send_goal

    try:
        with _Progress(f'goal ({options.x:g}, {options.y:g})') as progress:
            result = send_goal(
                [options.x, options.y, heading or 0.0],
                frame=options.frame,
                readers=options.readers or 1,
                patience=options.wait,
                timeout=options.timeout,
                follow=not options.no_wait,
                heading_matters=heading is not None,
                ros_arguments=ros,
                signals=signals,
                progress=progress,
            )
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    print(*_report(result, options), sep='\n')
    if result.interrupted:
        return _cli.INTERRUPTED
    return _cli.DONE if result.arrived or result.acknowledged else _cli.FAILED


class _Progress:
    """Prints the progress of a goal."""

    def __init__(self, goal: str) -> None:
        # Slow to import.
        from diffdrive_jacobian.tools._progress import Drive
        from diffdrive_jacobian.tools._waiting import Waiting

        self._goal = goal
        self._bar = Drive()
        self._waiting = Waiting()

    def __enter__(self) -> _Progress:
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.__exit__()

    def waiting(self, reason: str) -> None:
        self._waiting.show(reason)

    def heading_ignored(self, controller: str) -> None:
        print(
            f'{PROGRAM}: warning: {printable(controller)} ignores --heading: set its parameter '
            'use_goal_heading to true, or its controller to pose',
            file=sys.stderr,
            flush=True,
        )

    def driving(self, distance: float) -> None:
        self._bar.show(self._goal, distance)

    def no_odometry(self, topic: str, seconds: float) -> None:
        print(f'no odometry on {topic} for {seconds:g} s: is the robot running?', flush=True)

    def standing(self, seconds: float) -> None:
        print(f'the robot has not moved for {seconds:g} s: call doctor to find out why', flush=True)


def _report(result: GoalResult, options: argparse.Namespace) -> list[str]:
    """Return lines that describe what became of a goal."""
    from diffdrive_jacobian.nodes.remote_goal import ANSWER_PATIENCE, Result

    where = '' if result.distance is None else f', {result.distance:.3f} m from the goal'
    lines = {
        Result.NOT_SENT: f'not sent within {options.wait:g} s: {result.reason}',
        Result.UNCONFIRMED: f'sent, but not acknowledged by every subscription to {result.topic}',
        Result.SENT: f'sent: goal ({options.x:g}, {options.y:g}) on {result.topic}',
        Result.NO_ANSWER: f'no answer: the controller published no goal_status within '
        f'{ANSWER_PATIENCE:g} s',
        Result.ENDED: f'{_end(result)}{where}{_hint(result)}',
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
        stopped = f'{_end(result)}: no odometry was received, so it is not known whether a robot drove'
    else:
        stopped = f'{_end(result)}: the robot was stopped'
    return [line, stopped] if line else [stopped]


def _end(result: GoalResult) -> str:
    from action_msgs.msg import GoalStatus

    return {
        GoalStatus.STATUS_SUCCEEDED: 'arrived',
        GoalStatus.STATUS_CANCELED: 'canceled',
        GoalStatus.STATUS_ABORTED: 'aborted',
    }.get(result.status, '')


def _hint(result: GoalResult) -> str:
    return {
        'aborted': " (the controller's log says why)",
        'canceled': ' (by another process, by commands of another node, replaced by another goal, or '
        'because the controller was shut down)',
    }.get(_end(result), '')


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} X Y [options] [--ros-args ...]',
        description='Send a goal to a running go_to_goal and wait until it has ended. Ctrl-C cancels '
        'the goal. Exit code 0: arrived; 1: not arrived; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument('x', metavar='X', type=_cli.coordinate, help='x of the goal (m)')
    parser.add_argument('y', metavar='Y', type=_cli.coordinate, help='y of the goal (m)')
    _cli.add_wait_matching(parser, 'goal_pose has', '1')
    _cli.add_heading(
        parser, 'heading at the goal (rad), used if the controller has use_goal_heading (default: 0.0)'
    )
    parser.add_argument(
        '--frame', default='', help='frame of the goal (default: the frame of the odometry)'
    )
    parser.add_argument(
        '--wait',
        metavar='SECONDS',
        type=_cli.positive,
        default=10.0,
        help='longest wait for a controller and for the subscriptions of -w (s) (default: 10.0)',
    )
    parser.add_argument(
        '--timeout',
        metavar='SECONDS',
        type=_cli.positive,
        default=math.inf,
        help='cancel the goal after this time (s) (default: never)',
    )
    parser.add_argument(
        '--no-wait', action='store_true', help='only send the goal, do not wait until it has ended'
    )
    return parser
