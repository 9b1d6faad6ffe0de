"""The commands that an installation offers. Signals are caught before anything slow is imported."""

from __future__ import annotations

import importlib
import sys

from diffdrive_jacobian.ros.signals import Signals, ignore_from_now_on


def _run(module: str, function: str, *arguments: str) -> int:
    with Signals() as signals:
        run = getattr(importlib.import_module(f'diffdrive_jacobian.tools.{module}'), function)
        code: int = run(*arguments, sys.argv[1:], signals)
        ignore_from_now_on()
    return code


def virtual_robot() -> int:
    """Run the node virtual_robot."""
    return _run('run_node', 'run_node', 'virtual_robot')


def go_to_goal() -> int:
    """Run the node go_to_goal."""
    return _run('run_node', 'run_node', 'go_to_goal')


def wheel_bridge() -> int:
    """Run the node wheel_bridge."""
    return _run('run_node', 'run_node', 'wheel_bridge')


def drive_to() -> int:
    """Run the tool drive_to."""
    return _run('drive_to', 'main')


def send_goal() -> int:
    """Run the tool send_goal."""
    return _run('send_goal', 'main')
