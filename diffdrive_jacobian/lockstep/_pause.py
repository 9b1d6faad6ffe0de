"""Where a world stops in the debugger."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian.time_units import in_seconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.world import Lockstep


def pause(world: Lockstep, coming: int) -> None:
    """Stop in the debugger, before a world time (ns)."""
    lines = [
        f'{world.paused_as} is paused at {in_seconds(world.world_time)}, before '
        f'{in_seconds(coming)}: world.step() goes on to there, c to the end',
        *(f'pid {process.pid}: {process.command}' for process in world.processes),
    ]
    try:
        breakpoint(header='\n'.join(lines))
    except TypeError:
        # Not every debugger has a place for a text.
        breakpoint()
    # You are here. The test is further up in the stack.
    world.settle()
