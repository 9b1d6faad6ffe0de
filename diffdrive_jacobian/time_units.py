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

"""Units of time: seconds as floats in parameters and arguments, integer nanoseconds in timestamps."""

from __future__ import annotations

NANOSECONDS = 1_000_000_000
"""Nanoseconds per second."""


def nanoseconds(seconds: float) -> int:
    """Return a duration in nanoseconds, rounded to the nearest.

    A duration other than zero stays at least 1 ns long: a timeout of 0 means that there is none.

    Args:
        seconds: The duration; finite (s).
    """
    try:
        rounded = round(seconds * NANOSECONDS)
    except OverflowError:
        # The product is infinite.
        rounded = int(seconds) * NANOSECONDS
    return rounded or (seconds > 0.0) - (seconds < 0.0)


def seconds(nanoseconds: int) -> float:
    """Return a duration in seconds.

    Args:
        nanoseconds: The duration (ns).
    """
    return nanoseconds / NANOSECONDS


def in_seconds(time: int) -> str:
    """Return a time (ns) in seconds, as text, in as many digits as it has."""
    return f'{time / NANOSECONDS:.9f}'.rstrip('0').rstrip('.') + ' s'
