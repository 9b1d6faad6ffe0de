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

"""Progress of a replay. Imports no ROS: a tool that has to start fast shows it."""

from __future__ import annotations


class ReplayProgress:
    """Receives the progress of a replay, and pauses it. This one shows nothing and does not pause."""

    def waiting(self, reason: str) -> None:
        """Receive what is waited for, many times a second."""

    def started(self, seconds: float) -> None:
        """Receive the length of what is played (s), once."""

    def playing(self, seconds: float, *, paused: bool) -> None:
        """Receive the position in it (s), many times a second."""

    def toggled(self) -> bool:
        """Return whether to pause, or to resume. It is called many times a second."""
        return False

    def ended(self) -> None:
        """Receive that playback has ended, if it started."""
