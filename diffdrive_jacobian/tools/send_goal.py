"""Send a goal to a controller that runs in another process, and wait for the end."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import numpy as np

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli

PROGRAM = 'send_goal'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    options = _parser().parse_args(own)
    # Now, for --help needs no ROS.
    from diffdrive_jacobian.ros.goal_sender import GoalSender
    from diffdrive_jacobian.ros.runner import ros_context, running
    from diffdrive_jacobian.tools._following import follow

    goal = np.array([options.x, options.y, options.heading])
    try:
        with (
            ros_context([PROGRAM, *ros]) as context,
            running(context, closed_world=False) as runner,
        ):
            sender = runner.add(lambda: GoalSender(goal, options.frame, context, options.readers or 1))
            return follow(sender, runner, signals, options)
    except UserError as error:
        return _cli.complain(PROGRAM, error)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} X Y [options] [--ros-args ...]',
        description='Send a goal to a running go_to_goal and wait for the end. Ctrl-C cancels the '
        'goal. Exit code 0: arrived; 1: not; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument('x', metavar='X', type=_cli.coordinate, help='goal (m)')
    parser.add_argument('y', metavar='Y', type=_cli.coordinate, help='goal (m)')
    _cli.add_wait_matching(parser, 'goal_pose has', 'one without it')
    parser.add_argument(
        '--heading',
        type=_cli.heading,
        default=0.0,
        help='heading at the goal (rad), 0 without it; counts if the controller has use_goal_heading',
    )
    parser.add_argument(
        '--frame', default='', help="frame of the goal; without it the odometry's is meant"
    )
    parser.add_argument(
        '--wait',
        type=_cli.positive,
        default=10.0,
        help='wait up to this time for a controller and for the readers of -w (s) (default: 10.0)',
    )
    parser.add_argument(
        '--timeout',
        type=_cli.positive,
        default=math.inf,
        help='cancel the goal and give up after this long (s); default: never',
    )
    parser.add_argument(
        '--no-wait', action='store_true', help='only send the goal, do not wait for the end'
    )
    return parser
