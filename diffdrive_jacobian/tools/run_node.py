"""Run one node as its own process: what `virtual_robot`, `go_to_goal` and `wheel_bridge` start."""

from __future__ import annotations

import argparse
import importlib
import textwrap
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from diffdrive_jacobian.nodes.parameters import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.ros.parameters import NodeParameters, specifications
from diffdrive_jacobian.ros.runner import UserError, ros_context, running
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._unused_files import warn_of_unused_files

NODES: dict[str, tuple[str, type[NodeParameters]]] = {
    'virtual_robot': ('VirtualRobot', VirtualRobotParameters),
    'go_to_goal': ('GoToGoal', GoToGoalParameters),
    'wheel_bridge': ('WheelBridge', WheelBridgeParameters),
}
"""Name of a node, which is that of its module, to its class and its parameters."""


def run_node(name: str, arguments: Sequence[str], signals: Signals) -> int:
    """Run a node until a signal comes; gives the exit code.

    Args:
        name: One of NODES; also the program's name in messages.
        arguments: The command line without the program's name.
        signals: What was caught so far.
    """
    class_name, parameters = NODES[name]
    # Only the one that runs, for each costs time at the start.
    make = getattr(importlib.import_module(f'diffdrive_jacobian.nodes.{name}'), class_name)
    own, ros = _cli.split_arguments(arguments)
    options = _cli.parse(_parser(name, make, parameters), own)
    ros = _cli.with_params_file(ros, options)
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


def _parser(name: str, node: Any, parameters: type[NodeParameters]) -> argparse.ArgumentParser:
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
        description=textwrap.dedent('    ' + (node.__doc__ or '')),
        epilog='\n'.join(['parameters:', *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _cli.add_params_file(parser)
    return parser
