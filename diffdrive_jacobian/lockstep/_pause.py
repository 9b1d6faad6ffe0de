"""Where a world stops in the debugger."""

from __future__ import annotations

import sys
from bdb import BdbQuit
from typing import TYPE_CHECKING

from diffdrive_jacobian.time_units import in_seconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.world import Lockstep


def pause(world: Lockstep, coming: int) -> None:
    """Stop in the debugger, before a world time (ns). What is violated there is raised afterwards."""
    said = world.said_apart
    lines = [
        f'{world.paused_as} is paused at {in_seconds(world.world_time)}, before '
        f'{in_seconds(coming)}: world.step() goes on to there, c to the end',
        *(f'pid {process.pid}: {process.command}' for process in world.processes),
    ]
    if said is not None:
        lines.append(
            'said has what the nodes under test say here; the others hear what they said at first'
        )
    world.violated = None
    try:
        breakpoint(header='\n'.join(lines))
    except TypeError:
        # Not every debugger has a place for a text.
        breakpoint()
    # You are here. The test is further up in the stack.
    world.settle()
    if world.violated is not None:
        raise world.violated


def ends_all(error: BaseException) -> bool:
    """Return whether an exception ends the program, whoever runs: Ctrl-C, or `q` in a debugger."""
    pytest = sys.modules.get('pytest')
    by_pytest = pytest is not None and isinstance(error, pytest.exit.Exception)
    return by_pytest or isinstance(error, (KeyboardInterrupt, BdbQuit))
