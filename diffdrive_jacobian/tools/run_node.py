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

"""Run one node in a process of its own: the programs virtual_robot, go_to_goal and wheel_bridge."""

from __future__ import annotations

import argparse
import importlib
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, long_lived


class Program(NamedTuple):
    """The program that runs a node."""

    class_name: str
    """Name of the class of the node, in the module with the name of the program."""
    description: str
    """Description for --help."""


NODES: dict[str, Program] = {
    'virtual_robot': Program(
        'VirtualRobot',
        'Simulate a differential-drive robot. Subscribes to cmd_vel or joint_command. Publishes odom, '
        'joint_states, cmd_vel_out, start_pose and TF. initialpose and reset_odometry set its pose. A '
        'command takes effect on receipt, or at its stamp if it has one. cmd_vel_out is each command '
        'as applied, start_pose is the pose and time of the last reset of the odometry. Together they '
        'determine the whole motion.',
    ),
    'go_to_goal': Program(
        'GoToGoal',
        'Drive a robot to goals. Subscribes to odom, goal_pose, goals and path. Publishes cmd_vel and '
        'goal_status. The service cancel_goal cancels a goal. While a goal is active, each odometry '
        'message is answered by one command. Without a goal nothing is published on cmd_vel, so that '
        'other nodes can drive.',
    ),
    'wheel_bridge': Program(
        'WheelBridge',
        'Convert body twists to wheel speeds. Subscribes to cmd_vel. Publishes joint_command. Each '
        'command gives one message with the same stamp, or with the time of receipt if it has none. '
        'When no more commands are received, one zero command follows after the timeout.',
    ),
}
"""Name of a node and of its module to its program."""


def run_node(name: str, arguments: Sequence[str], signals: Signals) -> int:
    """Run a node until a signal is caught; return the exit code.

    Args:
        name: One of NODES, also the name of the program in messages.
        arguments: The command line without the program's name.
        signals: Counter of the signals.
    """
    program = NODES[name]
    own, ros = _cli.split_arguments(arguments)
    if own:
        # Not otherwise: to create the parser describes all parameters, which takes time.
        hint = 'send_goal X Y sends a goal' if name == 'go_to_goal' else ''
        try:
            parameters = parameters_of(name).at_start(_chosen(ros))
        except ParameterError as error:
            return _output.complain(name, error)
        ros = _parser(name, program, parameters).parse(arguments, parameters=[parameters], hint=hint).ros
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS. Only the node that runs: each takes time to import.
        from diffdrive_jacobian.ros.runner import ros_context, running

        create = getattr(importlib.import_module(f'diffdrive_jacobian.nodes.{name}'), program.class_name)
    try:
        with (
            ros_context([name, *ros]) as context,
            running(context, isolated=False) as runner,
        ):
            with long_lived():
                node = runner.add(lambda: create(context=context))
            _cli.warn_of_unused_files(name, ros, [node.get_fully_qualified_name()])
            runner.spin(lambda: False, signals=signals)
    except UserError as error:
        return _output.complain(name, error)
    return DONE


def _chosen(ros: Sequence[str]) -> dict[str, str]:
    """Return the controllers among the parameters that ROS arguments give: they have gains."""
    texts = [text for flag, text in pairwise(ros) if flag in ('-p', '--param') and ':=' in text]
    given = dict(text.split(':=', 1) for text in texts)
    return {name: given[name] for name in ('controller', 'path_controller') if name in given}


def parameters_of(name: str) -> NodeParameters:
    """Return the parameters of one of NODES, without an import of ROS or of those of other nodes."""
    module = importlib.import_module(f'diffdrive_jacobian.parameters.{name}')
    parameters: NodeParameters = getattr(module, f'{NODES[name].class_name}Parameters')()
    return parameters


def _parser(name: str, program: Program, parameters: NodeParameters) -> _cli.Parser:
    parser = _cli.Parser(
        prog=name,
        usage=f'{name} [-h] [--params-file FILE | --robot NAME] '
        '[--ros-args -p PARAMETER:=VALUE -r NAME:=NAME ...]',
        description=textwrap.fill(program.description, 90),
        epilog=_description(parameters),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_params_file()
    return parser


def _description(parameters: NodeParameters) -> str:
    """Return the description of all parameters."""
    lines, indent = ['parameters:'], ' ' * 6
    for ros_name, one in parameters.declared().items():
        allowed = f' Must be {one.allowed}.' if one.allowed else ''
        text = f'{one.description}{allowed} (default: {one.default})'
        wrapped = textwrap.wrap(text, 90, initial_indent=indent, subsequent_indent=indent)
        lines += [f'  {ros_name}', *wrapped]
    return '\n'.join(lines)
