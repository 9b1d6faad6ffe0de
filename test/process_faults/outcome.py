"""What a campaign returns, and what campaigns share."""

from __future__ import annotations

import re
from typing import NamedTuple

UNEXPECTED = re.compile(
    r'Traceback|Segmentation|Fatal|Aborted|terminate called|core dumped|Exception ign'
)
"""What no process may print."""


class Outcome(NamedTuple):
    """The result of a campaign."""

    count: int
    """How many cases were tried."""
    violations: list[str]
    """What broke the promise, one line for each case."""
    measured: str = ''
    """Further numbers."""


def unexpected(text: str) -> str:
    """Return the first line that no process may print. '': there is none."""
    return next((line for line in text.splitlines() if UNEXPECTED.search(line)), '')


def spread(values: list[float], unit: str, digits: int = 2) -> str:
    """Return median and maximum in words."""
    if not values:
        return 'none measured'
    middle = sorted(values)[len(values) // 2]
    return f'median {middle:.{digits}f} {unit}, at most {max(values):.{digits}f} {unit}'
