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

"""The programs of an installation, as functions. Signals are caught before anything slow is imported.

Each node in `NODES` is a program, and each other public module of this package, which must define
`main(arguments, signals)`. `entry_points.drive_to()` runs drive_to and returns the exit code.
"""

from __future__ import annotations

import errno
import gc
import importlib
import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from diffdrive_jacobian.ros.fastdds_profiles import open_to_others, receive_in_order
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import how_to_get_ros

DONE, FAILED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done, not done, wrong arguments, interrupted by a signal."""
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
BAG_MODULES = ('mcap', 'rosbags', 'apsw', 'backports', 'backports.zstd', 'lz4', 'ruamel', 'ruamel.yaml')
"""Modules that come with rosbags and mcap, which a ROS installation does not bring."""


def __getattr__(name: str) -> Callable[[], int]:
    """Return the function that runs a program.

    Raises:
        AttributeError: There is no such program.
    """
    if name in NODES or name in tools():
        return partial(_run, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    """Return the names of the module, with those of the programs."""
    return sorted({*globals(), *NODES, *tools()})


def tools() -> list[str]:
    """Return the names of the tools: those of the public modules beside this one."""
    files = (os.path.splitext(file) for file in os.listdir(os.path.dirname(__file__)))
    public = {name for name, ending in files if ending == '.py' and not name.startswith('_')}
    return sorted(public - {'entry_points', 'run_node'})


@contextmanager
def long_lived() -> Iterator[None]:
    """Create objects that last as long as the process, such as modules and nodes.

    The garbage collector would visit all of them again and again, and find nothing. It pauses here, and
    does not visit them later. This affects the whole process, so the library does not use it.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.freeze()
            gc.enable()


def _run(program: str) -> int:
    """Run a program with the command line of this process, and return the exit code."""
    end = partial(_exit, program, 'interrupted')
    signals = Signals(partial(os._exit, DONE) if program in UNTIL_SIGNAL else end)
    signals.catch()
    for name in ('stdout', 'stderr'):
        if getattr(sys, name) is None:
            # Started without it, as by cron. Imported modules write to it.
            for replaced in (name, f'__{name}__'):
                setattr(sys, replaced, open(os.devnull, 'w'))  # noqa: SIM115
    # What is published last is acknowledged before the process ends.
    receive_in_order() if program == 'record_run' else open_to_others()
    # A message class imports this package for one function. It does without the generator and the parser
    # of definitions, which take longer than to create a node, where they cannot be imported.
    if 'rosidl_generator_py' not in sys.modules:
        sys.modules['rosidl_generator_py.generate_py_impl'] = None  # type: ignore[assignment]
    # OpenBLAS starts a thread for each further core when NumPy is imported, each of which is busy for
    # milliseconds. The matrices of a robot are too small for threads.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    try:
        with long_lived(), signals.ending_at_once():
            module = 'run_node' if program in NODES else program
            run = importlib.import_module(f'diffdrive_jacobian.tools.{module}')
        if program in NODES:
            code: int = run.run_node(program, sys.argv[1:], signals)
        else:
            why = 'ended by a second signal, before it could finish'
            signals.exit_on_second(partial(_exit, program, why))
            code = run.main(sys.argv[1:], signals)
    except BrokenPipeError:
        # The reader of the output is gone, as `head` when it has enough.
        _discard_output()
        code = FAILED
    except ModuleNotFoundError as error:
        remedy = _remedy(error.name)
        if remedy is None:
            raise
        print(f'{program}: error: {remedy}', file=sys.stderr)
        code = FAILED
    except OSError as error:
        # Of files the name is known. The output need not be buffered.
        of_output = error.filename is None and error.errno in (errno.ENOSPC, errno.EIO, errno.EFBIG)
        why = f'{OUTPUT_ERROR}: {error.strerror}' if of_output else str(error)
        print(f'{program}: error: {why}', file=sys.stderr)
        code = FAILED
    finally:
        signals.ignore()
    try:
        sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f'{program}: error: {OUTPUT_ERROR}: {error.strerror}', file=sys.stderr)
        _discard_output()
        code = FAILED
    return code


def _discard_output() -> None:
    """Discard what could not be written, which the interpreter would try again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _remedy(module: str | None) -> str | None:
    """Return what to do about a Python module that is missing. None: it can only be a defect."""
    if module in ROS_MODULES:
        return f'ROS 2 is not available, there is no Python module {module}: {how_to_get_ros()}'
    if module in BAG_MODULES:
        return f'there is no Python module {module}: call pip install rosbags mcap'
    return None


def _exit(program: str, why: str) -> None:
    """End the process without clean-up, and print why."""
    error = sys.stderr.fileno()
    try:
        # Whoever reads it may have stopped reading.
        writable = bool(select.select([], [error], [], 0.0)[1])
    except OSError:
        # Windows asks sockets alone.
        writable = True
    if writable:
        os.write(error, f'{program}: {why}\n'.encode())
    os._exit(INTERRUPTED)
