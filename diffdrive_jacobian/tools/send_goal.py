"""Send a goal to a controller in another process, and wait until it has ended."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _options, _sending
from diffdrive_jacobian.tools._startup import long_lived

PROGRAM = 'send_goal'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
    heading = _options.given_heading(parser, options)
    _cli.refuse_with(parser, options, '--timeout', '--no-wait')
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.nodes.remote_goal import send_goal

    return _sending.send(
        PROGRAM,
        f'goal ({options.x:g}, {options.y:g})',
        send_goal,
        options,
        ros,
        signals,
        goal=[options.x, options.y, heading or 0.0],
        heading_matters=heading is not None,
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
            axis, metavar=axis.upper(), type=_options.coordinate, help=f'{axis} of the goal (m)'
        )
    _options.add_heading(
        parser,
        'heading at the goal (rad), used if the controller has use_goal_heading or is pose '
        '(default: 0.0)',
    )
    _sending.add_options(parser, 'goal_pose', 'goal')
    return parser
