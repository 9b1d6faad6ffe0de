"""Integers that were assigned to fields of floats.

rclpy writes the bytes of an `int` into a `float64` field without conversion, unless the environment has
ROS_PYTHON_CHECK_FIELDS=1. What arrives is not the integer, but a part of its object that states how many
digits it has: 1 is 5e-324 on Python 3.10 and 3.11, 4e-323 since 3.12. It is a subnormal number, but NaN
for integers below zero on 3.10 and 3.11. NaN is refused everywhere.
"""

from __future__ import annotations

import sys

SMALLEST = sys.float_info.min
"""Smallest positive normal number. No speed or position is that small but zero."""


def integer_warning(what: str, *values: float) -> str | None:
    """Return a warning if a value is an integer that was assigned to a field of floats, else None.

    Args:
        what: What has the values.
        values: The values of the fields.
    """
    for value in values:
        if value and -SMALLEST < value < SMALLEST:
            return (
                f'{what} has the value {value:.3g}: was an int assigned to a float field? Assign 1.0 '
                'instead of 1 (with ROS_PYTHON_CHECK_FIELDS=1 rclpy reports it to the sender)'
            )
    return None
