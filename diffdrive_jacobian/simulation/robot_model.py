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

"""The parameters of a robot as a value."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

from numpy.typing import ArrayLike

from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel, wheel_to_body
from diffdrive_jacobian.kinematics.saturation import ROUNDING, VelocityLimits, scaled_to_limits
from diffdrive_jacobian.numerics.checks import Checked, NotNegative, Positive, instance, pair
from diffdrive_jacobian.simulation.actuators import IDEAL, Actuators, Duration, WheelSpeeds
from diffdrive_jacobian.simulation.odometry_noise import spectral_densities
from diffdrive_jacobian.simulation.slip import Drift


def _limits(name: str, value: Any) -> VelocityLimits:
    """Require limits of one robot."""
    limits: VelocityLimits = instance(name, value, VelocityLimits)
    if not limits.alike:
        raise ValueError(f'{name} must be numbers for one robot, got {limits}')
    return limits


class Steady(NamedTuple):
    """What stays the same while a robot keeps its twist."""

    wheel_speeds: WheelSpeeds
    """`(omega_R, omega_L)` (rad/s)."""
    densities: tuple[float, float, float]
    """Spectral densities vv, vw, ww of the noise of the twist."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotModel(Checked):
    """Parameters of a robot, as its controller and its odometry assume them.

    Raises:
        ValueError: A length or a multiplier is not positive and finite, the variance or the timeout is
            negative, the timeout is not an integer, the limits are not those of one robot, or the drift
            or the actuators are of another class.
    """

    wheel_radius: Positive = 0.033
    """r (m)."""
    wheel_separation: Positive = 0.16
    """L (m)."""
    right_wheel_radius_multiplier: Positive = 1.0
    """Radius of the right wheel, relative to r [-]."""
    left_wheel_radius_multiplier: Positive = 1.0
    """Radius of the left wheel, relative to r [-]."""
    limits: Annotated[VelocityLimits, _limits] = field(default_factory=VelocityLimits)
    """Velocity limits; without limits the robot is an ideal unicycle."""
    command_timeout: Duration = 0
    """Time after which the last command is replaced by zero (ns); 0: never."""
    wheel_travel_variance: NotNegative = 1e-5
    """k, variance of each wheel's travel per distance travelled (m)."""
    drift: Drift | None = None
    """In what the true motion differs from the odometry; None: in nothing."""
    actuators: Actuators = IDEAL
    """How the wheel motors carry out commands."""

    def limited(self, command: ArrayLike) -> tuple[float, float]:
        """Saturate a command `(v, omega)`, shape (2,), keeping its curvature.

        Raises:
            ValueError: It has another shape or is not finite, or the wheel speeds overflow.
        """
        v, omega = pair('command', command)
        if self.limits.unlimited:
            return v, omega
        radius = max(self.radii)
        try:
            v, omega = scaled_to_limits.floats(
                v, omega, *self.limits.all(), radius, self.wheel_separation
            )
        except ValueError as error:
            raise ValueError(f'command must be smaller, got {command!r}: {error}') from None
        if self.limits.max_wheel_speed < math.inf:
            # The smaller wheel may still be too fast.
            fastest = max(map(abs, self.wheel_speeds(v, omega)))
            excess = fastest / self.limits.max_wheel_speed
            if excess > 1.0:
                v, omega = v / excess * (1.0 - ROUNDING), omega / excess * (1.0 - ROUNDING)
        return v, omega

    @property
    def takes_time(self) -> bool:
        """Whether commands are not followed at once."""
        return not self.actuators.immediate

    @property
    def radii(self) -> tuple[float, float]:
        """Radii of the right and the left wheel (m)."""
        return (
            self.wheel_radius * self.right_wheel_radius_multiplier,
            self.wheel_radius * self.left_wheel_radius_multiplier,
        )

    def wheel_speeds(self, v: float, omega: float) -> WheelSpeeds:
        """Return the wheel speeds `(omega_R, omega_L)` of a twist of floats (rad/s).

        Raises:
            ValueError: They overflow.
        """
        right, left = body_to_wheel.floats(v, omega, self.wheel_radius, self.wheel_separation)
        right /= self.right_wheel_radius_multiplier
        left /= self.left_wheel_radius_multiplier
        if not (math.isfinite(right) and math.isfinite(left)):
            raise ValueError('twist must give finite wheel speeds, but they overflow')
        return right, left

    def steady(self, twist: tuple[float, float]) -> Steady:
        """Return what a constant twist `(v, omega)` implies.

        Raises:
            ValueError: The wheel speeds overflow.
        """
        densities = spectral_densities(*twist, self.wheel_separation, self.wheel_travel_variance)
        return Steady(self.wheel_speeds(*twist), densities)

    def twist(self, omega_R: float, omega_L: float) -> tuple[float, float]:
        """Return the twist `(v, omega)` of wheel speeds that are floats (m/s, rad/s).

        Raises:
            ValueError: It overflows.
        """
        right = omega_R * self.right_wheel_radius_multiplier
        left = omega_L * self.left_wheel_radius_multiplier
        v, omega = wheel_to_body.floats(right, left, self.wheel_radius, self.wheel_separation)
        if not (math.isfinite(v) and math.isfinite(omega)):
            raise ValueError('wheel speeds must give a finite twist, but it overflows')
        return v, omega
