"""Recording a world: what failed tests and findings keep."""

from __future__ import annotations

from collections.abc import Callable

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.topics import Selection
from diffdrive_jacobian.recording.recorder import Recorder
from diffdrive_jacobian.recording.recording import Recording


def record_world(world: Lockstep, recording: Recording) -> Callable[[], int]:
    """Record all topics of a world from now on.

    Returns:
        The clock of the recorder (ns): world time, from what the clock of the nodes shows now. So the
        order remains where that jumps back.
    """
    offset = world.now - world.world_time

    def now() -> int:
        return offset + world.world_time

    recorder = Recorder(Selection(everything=True), recording, now=now)
    world.add(recorder, observer=True)
    world.on_new_topics(recorder.discover)
    recorder.discover()
    return now
