"""The commands that an installation offers. Signals are caught before anything slow is imported."""

from __future__ import annotations

import importlib
import os
import sys

from diffdrive_jacobian.ros.signals import Signals

ROS_MODULES = (
    *('rclpy', 'action_msgs', 'builtin_interfaces', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces'),
    *('rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'unique_identifier_msgs'),
)
"""Modules that come with a ROS installation, or with the extra `jazzy`."""


def _run(module: str, function: str, *arguments: str) -> int:
    program = arguments[0] if arguments else module
    signals = Signals()
    signals.catch()
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Started without it, as by cron; what we load writes there all the same.
            setattr(sys, name, open(os.devnull, 'w'))  # noqa: SIM115
    try:
        run = getattr(importlib.import_module(f'diffdrive_jacobian.tools.{module}'), function)
        code: int = run(*arguments, sys.argv[1:], signals)
        sys.stdout.flush()
    except BrokenPipeError:
        # Who read our output went away (as `head` does): nobody is left to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except ModuleNotFoundError as error:
        if error.name not in ROS_MODULES:
            raise
        print(
            f'{program}: error: ROS 2 is not available, there is no Python module {error.name}: source '
            'the setup file of a ROS 2 Jazzy installation (. /opt/ros/jazzy/setup.bash), or call '
            "pip install '.[jazzy]' in a clone of diffdrive_jacobian",
            file=sys.stderr,
        )
        code = 1
    except OSError as error:
        print(f'{program}: error: {error}', file=sys.stderr)
        code = 1
    finally:
        signals.ignore()
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


def record_run() -> int:
    """Run the tool record_run."""
    return _run('record_run', 'main')


def replay_run() -> int:
    """Run the tool replay_run."""
    return _run('replay_run', 'main')


def recover_run() -> int:
    """Run the tool recover_run."""
    return _run('recover_run', 'main')


def plot_run() -> int:
    """Run the tool plot_run."""
    return _run('plot_run', 'main')


def sweep_gains() -> int:
    """Run the tool sweep_gains."""
    return _run('sweep_gains', 'main')
