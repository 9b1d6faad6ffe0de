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

"""The arguments of `Lockstep.start`, and the process that they start."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._simulated_time import checked_nanoseconds
from diffdrive_jacobian.lockstep.external import relays
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.external.wall_time import WALL_TIMES
from diffdrive_jacobian.ros.fastdds_profiles import for_other_process
from diffdrive_jacobian.text import printable

SYNCHRONOUS = {'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS'}
"""Environment of processes: a thread of Fast DDS would publish later what is published at once."""


@dataclass(kw_only=True)
class Command:
    """How a process is started: the arguments of `Lockstep.start`."""

    command: Sequence[str | os.PathLike[str]]
    use_sim_time: bool
    cwd: str | os.PathLike[str] | None
    env: Mapping[str, str]
    clock_period: float
    queue_depth: int
    timeout: float
    patience: float
    wall_time: str
    without: Collection[str]

    def __post_init__(self) -> None:
        """Check the command."""
        command = [] if isinstance(self.command, (str, bytes, os.PathLike)) else self.command
        if not (isinstance(command, Sequence) and command and all(map(_is_text, command))):
            raise _error(
                "start takes a program and its arguments, ['ros2', 'run', 'my_package', 'my_node']",
                self.command,
            )
        if not (self.cwd is None or _is_text(self.cwd)):
            raise _error('cwd must be a path', self.cwd)
        if self.cwd is not None and not os.path.isdir(self.cwd):
            raise _error('cwd must be a folder that exists', self.cwd)
        if not isinstance(self.use_sim_time, bool):
            raise _error('use_sim_time must be True or False', self.use_sim_time)
        if not isinstance(self.env, Mapping) or not all(map(_is_variable, self.env.items())):
            raise _error("env must be names with texts, {'NAME': 'value'}", self.env)
        if any(self.env.get(name, value) != value for name, value in SYNCHRONOUS.items()):
            raise _error(f'env must not differ from {SYNCHRONOUS}: messages would be lost', self.env)
        depth = self.queue_depth
        if isinstance(depth, bool) or not isinstance(depth, int) or not 0 < depth < relays.DEPTH:
            raise _error(f'queue_depth must be an integer from 1 to {relays.DEPTH - 1}', depth)
        if isinstance(self.without, str) or not all(str(one).startswith('/') for one in self.without):
            raise _error("without must be names of topics, ['/diagnostics']", self.without)
        if self.wall_time not in WALL_TIMES:
            raise _error(f'wall_time must be {" or ".join(WALL_TIMES)}', self.wall_time)
        for name in ('clock_period', 'timeout', 'patience'):
            checked_nanoseconds(name, getattr(self, name))

    def start(self, environment: Mapping[str, str], rules: Sequence[str]) -> ExternalProcess:
        """Start the process, with environment variables for it, and further arguments."""
        timed = ('--ros-args', '-p', 'use_sim_time:=true') if self.use_sim_time else ()
        hash_seed = {} if 'PYTHONHASHSEED' in os.environ else {'PYTHONHASHSEED': '0'}
        return ExternalProcess(
            [*(os.fspath(part) for part in self.command), *timed],
            {**environment, **for_other_process(), **hash_seed, **SYNCHRONOUS, **self.env},
            None if self.cwd is None else os.fspath(self.cwd),
            rules,
        )


def _error(allowed: str, got: object) -> LockstepError:
    return LockstepError(f'{allowed}, got {printable(repr(got), 200)}')


def _is_text(value: Any) -> bool:
    """Return whether a value is a text, or a path, that can be passed to a process."""
    return isinstance(value, (str, os.PathLike)) and '\0' not in str(os.fspath(value))


def _is_variable(item: tuple[Any, Any]) -> bool:
    """Return whether a name and a value are those of an environment variable."""
    name, value = item
    if not (isinstance(name, str) and isinstance(value, str)):
        return False
    return bool(name) and '=' not in name and '\0' not in name + value
