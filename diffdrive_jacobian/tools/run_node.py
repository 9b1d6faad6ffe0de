"""Run one node as its own process: what `virtual_robot`, `go_to_goal` and `wheel_bridge` start."""

from __future__ import annotations

import argparse
import importlib
import textwrap
from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.declaration import NodeParameters, specifications
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._unused_files import warn_of_unused_files


class Program(NamedTuple):
    """The program that runs a node."""

    class_name: str
    """Class of the node."""
    parameters: type[NodeParameters]
    """Its parameters."""
    description: str
    """What --help says; the node's own module is imported only when the node runs."""


NODES: dict[str, Program] = {
    'virtual_robot': Program(
        'VirtualRobot',
        VirtualRobotParameters,
        'Simulate a differential-drive robot: cmd_vel or joint_command in; odom, joint_states, '
        'cmd_vel_out, start_pose and TF out; initialpose and reset_odometry place it. A command takes '
        'effect on receipt, or at its stamp if it has one. cmd_vel_out is each command as applied, '
        'start_pose where and when the odometry was last reset: together the whole motion.',
    ),
    'go_to_goal': Program(
        'GoToGoal',
        GoToGoalParameters,
        'Drive a robot to goals: odom, goal_pose and goals in; cmd_vel and goal_status out; '
        'cancel_goal stops. While a goal is active, every odometry message is answered by one '
        'command; without a goal nothing is published, so that others may drive.',
    ),
    'wheel_bridge': Program(
        'WheelBridge',
        WheelBridgeParameters,
        'Convert body twists to wheel speeds: cmd_vel in, joint_command out. Each command gives one '
        'message with the same stamp (without a stamp: the time of receipt). When commands cease, one '
        'zero follows after the timeout.',
    ),
}
"""Name of a node, which is that of its module, to its program."""


def run_node(name: str, arguments: Sequence[str], signals: Signals) -> int:
    """Run a node until a signal comes; return the exit code.

    Args:
        name: One of NODES; also the program's name in messages.
        arguments: The command line without the program's name.
        signals: Signals that were caught so far.
    """
    program = NODES[name]
    own, ros = _cli.split_arguments(arguments)
    ros = _cli.with_params_file(ros, _cli.parse(_parser(name, program), own))
    # Now, for --help needs no ROS; and only the node that runs, for each costs time at the start.
    from diffdrive_jacobian.ros.runner import ros_context, running

    make = getattr(importlib.import_module(f'diffdrive_jacobian.nodes.{name}'), program.class_name)
    try:
        with (
            ros_context([name, *ros]) as context,
            running(context, closed_world=False) as runner,
        ):
            node = runner.add(lambda: make(context=context))
            warn_of_unused_files(name, ros, [node.get_fully_qualified_name()])
            runner.spin(lambda: signals.count > 0)
    except UserError as error:
        return _cli.complain(name, error)
    return _cli.DONE


def _parser(name: str, program: Program) -> argparse.ArgumentParser:
    parameters = program.parameters
    defaults = {field.name: field.default for field in fields(parameters)}
    lines = []
    for ros_name, (field, specification) in specifications(parameters).items():
        text = f'{specification.description} Default {defaults[field]}'
        text += f'; {specification.allowed}.' if specification.allowed else '.'
        lines += [
            f'  {ros_name}',
            *textwrap.wrap(text, 90, initial_indent='      ', subsequent_indent='      '),
        ]
    parser = argparse.ArgumentParser(
        prog=name,
        usage=f'{name} [-h] [--params-file FILE] [--ros-args -p PARAMETER:=VALUE -r NAME:=NAME ...]',
        description=textwrap.fill(program.description, 90),
        epilog='\n'.join(['parameters:', *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _cli.add_params_file(parser)
    return parser
