"""The processes of a world."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

from diffdrive_jacobian.lockstep.external.node_process import Command, NodeProcess, Surroundings
from diffdrive_jacobian.lockstep.external.process import end_all
from diffdrive_jacobian.lockstep.external.quiet import check_platform


class Processes:
    """The processes that a test has started."""

    def __init__(self) -> None:
        """Start without processes."""
        self.all: list[NodeProcess] = []
        """In the order in which they were started."""
        self._closing = ExitStack()
        self._directory: Path | None = None

    def start(self, command: Command, surroundings: Surroundings) -> NodeProcess:
        """Start a process, and add its nodes to the world, as `Lockstep.start`."""
        check_platform()
        if self._directory is None:
            folder = self._closing.enter_context(tempfile.TemporaryDirectory(prefix='lockstep'))
            self._directory = Path(folder)
        process = NodeProcess(command, surroundings, self._directory)
        process.start()
        self.all.append(process)
        process.join()
        return process

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
        self._closing.close()
