"""The processes of a world."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError, described
from diffdrive_jacobian.lockstep.external.node_process import Command, NodeProcess, Surroundings
from diffdrive_jacobian.lockstep.external.process import end_all
from diffdrive_jacobian.lockstep.external.quiet import check_platform


class Processes:
    """The processes that a test has started."""

    def __init__(self) -> None:
        """Start without processes."""
        self.all: list[NodeProcess] = []
        """In the order in which they were started."""
        self._directory: tempfile.TemporaryDirectory[str] | None = None

    def create(
        self,
        command: Sequence[str | os.PathLike[str]],
        surroundings: Surroundings,
        *,
        use_sim_time: bool,
        cwd: str | os.PathLike[str] | None,
        env: Mapping[str, str] | None,
        clock_period: float,
        timeout: float,
        patience: float,
        queue_depth: int,
    ) -> NodeProcess:
        """Return a process that is not started yet, as `Lockstep.start`."""
        check_platform()
        if isinstance(command, (str, os.PathLike)) or not command:
            raise LockstepError(
                "start takes a program and its arguments, ['ros2', 'run', 'my_package', 'my_node'], got "
                f'{described(command)}'
            )
        arguments = [os.fspath(part) for part in command]
        if use_sim_time:
            arguments += ['--ros-args', '-p', 'use_sim_time:=true']
        if self._directory is None:
            self._directory = tempfile.TemporaryDirectory(prefix='lockstep')
        return NodeProcess(
            Command(
                arguments=arguments,
                directory=Path(self._directory.name),
                cwd=None if cwd is None else os.fspath(cwd),
                variables=dict(env or {}),
                clock_period=clock_period,
                timeout=timeout,
                patience=patience,
                queue_depth=queue_depth,
                timed=use_sim_time,
            ),
            surroundings,
        )

    def check(self) -> None:
        """Check that all run, and have sent nothing while nothing was delivered to them."""
        for process in self.all:
            process.check()

    def describe(self) -> list[str]:
        """Return the states of the processes."""
        return [process.describe() for process in self.all]

    def close(self) -> None:
        """End the processes."""
        end_all([process.child for process in self.all])
        for process in self.all:
            process.close()
        if self._directory is not None:
            self._directory.cleanup()
