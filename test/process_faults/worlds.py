"""Worlds of processes for campaigns, which print nothing and let processes live longer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import partialmethod
from io import StringIO
from pathlib import Path
from unittest import mock

from support import processes
from support.harness import Harness
from support.processes import Child, World, open_world

LIFE = 900.0
"""How long a process may live (s)."""
PATIENCE = 120.0
"""How long a condition may take to come true (s): campaigns run beside other work, at low priority."""


@contextmanager
def quiet_world(folder: Path, life: float = LIFE) -> Iterator[World]:
    """Open a world whose processes may live so long (s). It prints nothing at its end."""
    until = partialmethod(Harness.until, patience=PATIENCE)
    with (
        mock.patch.object(processes, 'LIMIT', life),
        mock.patch.object(processes, 'PATIENCE', PATIENCE),
        mock.patch.object(Harness, 'until', until),
        mock.patch.object(Child, 'exit', partialmethod(Child.exit, patience=PATIENCE)),
        ExitStack() as stack,
    ):
        world = stack.enter_context(open_world(folder))
        try:
            yield world
        finally:
            with redirect_stdout(StringIO()):
                stack.close()
