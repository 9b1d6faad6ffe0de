"""Send a path to a controller in another process, and wait until it has ended."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _options, _sending
from diffdrive_jacobian.tools._startup import long_lived

PROGRAM = 'send_path'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
    _cli.refuse_with(parser, options, '--timeout', '--no-wait')
    path = _options.given_path(parser, options)
    if options.speed is not None:
        path = path.timed(options.speed)
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.nodes.remote_goal import send_goal

    return _sending.send(
        PROGRAM,
        f'path {options.path}',
        send_goal,
        options,
        ros,
        signals,
        goal=path,
        relative=_options.is_relative(options.path) and not options.frame,
    )


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} PATH [options] [--ros-args ...]',
        description='Send a path to a running go_to_goal and wait until it has ended. Ctrl-C cancels '
        'it. A shape begins at the robot, unless a frame is given. Exit code 0: arrived; 1: not '
        'arrived; 2: wrong arguments; 130: interrupted.',
    )
    _options.add_path(parser, 'path')
    _options.add_value(
        parser,
        '--speed',
        'M/S',
        'send a trajectory with this speed: poses with stamps (m/s) (default: a path without times)',
    )
    _sending.add_options(parser, 'path', 'path')
    return parser
