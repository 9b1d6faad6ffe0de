"""Checks of arguments; every error names the argument, what was got and what is allowed."""

from __future__ import annotations

from typing import Any

import numpy as np


def positive(name: str, value: Any) -> None:
    """Require a length to be positive and finite.

    Raises:
        ValueError: An entry is zero, negative, infinite or NaN.
    """
    # A plain float takes the first test alone: this runs for every message.
    inside = (value > 0.0) & (value < np.inf)
    if inside is not True and not np.all(inside):
        raise ValueError(f'{name} must be positive and finite, got {value}')
