"""The programs of an installation, as functions. Signals are caught before anything slow is imported.

Each node in `NODES` is a program, and each other public module of this package, which must define
`main(arguments, signals)`. `entry_points.drive_to()` runs drive_to and returns the exit code.
"""

from __future__ import annotations

import importlib
import os
import select
import sys
from collections.abc import Callable
from functools import partial

from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools._startup import (
    long_lived,
    without_blas_threads,
    without_message_generator,
)

DONE = 0
INTERRUPTED = 130
OUTPUT_ERROR = 'the standard output cannot be written'
NODES = ('virtual_robot', 'go_to_goal', 'wheel_bridge')
"""Programs that run a node."""
UNTIL_SIGNAL = (*NODES, 'watch_run')
"""Programs that run until a signal: it is no interruption."""
ROS_MODULES = (
    *('rclpy', 'action_msgs', 'builtin_interfaces', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces'),
    *('rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'unique_identifier_msgs'),
)
"""Modules of a ROS installation, or of the extra `jazzy`."""
ROSBAGS_MODULES = ('rosbags', 'apsw', 'backports', 'backports.zstd', 'lz4', 'ruamel', 'ruamel.yaml')
"""Modules that come with rosbags, which a ROS installation does not bring."""
_NO_TOOLS = ('__init__', 'entry_points', 'run_node')


def __getattr__(name: str) -> Callable[[], int]:
    """Return the function that runs a program.

    Raises:
        AttributeError: There is no such program.
    """
    if name in NODES:
        return partial(_run, 'run_node', 'run_node', name)
    if name in tools():
        return partial(_run, name, 'main', watched=True)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    """Return the names of the module, with those of the programs."""
    return sorted({*globals(), *NODES, *tools()})


def tools() -> list[str]:
    """Return the names of the tools: those of the public modules beside this one."""
    files = (os.path.splitext(file) for file in os.listdir(os.path.dirname(__file__)))
    return sorted(
        name
        for name, ending in files
        if ending == '.py' and not name.startswith('_') and name not in _NO_TOOLS
    )


def _run(module: str, function: str, *arguments: str, watched: bool = False) -> int:
    """Run a function of a module of this package; return the exit code.

    Args:
        module: The module.
        function: The function. It takes the arguments, the command line and the signals.
        arguments: The first of them is the name of the program (default: the module's).
        watched: Whether a second signal ends the process even if the function does not react.
    """
    program = arguments[0] if arguments else module
    if program in UNTIL_SIGNAL:
        signals = Signals(partial(os._exit, DONE))
    else:
        signals = Signals(partial(_exit, program, 'interrupted'))
    signals.catch()
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Started without it, as by cron. Imported modules write to it.
            for replaced in (name, f'__{name}__'):
                setattr(sys, replaced, open(os.devnull, 'w'))  # noqa: SIM115
    announce_frequently()
    without_message_generator()
    without_blas_threads()
    try:
        with long_lived(), signals.ending_at_once():
            run = getattr(importlib.import_module(f'diffdrive_jacobian.tools.{module}'), function)
        if watched:
            why = 'ended by a second signal, before it could finish'
            signals.exit_on_second(partial(_exit, program, why))
        code: int = run(*arguments, sys.argv[1:], signals)
    except BrokenPipeError:
        # The reader of the output is gone, as `head` when it has enough.
        _discard_output()
        code = 1
    except ModuleNotFoundError as error:
        remedy = _remedy(error.name)
        if remedy is None:
            raise
        print(f'{program}: error: {remedy}', file=sys.stderr)
        code = 1
    except OSError as error:
        print(f'{program}: error: {error}', file=sys.stderr)
        code = 1
    finally:
        signals.ignore()
    try:
        sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f'{program}: error: {OUTPUT_ERROR}: {error.strerror}', file=sys.stderr)
        _discard_output()
        code = 1
    return code


def _discard_output() -> None:
    """Discard what could not be written, which the interpreter would try again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _remedy(module: str | None) -> str | None:
    """Return what to do about a Python module that is missing. None: it can only be a defect."""
    if module in ROS_MODULES:
        return (
            f'ROS 2 is not available, there is no Python module {module}: source the setup file of a '
            'ROS 2 Jazzy installation (. /opt/ros/jazzy/setup.bash), or call '
            "pip install '.[jazzy]' in a clone of diffdrive_jacobian"
        )
    if module in ROSBAGS_MODULES:
        return f'there is no Python module {module}: call pip install rosbags'
    return None


def _exit(program: str, why: str) -> None:
    """End the process without clean-up, and print why."""
    line = f'{program}: {why}\n'
    error = sys.stderr.fileno()
    # Whoever reads it may have stopped reading.
    if select.select([], [error], [], 0.0)[1]:
        os.write(error, line.encode())
    os._exit(INTERRUPTED)
