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

"""How often something may happen."""

from __future__ import annotations


class TokenBucket:
    """Permits `burst` events at once, then one for each `period`."""

    def __init__(self, burst: float, period: float) -> None:
        """Start with a full bucket.

        Args:
            burst: Number of events that are permitted at once.
            period: Time after which one more is permitted (s).
        """
        self._burst = burst
        self._period = period
        self._tokens = float(burst)
        self._updated = 0.0

    def permits(self, now: float) -> bool:
        """Return whether an event is permitted at a time (s, monotonic), and count it if so."""
        self._tokens = min(self._burst, self._tokens + (now - self._updated) / self._period)
        self._updated = now
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
