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

"""A world whose inputs are perturbed at the level of rounding errors."""

from __future__ import annotations

import math
import random
from typing import Any

from diffdrive_jacobian.messages.structure import Array, Number, Sequence, parts
from diffdrive_jacobian.relations.imaging import Imaging

AMPLITUDES = {'d': (1e-9, 1e-12), 'f': (1e-7, 1e-7)}
"""Changes of numbers, by the code of their type: the least, and relative to the number."""


class Perturbed(Imaging):
    """All numbers that the nodes under test hear are changed a little, and they must say the same."""

    def __init__(self, seed: int, sign: int, tolerance: float) -> None:
        """Start with random numbers from a seed, each multiplied by a sign."""
        self._random, self._sign = random.Random(seed), sign
        self.tolerance = tolerance

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return the changed message."""
        for kind, part in parts(message):
            for name, field in kind.fields:
                match field:
                    case Number(code='d' | 'f' as code):
                        setattr(part, name, self._changed(getattr(part, name), code))
                    case Array(Number(code=code)) | Sequence(Number(code=code)) if code in AMPLITUDES:
                        values = getattr(part, name)
                        for index, value in enumerate(values):
                            values[index] = self._changed(float(value), code)
        return [(0.0, message)]

    def _changed(self, value: float, code: str) -> float:
        if not math.isfinite(value):
            return value
        least, relative = AMPLITUDES[code]
        change = self._random.uniform(0.5, 1.0) * self._random.choice((-1, 1))
        return value + self._sign * change * max(least, relative * abs(value))
