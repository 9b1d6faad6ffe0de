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

"""Velocity limits that keep the curvature: a saturated robot is slower, but on the same path.

Limits of the body twist and of the wheel speeds are met by scaling `v` and `omega` by one factor.
Clipping each component separately, as diff_drive_controller does, changes the path.
Source: doc/mathematics.md, "Control laws".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np

from diffdrive_jacobian.numerics.checks import (
    Comparable,
    anything,
    constant,
    instance,
    leading,
    not_negative_or_infinite,
    not_positive_or_infinite,
    positive,
    positive_or_infinite,
)
from diffdrive_jacobian.numerics.elementary import all_finite, maximum, minimum, where
from diffdrive_jacobian.numerics.formula import Number, Scalar, formula

ROUNDING = 2.0**-49
"""By how much a computed wheel speed may be beyond its limit, relative to it."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VelocityLimits(Comparable):
    """Velocity limits of a differential drive; infinity means no limit. Each is a number, or an array
    for several robots that broadcasts with the commands. Immutable, comparable and hashable.

    Raises:
        ValueError: A limit is NaN or has the wrong sign (standing still must be allowed), or arrays do
            not broadcast.
    """

    min_v: Annotated[Any, partial(constant, check=not_positive_or_infinite)] = -np.inf
    """Fastest reverse speed, zero or negative (m/s)."""
    max_v: Annotated[Any, partial(constant, check=not_negative_or_infinite)] = np.inf
    """Fastest forward speed (m/s)."""
    min_omega: Annotated[Any, partial(constant, check=not_positive_or_infinite)] = -np.inf
    """Fastest clockwise yaw rate, zero or negative (rad/s)."""
    max_omega: Annotated[Any, partial(constant, check=not_negative_or_infinite)] = np.inf
    """Fastest counter-clockwise yaw rate (rad/s)."""
    max_wheel_speed: Annotated[Any, partial(constant, check=positive_or_infinite)] = np.inf
    """Largest absolute speed of either wheel (rad/s)."""
    alike: bool = field(init=False, repr=False)
    """Whether every limit is a number, equal for all robots."""
    unlimited: bool = field(init=False, repr=False)
    """Whether no limit is set."""

    def __post_init__(self) -> None:
        """Check every limit."""
        Comparable.__post_init__(self)
        limits = self.all()
        leading(**{name: np.shape(limit) for name, limit in zip(self.names(), limits, strict=True)})
        alike = all(isinstance(limit, float) for limit in limits)
        object.__setattr__(self, 'alike', alike)
        unlimited = alike and limits == (-np.inf, np.inf, -np.inf, np.inf, np.inf)
        object.__setattr__(self, 'unlimited', unlimited)

    def all(self) -> tuple[Any, ...]:
        """Return the limits, in the order of `names`."""
        return self.min_v, self.max_v, self.min_omega, self.max_omega, self.max_wheel_speed

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the limits."""
        return 'min_v', 'max_v', 'min_omega', 'max_omega', 'max_wheel_speed'


def saturate(
    v: Any, omega: Any, limits: VelocityLimits, r: Any = None, L: Any = None
) -> tuple[Any, Any]:
    """Scale a twist by the largest factor, at most 1, that meets every limit; `v : omega` is kept.

    A direction whose limit is zero is forbidden: its component is set to zero first, because no other
    factor than 0 would meet the limit. So a robot that may not reverse still turns on the spot. The
    result meets every limit exactly, including that of the wheel speeds that `body_to_wheel` returns for
    it.

    Speeds v (m/s), yaw rates omega (rad/s), limits, wheel radius r and separation L (m) broadcast to the
    shape (...) of the results. Only a `max_wheel_speed` needs r and L. Values that are not finite, r or
    L that is not positive, shapes that do not broadcast, and speeds that overflow raise ValueError.
    """
    instance('limits', limits, VelocityLimits)
    if np.all(limits.max_wheel_speed == np.inf):
        r = L = 1.0
    elif r is None or L is None:
        raise ValueError('limits have a max_wheel_speed, so r and L must be given')
    min_v, max_v, min_omega, max_omega, max_wheel_speed = limits.all()
    return scaled_to_limits(v, omega, min_v, max_v, min_omega, max_omega, max_wheel_speed, r, L)


@formula(
    '(),(),(),(),(),(),(),(),() -> (),()',
    **dict.fromkeys(VelocityLimits.names(), anything),
    r=positive,
    L=positive,
)
def scaled_to_limits(
    v: Number,
    omega: Number,
    min_v: Number,
    max_v: Number,
    min_omega: Number,
    max_omega: Number,
    max_wheel_speed: Number,
    r: Number,
    L: Number,
) -> tuple[Scalar, Scalar]:
    """Return what `saturate` does, for limits that are given one by one."""
    v_limit, omega_limit = where(v > 0.0, max_v, min_v), where(omega > 0.0, max_omega, min_omega)
    v, omega = where(v_limit == 0.0, 0.0, v), where(omega_limit == 0.0, 0.0, omega)

    # By what factor the twist exceeds its limits; where both are zero, 0 / 1.
    v_excess = v / (v_limit + (v_limit == 0.0))
    omega_excess = omega / (omega_limit + (omega_limit == 0.0))
    wheel_excess = (abs(v) + abs(omega * L / 2.0)) / r / max_wheel_speed
    # First the one that may be NaN, which then remains also among floats.
    excess = maximum(wheel_excess, v_excess, omega_excess, 1.0)
    if not all_finite(excess):
        raise ValueError('v, omega, the limits, r and L must give finite speeds, but they overflow')
    v, omega = v / excess, omega / excess

    # The quotients round. A limit is never exceeded, not by the last bit either.
    v, omega = maximum(min_v, minimum(v, max_v)), maximum(min_omega, minimum(omega, max_omega))
    beyond = (abs(v) + abs(omega * L / 2.0)) / r > max_wheel_speed
    exact = 1.0 - ROUNDING * beyond
    return v * exact, omega * exact
