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

"""Where a world stops in the debugger."""

from __future__ import annotations

import sys
from bdb import BdbQuit
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.time_units import in_seconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.world import Lockstep


class Pauses:
    """When a world stops, and what is known there.

    Attributes:
        times: World times before which it stops (ns), sorted.
        what: What this world is.
        said: The last messages of nodes that are apart, by topic; None: no node is.
        violated: What a property has raised at the prompt.
    """

    def __init__(self, world: Lockstep) -> None:
        """Start without pauses."""
        self._world = world
        self.times: list[int] = []
        self.what = 'the world'
        self.said: dict[str, Any] | None = None
        self.violated: Exception | None = None

    def add(self, time: int) -> None:
        """Add a pause before a world time (ns)."""
        self.times = sorted([*self.times, time])

    def pause(self, coming: int) -> None:
        """Stop before a world time (ns) at which a pause is due. Raise afterwards what was violated."""
        while self.times and self.times[0] <= coming:
            self.times.pop(0)
        self.violated = None
        stop(self._world, coming, self.what, self.said)
        if self.violated is not None:
            raise self.violated


def stop(world: Lockstep, coming: int, what: str, said: dict[str, Any] | None) -> None:
    """Stop in the debugger, which shows the variables of this function."""
    lines = [
        f'{what} is paused at {in_seconds(world.world_time)}, before {in_seconds(coming)}: '
        'world.step() goes on to there, c to the end',
        *(f'pid {process.pid}: {process.command}' for process in world.processes),
    ]
    if said is not None:
        lines.append(
            'the variable said has the last messages of the nodes under test; the other nodes receive '
            'those of the first world'
        )
    try:
        breakpoint(header='\n'.join(lines))
    except TypeError:
        # Not every debugger has a place for a text.
        breakpoint()
    # You are here. The test is further up in the stack.
    world.settle()


def ends_all(error: BaseException) -> bool:
    """Return whether an exception ends the program, whoever runs: Ctrl-C, or `q` in a debugger."""
    pytest = sys.modules.get('pytest')
    by_pytest = pytest is not None and isinstance(error, pytest.exit.Exception)
    return by_pytest or isinstance(error, (KeyboardInterrupt, BdbQuit))
