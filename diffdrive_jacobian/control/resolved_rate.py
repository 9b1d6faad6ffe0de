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
from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics.inverse_velocity import (
    damped_least_squares,
    limit_velocity,
    redundant,
)
from diffdrive_jacobian.kinematics.singular_values import dot
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
from diffdrive_jacobian.numerics.formula import Array, Number, Vector, formula


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
) -> Array:
    """Return joint velocities for a moving target: `q_dot = J^+ (x_dot_d + K (x_d - x))` (A, C, D).

    Args:
        J: Jacobians, shape (..., m, n).
        x: Position of the tip, shape (..., m) (m).
        x_desired: Desired position, shape (..., m) (m).
        x_dot_desired: Desired velocity, shape (..., m) (m/s).
        gain: K, how fast an error decays, zero or positive, shape (...) (1/s).
        damping: lambda of damped least squares, zero or positive, shape (...), in the units of J.
        q_dot_0: Secondary joint velocities, see `inverse_velocity.redundant`, shape (..., n); None: the
            least ones.
        max_correction: Largest norm of `K (x_d - x)`, positive, shape (...) (m/s). Without a limit, the
            growing error of a target out of reach would lead to growing joint velocities.
        weights: Weights of the joints, positive, shape (..., n); None: all 1.
        max_velocity: Largest joint speeds, see `inverse_velocity.limit_velocity`; None: no limits.
    """
    q_dot = _unlimited(J, x, x_desired, x_dot_desired, gain, damping, q_dot_0, max_correction, weights)
    return q_dot if max_velocity is None else limit_velocity(q_dot, max_velocity)


@formula(
    '(m,n),(m),(m),(m),(),(),(n),(),(n) -> (n)',
    gain=not_negative,
    damping=not_negative,
    max_correction=positive_or_infinite,
    weights=positive,
)
def _unlimited(
    J: Any,
    x: Vector,
    x_desired: Vector,
    x_dot_desired: Vector,
    gain: Number,
    damping: Number,
    q_dot_0: Vector = None,
    max_correction: Number = np.inf,
    weights: Vector = None,
) -> Array:
    """Compute `J^+ (x_dot_d + K (x_d - x))`, with the correction not longer than allowed."""
    correction = gain * (x_desired - x)
    excess = np.sqrt(dot(correction, correction)) / max_correction
    if not np.isfinite(excess).all():
        raise OverflowError('|K (x_d - x)| must be finite')
    x_dot = x_dot_desired + correction / np.maximum(excess, 1.0)
    if q_dot_0 is None:
        return np.asarray(damped_least_squares.formula(J, x_dot, damping, weights=weights))
    return np.asarray(redundant.formula(J, x_dot, q_dot_0, damping, weights=weights))


@dataclass(frozen=True, eq=False)
class StraightLine:
    """Straight path at constant speed from one point to another, with rest before and after (D, 4.1).

    The coordinates are those of the task: positions, or positions and headings. Ends with different or
    no coordinates, a speed that is not positive and finite, and a duration that overflows raise
    ValueError.
    """

    start: Any
    """Shape (..., m) (m), read-only."""
    end: Any
    """Shape (..., m) (m), read-only."""
    speed: Any
    """Speed along the line, shape (...) (m/s), read-only."""
    _duration: Array = field(init=False, repr=False)

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
    def duration(self) -> Array:
        """Time from start to end, shape (...) (s)."""
        return np.array(self._duration)

    def position(self, t: float) -> Array:
        """Return the position at a time, shape (..., m) (m).

        It is the start before t = 0 (s), the end after the duration. A t that is not a single finite
        number raises ValueError.
        """
        t = number('t', t, finite)
        duration = self._duration[..., np.newaxis]
        elapsed = max(t, 0.0) / np.where(duration > 0.0, duration, 1.0)
        share = np.where(t < duration, elapsed, 1.0)
        return np.asarray(self.start + share * (self.end - self.start))
