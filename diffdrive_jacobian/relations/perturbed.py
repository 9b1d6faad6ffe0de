"""Worlds in which rounding is a little larger: where they differ, rounding decides what is said."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any, ClassVar

from diffdrive_jacobian.messages.structure import Array, Number, Sequence, is_stamp, parts

PAIRS = 2
"""Number of pairs of worlds. In one of a pair each number grows by what it shrinks by in the other."""
AMPLITUDES = {'d': 1e-9, 'f': 1e-7}
"""Changes of numbers, relative to those above 1, by the code of their type."""


class Perturbed:
    """All that the nodes under test hear is changed a little: numbers, and stamps by 1 ns."""

    early: ClassVar[float] = 0.0
    late: ClassVar[float] = 0.0

    def __init__(self, seed: int, sign: float, tolerance: float) -> None:
        """Start with random numbers from a seed, each multiplied by a sign."""
        self._random, self._sign = random.Random(seed), sign
        self.tolerance = tolerance

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the message with changed numbers."""
        for kind, part in parts(message):
            if is_stamp(kind):
                # Zero: there is none.
                if part.nanosec:
                    part.nanosec += round(self._sign) * self._random.choice((-1, 1))
                continue
            for name, field in kind.fields:
                match field:
                    case Number(code='d' | 'f' as code):
                        setattr(part, name, self._changed(getattr(part, name), code))
                    case Array(Number(code='d' | 'f' as code)) | Sequence(
                        Number(code='d' | 'f' as code)
                    ):
                        values = getattr(part, name)
                        for index, value in enumerate(values):
                            values[index] = self._changed(float(value), code)
        return [(0.0, message)]

    def said(self, topic: str, message: Any) -> Any:
        """Return the message."""
        return message

    def _changed(self, value: float, code: str) -> float:
        amplitude = AMPLITUDES[code] * self._random.uniform(0.5, 1.0) * self._random.choice((-1, 1))
        return value + self._sign * amplitude * max(1.0, abs(value))


def nearby(tolerance: float) -> Iterator[Perturbed]:
    """Yield perturbations, in pairs of opposite ones."""
    for seed in range(PAIRS):
        for sign in (1.0, -1.0):
            yield Perturbed(seed, sign, tolerance)
