"""The commands that an installation offers. Signals are caught before anything slow is imported."""

from __future__ import annotations

import importlib
import os
import select
import sys
from functools import partial

from diffdrive_jacobian.signals import Signals

INTERRUPTED = 130
ROS_MODULES = (
    *('rclpy', 'action_msgs', 'builtin_interfaces', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces'),
    *('rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'unique_identifier_msgs'),
)
"""Modules that come with a ROS installation, or with the extra `jazzy`."""


def _run_tool(module: str) -> int:
    """Run a tool; a second signal ends it even if it does not react."""
    return _run(module, 'main', watched=True)


def _run(module: str, function: str, *arguments: str, watched: bool = False) -> int:
    program = arguments[0] if arguments else module
    signals = Signals()
    signals.catch()
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Started without it, as by cron; what we load writes there all the same.
            setattr(sys, name, open(os.devnull, 'w'))  # noqa: SIM115
    try:
        run = getattr(importlib.import_module(f'diffdrive_jacobian.tools.{module}'), function)
        if watched:
            signals.exit_on_second(partial(_exit, module))
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


def _exit(program: str) -> None:
    """End the process without clean-up, and report that."""
    line = f'{program}: ended by a second signal, before it could finish\n'
    error = sys.stderr.fileno()
    # Whoever should read it may have stopped reading.
    if select.select([], [error], [], 0.0)[1]:
        os.write(error, line.encode())
    os._exit(INTERRUPTED)


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
    return _run_tool('drive_to')


def send_goal() -> int:
    """Run the tool send_goal."""
    return _run_tool('send_goal')


def record_run() -> int:
    """Run the tool record_run."""
    return _run_tool('record_run')


def replay_run() -> int:
    """Run the tool replay_run."""
    return _run_tool('replay_run')


def verify_run() -> int:
    """Run the tool verify_run."""
    return _run_tool('verify_run')


def recover_run() -> int:
    """Run the tool recover_run."""
    return _run_tool('recover_run')


def plot_run() -> int:
    """Run the tool plot_run."""
    return _run_tool('plot_run')


def sweep_gains() -> int:
    """Run the tool sweep_gains."""
    return _run_tool('sweep_gains')
