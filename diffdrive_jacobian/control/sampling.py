"""Sampled loops: a law whose command is held until the next sample.

A law whose yaw rate has the slope K over the heading multiplies an error of the heading by
`1 - K / rate` from one sample to the next.

Source: doc/mathematics.md, "Control laws", Sampling.
"""

from __future__ import annotations

from math import tau
from typing import Any

from diffdrive_jacobian.numerics.elementary import where, wrap

LARGEST_TURN = 7.0 / 8.0 * tau
"""Largest turn per sample that is left as it is (rad)."""


def without_whole_turns(omega: Any, rate: float) -> Any:
    """Return a yaw rate without the whole turns per sample. The heading at the next sample is the same.

    A robot that makes a whole turn per sample comes back to where it was, and so never arrives.

    Args:
        omega: Yaw rate, shape (...) (rad/s).
        rate: Sampling rate (Hz).

    Returns:
        The yaw rate, shape (...) (rad/s); omega itself up to a turn of 7/8 per sample.
    """
    return where(abs(omega) <= LARGEST_TURN * rate, omega, wrap(omega / rate) * rate)


def rate_warning(slope: float, rate: float) -> str:
    """Return a warning if a law is too fast for the rate at which it is sampled, else ''.

    A sampled law arrives with a slope below twice the rate, and if its commands take effect up to one
    sample late, below the rate. Half of that is recommended.

    Args:
        slope: Largest slope of the yaw rate over the heading (1/s).
        rate: Rate of the odometry (Hz).
    """
    if slope < rate:
        return ''
    return (
        f'the law turns by up to {slope:.3g} rad/s per rad of heading, which is not below the odometry '
        f'rate of {rate:.3g} Hz: if commands take effect up to one sample late, the robot may never '
        'arrive; choose a smaller kp or kv, or a higher rate'
    )
