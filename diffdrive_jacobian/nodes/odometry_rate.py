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

"""The rate at which odometry is received, measured at the beginning of each goal."""

from __future__ import annotations

import math
from itertools import pairwise

PERIODS = 10
"""Number of periods from which it is measured."""


class OdometryRate:
    """The rate of the odometry, by the times of its first messages after `begin`."""

    def __init__(self) -> None:
        """Start without messages."""
        self.hz = math.inf
        """The rate (Hz); before it was measured that of the goal before, or infinite."""
        self.measured = False
        """Whether it was measured since `begin`."""
        self._times: list[int] = []

    def begin(self) -> None:
        """Measure it anew."""
        self._times.clear()
        self.measured = False

    def receive(self, now: int) -> bool:
        """Take the time of a message (ns). Return whether the rate is measured now, and another one."""
        self._times.append(now)
        if len(self._times) <= PERIODS:
            return False
        # The median is not affected by a gap or by messages that arrive together.
        period = sorted(b - a for a, b in pairwise(self._times))[PERIODS // 2]
        before, self.hz = self.hz, 1e9 / period if period > 0 else math.inf
        self.measured = True
        return self.hz != before and not 0.8 < self.hz / before < 1.25
