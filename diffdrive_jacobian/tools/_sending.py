"""What send_goal and send_path have in common: options, progress, and the report of the end."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli, _options
from diffdrive_jacobian.tools._messages import Waiting

if TYPE_CHECKING:
    from diffdrive_jacobian.nodes.remote_goal import GoalResult


def add_options(parser: _cli.Parser, topic: str, what: str) -> None:
    """Add the options of sending `what`, a goal or a path, on a topic."""
    _options.add_wait_matching(parser, f'{topic} has', '1')
    parser.add_argument(
        '--frame', default='', help=f'frame of the {what} (default: the frame of the odometry)'
    )
    _options.add_value(
        parser,
        '--wait',
        'SECONDS',
        'longest wait for a controller and for the subscriptions of -w (s)',
        default=10.0,
    )
    _options.add_timeout(parser, f'cancel the {what} after this time (s) (default: never)')
    parser.add_argument(
        '--no-wait', action='store_true', help=f'only send the {what}, do not wait until it has ended'
    )


def send(
    program: str,
    what: str,
    sending: Callable[..., GoalResult],
    options: argparse.Namespace,
    ros: Sequence[str],
    signals: Signals,
    **arguments: Any,
) -> int:
    """Send, follow and report; return the exit code.

    Args:
        program: Name of the program.
        what: What is sent, in words.
        sending: `send_goal` or `send_path`.
        options: The options of `add_options`.
        ros: ROS arguments.
        signals: Counter of the signals that cancel it.
        arguments: Further arguments of `sending`.
    """
    options.timeout = math.inf if options.timeout is None else options.timeout
    try:
        with Progress(program, what) as progress:
            result = sending(
                frame=options.frame,
                readers=options.readers or 1,
                patience=options.wait,
                timeout=options.timeout,
                follow=not options.no_wait,
                ros_arguments=ros,
                signals=signals,
                progress=progress,
                **arguments,
            )
    except UserError as error:
        return _cli.complain(program, error)
    print(*report(result, options, what), sep='\n')
    if result.interrupted:
        return _cli.INTERRUPTED
    return _cli.DONE if result.arrived or result.acknowledged else _cli.FAILED


class Progress:
    """Prints the progress of a goal or a path."""

    def __init__(self, program: str, goal: str) -> None:
        # Slow to import.
        from diffdrive_jacobian.tools._progress import GoalBar

        self._program, self._goal = program, goal
        self._bar = GoalBar()
        self._waiting = Waiting()

    def __enter__(self) -> Progress:
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.__exit__()

    def waiting(self, reason: str) -> None:
        self._waiting.show(reason)

    def heading_ignored(self, controller: str) -> None:
        print(
            f'{self._program}: warning: {printable(controller)} ignores --heading: set its parameter '
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


def report(result: GoalResult, options: argparse.Namespace, what: str) -> list[str]:
    """Return lines that describe what became of a goal or a path, `what` in words."""
    from diffdrive_jacobian.nodes.remote_goal import ANSWER_PATIENCE, Result

    where = ''
    if result.across is not None:
        side = 'from' if result.arrived else 'before'
        where = f', {result.distance:.3f} m {side} the end, at most {result.across:.3f} m from the path'
    elif result.topic.endswith('path'):
        where = ''
    elif result.distance is not None:
        where = f', {result.distance:.3f} m from the goal'
    lines = {
        Result.NOT_SENT: f'not sent within {options.wait:g} s: {result.reason}',
        Result.UNCONFIRMED: f'sent, but not acknowledged by every subscription to {result.topic}',
        Result.SENT: f'sent: {what} on {result.topic}',
        Result.NO_ANSWER: f'no answer: the controller published no goal_status within '
        f'{ANSWER_PATIENCE:g} s',
        Result.ENDED: f'{result.status.word}{where}{_hint(result)}',
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


def _hint(result: GoalResult) -> str:
    return {
        GoalState.ABORTED: " (the controller's log says why)",
        GoalState.CANCELED: ' (by another process, by commands of another node, replaced by another '
        'goal, or because the controller was shut down)',
    }.get(result.status, '')
