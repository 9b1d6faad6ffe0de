"""A world that is open to nodes in other processes on this machine."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._external import External
from diffdrive_jacobian.lockstep._external_answers import Expectation
from diffdrive_jacobian.lockstep._external_process import ExternalProcess, free_domain
from diffdrive_jacobian.lockstep._messaging import Messaging
from diffdrive_jacobian.numerics.fields import integer
from diffdrive_jacobian.ros.fastdds_profiles import open_to_others
from diffdrive_jacobian.ros.runner import DISCOVERY, MAX_DOMAIN_ID


class Processes(Messaging):
    """Starting processes, and awaiting what they send. Base class of `Lockstep`."""

    _closing: ExitStack

    def __init__(self, start: int) -> None:
        """Start at a time (ns)."""
        super().__init__(start)
        self._variables_of_others: dict[str, str] = {}
        self._directory: Path | None = None

    def _variables(self, external: object, domain_id: int | None) -> Mapping[str, str | None]:
        """Return the environment variables for the context. None: not set.

        Raises:
            ValueError: `domain_id` is invalid, or the world is not open.
        """
        isolated = dict.fromkeys(DISCOVERY)
        if external is None:
            if domain_id is not None:
                raise ValueError(
                    f'domain_id is for a world with external=, got {domain_id!r} for an isolated one'
                )
            return {**isolated, DISCOVERY[0]: 'OFF'}
        if domain_id is None:
            domain_id = free_domain()
        domain_id = integer('domain_id', domain_id, 0, MAX_DOMAIN_ID)
        self._variables_of_others = {DISCOVERY[0]: 'LOCALHOST', 'ROS_DOMAIN_ID': str(domain_id)}
        # Read with the first participant of this process.
        open_to_others()
        return {**isolated, **self._variables_of_others}

    def _open_to(self, external: Iterable[Expectation]) -> None:
        """Await messages of other processes."""
        directory = tempfile.TemporaryDirectory(prefix='lockstep')
        self._directory = Path(self._closing.enter_context(directory))
        self._external = External(
            self.node, self._executor, self._traffic, self._watched, self.report, lambda: self._now
        )
        self._closing.callback(self._external.close)
        self._external.declare(external)

    @property
    def domain_id(self) -> int:
        """ROS domain of the external nodes.

        Raises:
            LockstepError: The world is isolated.
        """
        return int(self.environment['ROS_DOMAIN_ID'])

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for a process that is to be discovered, besides those of this one.

        Raises:
            LockstepError: The world is isolated.
        """
        self._opened()
        return dict(self._variables_of_others)

    def start(
        self,
        *command: str | os.PathLike[str],
        answers: Iterable[Expectation] = (),
        use_sim_time: bool = True,
        cwd: str | os.PathLike[str] | None = None,
        env: Mapping[str, str] | None = None,
    ) -> ExternalProcess:
        """Start a process in the ROS domain of this world. When the world is closed, it is ended
        with all that it has started.

        Args:
            command: The program and its arguments: `'ros2', 'run', 'my_package', 'my_node'`.
            answers: What is awaited from it, as for `external`, until the test ends it.
            use_sim_time: Whether to add `--ros-args -p use_sim_time:=true` to the command.
            cwd: Its working directory; None: that of this process.
            env: Further environment variables.

        Returns:
            The process. It runs, but is not discovered yet: see `connect`.

        Raises:
            LockstepError: The world is isolated, or the process cannot be started.
            ValueError: `answers` is invalid.
        """
        external, directory = self._opened()
        if not command:
            raise LockstepError('start takes a program and its arguments, got none')
        arguments = [os.fspath(part) for part in command]
        if use_sim_time:
            arguments += ['--ros-args', '-p', 'use_sim_time:=true']
        process = ExternalProcess(
            arguments,
            {**self._variables_of_others, **(env or {})},
            directory,
            None if cwd is None else os.fspath(cwd),
        )
        external.waiting.processes.append(process)
        external.declare(answers, process)
        return process

    def _opened(self) -> tuple[External, Path]:
        self._check_open()
        if self._external is None or self._directory is None:
            raise LockstepError('this Lockstep is isolated: give it external=[...]')
        return self._external, self._directory
