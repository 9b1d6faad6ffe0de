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

"""Runs recorded in lockstep, for the tests of bags."""

from __future__ import annotations

from contextlib import contextmanager

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording


class LockstepRecording:
    """Records what is said in a world from its making on."""

    def __init__(self, world, path, **selection):
        self.world = world
        self.recording = Recording(path, lossless=True)
        self.recorder = world.add(Recorder(Selection(**selection), self.recording))

    def look(self):
        """Find what is new; what was published before is lost, unless it is latched."""
        self.recorder.discover()
        self.world.settle()

    def finish(self):
        """Make the bag; gives it read."""
        self.world.remove(self.recorder)
        self.summary = self.recording.finish()
        return read_run(self.recording.bag)


@contextmanager
def recorded(world, path, **kwargs):
    """Record what the nodes of a world do within the block; the run is the `run` of what it gives."""
    made = LockstepRecording(world, path, **kwargs)
    made.look()
    yield made
    made.run = made.finish()
