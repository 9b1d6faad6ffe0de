"""Resolved-rate control of the tip of an arm or of a mobile manipulator along a given path.

The inverse of the Jacobian turns a desired velocity of the tip into joint velocities. Feedback of the
position, an addition to the documents, prevents drift of the tip. Damping bounds the joint
velocities where the Jacobian is nearly singular.

Everything broadcasts over leading axes. Wrong shapes and values that are not finite raise ValueError.

Source: documents A (3.2.3), C ("Inverse differential kinematics"), D (4.1);
doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics._task_checks import finite_result
from diffdrive_jacobian.kinematics.inverse_velocity import (
    damped_least_squares,
    limit_velocity,
    redundant,
)
from diffdrive_jacobian.numerics.checks import (
    array,
    finite,
    floats,
    leading,
    not_negative,
    number,
    positive,
    positive_or_infinite,
    read_only,
)
from diffdrive_jacobian.numerics.elementary import (
    agree,
    components,
    maximum,
    operand,
    sqrt,
    vector,
)


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
    weights: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Return joint velocities for a moving target: `q_dot = J^+ (x_dot_d + K (x_d - x))` (A, C, D).

    Args:
        J: Jacobians, shape (..., m, n).
        x: Position of the tip, shape (..., m) (m).
        x_desired: Desired position, shape (..., m) (m).
        x_dot_desired: Desired velocity, shape (..., m) (m/s).
        gain: K, how fast an error decays, zero or positive, shape (...) (1/s).
        damping: lambda of damped least squares, zero or positive, shape (...), in the units of J.
        q_dot_0: Secondary joint velocities, projected into the null space of the task (see
            `inverse_velocity.redundant`), shape (..., n); None: the least ones.
        max_correction: Largest norm of `K (x_d - x)`, positive, shape (...) (m/s). Without a limit, the
            growing error of a target out of reach would lead to growing joint velocities.
        weights: Weights of the joints, positive, shape (..., n); None: all 1. A joint with a larger
            weight moves less.
        max_velocity: Largest joint speeds, positive, shape (..., n), or one for all joints: all joints
            are slowed down alike (see `inverse_velocity.limit_velocity`); None: no limits.

    Returns:
        Joint velocities, shape (..., n). Without `max_velocity` infinite where they overflow.

    Raises:
        ValueError: The velocity of the tip overflows, or with `max_velocity` the joint velocities do.
    """
    J = array('J', J, 'm', 'n')
    m = J.shape[-2]
    tip, wanted = components('x', x, m), components('x_desired', x_desired, m)
    forward, K = components('x_dot_desired', x_dot_desired, m), operand('gain', gain, not_negative)
    longest = operand('max_correction', max_correction, positive_or_infinite)
    single = agree(
        x=tip[0], x_desired=wanted[0], x_dot_desired=forward[0], gain=K, max_correction=longest
    )
    if not single or J.ndim > 2:
        leading(
            J=J.shape[:-2],
            x=np.shape(tip[0]),
            x_desired=np.shape(wanted[0]),
            x_dot_desired=np.shape(forward[0]),
            gain=np.shape(K),
            max_correction=np.shape(longest),
        )
    with np.errstate(all='ignore'):
        x_dot = _tip_velocity(tip, wanted, forward, K, longest)
    finite_result('x, x_desired, x_dot_desired and gain', 'velocity', x_dot)
    if q_dot_0 is None:
        q_dot = damped_least_squares(J, x_dot, damping, weights=weights)
    else:
        q_dot = redundant(J, x_dot, q_dot_0, damping, weights=weights)
    if max_velocity is None:
        return q_dot
    finite_result('J, the velocity of the tip, damping and weights', 'joint velocity', q_dot)
    return limit_velocity(q_dot, max_velocity)


def _tip_velocity(
    x: list[Any], x_desired: list[Any], x_dot_desired: list[Any], gain: Any, longest: Any
) -> NDArray[np.float64]:
    """Compute `x_dot_d + K (x_d - x)` from the entries, with the limited correction, shape (..., m)."""
    correction = [gain * (there - here) for here, there in zip(x, x_desired, strict=True)]
    squares: Any = 0.0
    for entry in correction:
        squares = squares + entry * entry
    excess = sqrt(squares) / longest
    factor = maximum(excess, 1.0)
    correction = [entry / factor for entry in correction]
    if not np.all(excess < np.inf):
        overflows = ~np.asarray(excess < np.inf)
        entries = _scaled_correction(
            vector(*x), vector(*x_desired), np.asarray(gain), np.asarray(longest)
        )
        correction = [
            np.where(overflows, entries[..., index], entry) for index, entry in enumerate(correction)
        ]
    return vector(*(own + added for own, added in zip(x_dot_desired, correction, strict=True)))


def _scaled_correction(
    x: NDArray[np.float64],
    x_desired: NDArray[np.float64],
    gain: NDArray[np.float64],
    longest: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Compute `K (x_d - x)`, not longer than the limit, where its norm or its excess overflows."""
    error = x_desired / 2.0 - x / 2.0
    exponent = np.frexp(np.abs(error).max(axis=-1))[1]
    error = np.ldexp(error, -exponent[..., np.newaxis])
    length = np.linalg.norm(error, axis=-1)
    limit = longest / np.where(length > 0.0, length, 1.0)
    return np.asarray(error * np.minimum(np.ldexp(gain, exponent + 1), limit)[..., np.newaxis])


@dataclass(frozen=True, eq=False)
class StraightLine:
    """Straight path at constant speed from one point to another, with rest before and after (D, 4.1).

    Raises:
        ValueError: The ends have different or no coordinates, the speed is not positive and finite, or
            the duration is not a finite number.
    """

    start: Any
    """Shape (..., m) (m), read-only."""
    end: Any
    """Shape (..., m) (m), read-only."""
    speed: Any
    """Speed along the line, shape (...) (m/s), read-only."""
    _duration: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check and copy every value."""
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
        object.__setattr__(self, '_duration', read_only(duration))

    @property
    def duration(self) -> NDArray[np.float64]:
        """Time from start to end, shape (...) (s)."""
        return np.array(self._duration)

    def position(self, t: float) -> NDArray[np.float64]:
        """Return the position at a time, shape (..., m) (m).

        Args:
            t: Time since the start (s). Before 0 the position is the start, after the duration the end.

        Raises:
            ValueError: t is not a single finite number.
        """
        t = number('t', t, finite)
        if self._duration.ndim == 0:
            whole = float(self._duration)
            share = max(t, 0.0) / whole if t < whole and whole > 0.0 else 1.0
            return np.asarray(self.start + share * (self.end - self.start))
        duration = self._duration[..., np.newaxis]
        moving = t < duration
        part = np.where(moving, max(t, 0.0) / np.where(duration > 0.0, duration, 1.0), 1.0)
        return np.asarray(self.start + part * (self.end - self.start))
