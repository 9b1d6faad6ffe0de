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

"""Send a path to a controller in another process, and wait until it has ended."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import long_lived
from diffdrive_jacobian.tools.send_goal import add_options, send

PROGRAM = 'send_path'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments)
    parser.refuse_with(options, '--timeout', '--no-wait')
    path = parser.given_path(options)
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS.
        from diffdrive_jacobian.nodes.remote_goal import send_goal

    relative = _cli.is_relative(options.path) and not options.frame
    what = f'path {options.path}'
    return send(PROGRAM, what, send_goal, options, signals, goal=path, relative=relative)


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} PATH [options] [--ros-args ...]',
        description='Send a path to a running go_to_goal and wait until it has ended. Ctrl-C cancels '
        'it. A shape begins at the robot, unless a frame is given. Exit code 0: arrived; 1: not '
        'arrived; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_path('path')
    parser.add_trajectory()
    parser.refuse(
        '--speed',
        why='the speed along a path is the parameter path_speed of the controller, or that of '
        '--trajectory',
    )
    add_options(parser, 'path', 'path')
    return parser
