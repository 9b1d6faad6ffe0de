"""Statistics of delays in bounded memory: number, maximum and percentiles."""

from __future__ import annotations

import math
from collections import Counter

from diffdrive_jacobian.numerics.fields import between

_BITS = 4
"""Bits of a delay, after the leading one, that a bin of the histogram keeps."""


class Lateness:
    """A histogram of delays (ns) with logarithmic bins, each at most 1/16 of its value wide.

    There are at most a thousand bins, however many delays are counted.
    """

    def __init__(self) -> None:
        """Start without delays."""
        self.count = 0
        """Number of delays."""
        self.maximum = 0
        """The largest delay (ns); 0 without any."""
        self._bins: Counter[int] = Counter()

    def add(self, delay: int) -> None:
        """Count a delay (ns); a negative one counts as zero."""
        delay = max(delay, 0)
        shift = max(delay.bit_length() - _BITS - 1, 0)
        self._bins[delay >> shift << shift] += 1
        self.count += 1
        self.maximum = max(self.maximum, delay)

    def percentile(self, percent: float) -> float:
        """Return a percentile of the delays (ns), at most 1/16 too small. NaN without any delay.

        Raises:
            ValueError: `percent` is not in [0, 100].
        """
        between(0.0, 100.0)('percent', percent)
        if not self.count:
            return math.nan
        rank = max(math.ceil(percent / 100.0 * self.count), 1)
        counted = 0
        for delay in sorted(self._bins):
            counted += self._bins[delay]
            if counted >= rank:
                break
        return float(delay)
