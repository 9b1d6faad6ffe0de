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
