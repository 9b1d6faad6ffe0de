"""Resolved rate: the tip of an arm, or of a mobile manipulator, along a given way.

The robot is asked for velocities of its joints that move the tip as wished, through the inverse of its
Jacobian. Feedback of the position, an addition to the documents, keeps the tip from drifting off;
damping keeps the joints from racing where the Jacobian is nearly singular.

Everything broadcasts over leading axes. Wrong shapes and values that are not finite raise ValueError.

Source: documents A (3.2.3), C ("Inverse differential kinematics"), D (4.1); MATH.md, "Control laws".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._checks import (
    array,
    floats,
    leading,
    not_negative,
    number,
    positive,
    read_only,
)
from diffdrive_jacobian.kinematics.inverse_velocity import damped_least_squares, redundant


def resolved_rate(
    J: ArrayLike,
    x: ArrayLike,
    x_desired: ArrayLike,
    x_dot_desired: ArrayLike,
    gain: ArrayLike,
    damping: ArrayLike = 0.0,
    q_dot_0: ArrayLike | None = None,
    *,
    max_correction: ArrayLike = np.inf,
) -> NDArray[np.float64]:
    """Give joint velocities for a moving target: `q_dot = J^+ (x_dot_d + K (x_d - x))` (A, C, D).

    Args:
        J: Jacobians, shape (..., m, n).
        x: Where the tip is, shape (..., m) (m).
        x_desired: Where it should be, shape (..., m) (m).
        x_dot_desired: How it should move, shape (..., m) (m/s).
        gain: K, how fast an error decays, zero or positive, shape (...) (1/s).
        damping: lambda of damped least squares, zero or positive, shape (...), in the units of J.
        q_dot_0: Joint velocities that are wished for besides, where the task leaves them free, shape
            (..., n); None: the least ones.
        max_correction: Longest `K (x_d - x)`, positive, shape (...) (m/s): the feedback of an error that
            cannot be reduced, of a target out of reach, would drive the joints ever faster.

    Returns:
        Joint velocities, shape (..., n).
    """
    J = array('J', J, 'm', 'n')
    m = J.shape[-2]
    x, x_desired = array('x', x, m), array('x_desired', x_desired, m)
    x_dot_desired, K = array('x_dot_desired', x_dot_desired, m), floats('gain', gain)
    not_negative('gain', K)
    longest = floats('max_correction', max_correction)
    if not (longest > 0.0).all():
        raise ValueError(f'max_correction must be positive, got {longest}')
    leading(
        J=J.shape[:-2],
        x=x.shape[:-1],
        x_desired=x_desired.shape[:-1],
        x_dot_desired=x_dot_desired.shape[:-1],
        gain=K.shape,
        max_correction=longest.shape,
    )
    correction = K[..., np.newaxis] * (x_desired - x)
    length = np.linalg.norm(correction, axis=-1)
    correction = correction / np.maximum(length / longest, 1.0)[..., np.newaxis]
    x_dot = x_dot_desired + correction
    if q_dot_0 is None:
        return damped_least_squares(J, x_dot, damping)
    return redundant(J, x_dot, q_dot_0, damping)


@dataclass(frozen=True, eq=False)
class StraightLine:
    """A way at a constant speed from one point to another, and then rest (D, 4.1).

    Raises:
        ValueError: The ends have different or no coordinates, or the speed is not positive and finite.
    """

    start: Any
    """Shape (..., m) (m)."""
    end: Any
    """Shape (..., m) (m)."""
    speed: Any
    """Along the line, shape (...) (m/s)."""

    def __post_init__(self) -> None:
        """Check everything."""
        start = array('start', self.start, 'm')
        end, speed = array('end', self.end, 'm'), floats('speed', self.speed)
        if start.shape[-1] != end.shape[-1]:
            raise ValueError(
                'start and end must have the same number of coordinates, '
                f'got {start.shape[-1]} and {end.shape[-1]}'
            )
        positive('speed', speed)
        leading(start=start.shape[:-1], end=end.shape[:-1], speed=speed.shape)
        with np.errstate(over='ignore'):
            duration = np.linalg.norm(end - start, axis=-1) / speed
        if not np.isfinite(duration).all():
            raise ValueError('start, end and speed must give a finite duration, but it overflows')
        for name, value in (('start', start), ('end', end), ('speed', speed)):
            object.__setattr__(self, name, read_only(value))

    @property
    def duration(self) -> NDArray[np.float64]:
        """How long the way takes, shape (...) (s)."""
        return np.asarray(np.linalg.norm(self.end - self.start, axis=-1) / self.speed)

    def position(self, t: float) -> NDArray[np.float64]:
        """Return the position at a time (s), shape (..., m) (m).

        Raises:
            ValueError: The time is not a single finite number, zero or positive.
        """
        t = number('t', t, not_negative)
        duration = self.duration[..., np.newaxis]
        moving = t < duration
        part = np.where(moving, t / np.where(moving, duration, 1.0), 1.0)
        return np.asarray(self.start + part * (self.end - self.start))
