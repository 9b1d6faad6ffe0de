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

"""Answers of a hand-in: how they are shown, and whether they are right."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

LONGEST = 160
"""Longest text of a value (characters)."""


def shown(value: Any) -> str:
    """Return a value as a student would write it, with six digits, cut to a length."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    text = _text(value)
    return text if len(text) <= LONGEST else f'{text[: LONGEST - 4]} ...'


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f'[{", ".join(map(_text, value))}]'
    return f'{value:.6g}' if isinstance(value, float) else repr(value)


def as_numbers(value: Any) -> NDArray[np.float64] | None:
    """Return numbers as an array. None: they are none. Texts are not, even of digits."""
    try:
        array = np.asarray(value)
    except ValueError:
        # Lists of different lengths.
        return None
    return array.astype(np.float64) if array.dtype.kind in 'biuf' else None


def agree(found: Any, expected: Any, what: str, *, within: float = 1e-6) -> None:
    """Require that an answer is right.

    Args:
        found: The answer: a number, or nested lists or arrays of numbers.
        expected: What it must be.
        what: What it is, for the message.
        within: Largest difference, relative to 1 and to the largest expected number.

    Raises:
        AssertionError: It is not. The message is for the student.
    """
    wanted = np.asarray(expected, dtype=np.float64)
    got = as_numbers(found)
    if got is None:
        raise AssertionError(f'{what} must be {shown(wanted)}, got {shown(found)}')
    if got.shape != wanted.shape:
        raise AssertionError(
            f'{what} must have shape {wanted.shape}, as {shown(wanted)}, got {got.shape}: {shown(got)}'
        )
    largest = max(1.0, float(np.max(np.abs(wanted), initial=0.0)))
    if not np.all(np.abs(got - wanted) <= within * largest):
        raise AssertionError(f'{what} must be {shown(wanted)}, got {shown(got)}')
