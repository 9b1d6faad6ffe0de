"""Worlds in which rounding is a little larger: where they differ, rounding decides what is said."""

from __future__ import annotations

import random
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.messages.structure import Array, Number, Sequence, Structure, is_stamp, parts
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.time_units import NANOSECONDS

PAIRS = 2
"""Number of pairs of worlds. In one of a pair each value grows by what it shrinks by in the other."""
AMPLITUDES = {'d': 1e-9, 'f': 1e-7}
"""Changes of numbers, relative to those above 1, by the code of their type."""


class Perturbed(Imaging, ABC):
    """What the nodes under test hear is changed a little, and they must say the same. Base class."""

    def __init__(self, seed: int, sign: int, tolerance: float) -> None:
        """Start with random numbers from a seed, each multiplied by a sign."""
        self._random, self._sign = random.Random(seed), sign
        self.tolerance = tolerance
        self._world: Lockstep

    def begin(self, world: Lockstep) -> None:
        """Begin in a world."""
        self._world = world

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the changed message."""
        for kind, part in parts(message):
            self._change(kind, part)
        return [(0.0, message)]

    @abstractmethod
    def _change(self, kind: Structure, part: Any) -> None:
        """Change the fields of a message, or of a part of one."""


class Numbers(Perturbed):
    """Numbers are changed."""

    def _change(self, kind: Structure, part: Any) -> None:
        for name, field in kind.fields:
            match field:
                case Number(code='d' | 'f' as code):
                    setattr(part, name, self._changed(getattr(part, name), code))
                case Array(Number(code=code)) | Sequence(Number(code=code)) if code in AMPLITUDES:
                    values = getattr(part, name)
                    for index, value in enumerate(values):
                        values[index] = self._changed(float(value), code)

    def _changed(self, value: float, code: str) -> float:
        change = AMPLITUDES[code] * self._random.uniform(0.5, 1.0) * self._random.choice((-1, 1))
        return value + self._sign * change * max(1.0, abs(value))


class Stamps(Perturbed):
    """Times are changed by 1 ns. None comes to lie in the future."""

    def _change(self, kind: Structure, part: Any) -> None:
        time = part.sec * NANOSECONDS + part.nanosec if is_stamp(kind) else 0
        # Zero: there is none.
        if time:
            moved = time + self._sign * self._random.choice((-1, 1))
            set_time(part, min(moved, max(time, self._world.now)))


def nearby(kind: type[Perturbed], tolerance: float) -> Iterator[Perturbed]:
    """Yield perturbations of a kind, in pairs of opposite ones."""
    for seed in range(PAIRS):
        for sign in (1, -1):
            yield kind(seed, sign, tolerance)
