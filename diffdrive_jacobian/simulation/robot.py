"""The virtual robot as a value: a unicycle on two wheels whose motion is a function of its commands.

State: pose `[x, y, theta]` (m, m, rad) with its covariance, wheel angles `[right, left]` (rad), all
at one instant, and the body twist `[v, omega]` (m/s, rad/s) that moves it from there on. Input: twist
commands at their instants. Instants are integer nanoseconds, so that nothing is lost near the epoch.

The state is kept as of the last event (command, timeout, placement) and every later instant is
reached from there along one exact arc: how often somebody looks changes nothing, to the last bit.

Source: MATH.md, "Motion of a virtual robot".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.saturation import VelocityLimits, saturate
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel, wheel_to_body
from diffdrive_jacobian.kinematics.se2 import integrate
from diffdrive_jacobian.simulation.odometry_noise import propagate_covariance, twist_covariance

NANOSECONDS = 1_000_000_000
STANDSTILL = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotModel:
    """What does not change while the robot drives."""

    wheel_radius: float = 0.033
    """r (m)."""
    wheel_separation: float = 0.16
    """L (m)."""
    limits: VelocityLimits = field(default_factory=VelocityLimits)
    """What the drives can do; none: the ideal unicycle."""
    command_timeout: int = 0
    """How long a command is held (ns); 0: for ever."""
    wheel_travel_variance: float = 1e-5
    """k, variance of each wheel's travel per way (m)."""

    def limited(self, command: tuple[float, float]) -> tuple[float, float]:
        """Hold a command `(v, omega)` to the limits, keeping its curvature."""
        v, omega = saturate(*command, self.limits, self.wheel_radius, self.wheel_separation)
        return float(v), float(omega)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Robot:
    """A robot at an instant. Every method returns a new one; none looks at a clock."""

    model: RobotModel
    stamp: int
    """The instant of this state (ns)."""
    pose: NDArray[np.float64]
    """`[x, y, theta]`, shape (3,)."""
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    """Covariance of the pose, shape (3, 3)."""
    wheel_angles: tuple[float, float] = (0.0, 0.0)
    """`(right, left)`, unwrapped (rad)."""
    command: tuple[float, float] = STANDSTILL
    """The twist that was asked for last, `(v, omega)`."""
    twist: tuple[float, float] = STANDSTILL
    """The twist that is driven: the command within the limits."""
    commanded_at: int | None = None
    """When the command took effect (ns); None: none that moves."""

    @property
    def expiry(self) -> int | None:
        """The instant at which the timeout stops the robot (ns); None: nothing is to be stopped."""
        if self.commanded_at is None or not self.model.command_timeout:
            return None
        # A timeout that was shortened meanwhile strikes at once, not in the past.
        return max(self.stamp, self.commanded_at + self.model.command_timeout)

    @property
    def wheel_speeds(self) -> tuple[float, float]:
        """`(omega_R, omega_L)` (rad/s), by the inverse wheel Jacobian."""
        omega_R, omega_L = body_to_wheel(
            *self.twist, self.model.wheel_radius, self.model.wheel_separation
        )
        return omega_R, omega_L

    def twist_covariance(self, interval: float) -> NDArray[np.float64]:
        """Give the covariance of the twist as measured over an interval (s), shape (2, 2)."""
        model = self.model
        return twist_covariance(
            self.twist, model.wheel_separation, model.wheel_travel_variance, interval
        )

    def at(self, stamp: int) -> Robot:
        """Advance to an instant, through the timeout if it strikes on the way.

        Raises:
            ValueError: The instant is earlier than this state.
        """
        if stamp < self.stamp:
            raise ValueError(f'cannot go back from {self.stamp} ns to {stamp} ns')
        expiry = self.expiry
        if expiry is None or expiry > stamp:
            return self._moved(stamp)
        return replace(
            self._moved(expiry),
            command=STANDSTILL,
            twist=STANDSTILL,
            commanded_at=None,
            stamp=stamp,
        )

    def commanded(self, command: tuple[float, float], stamp: int) -> Robot:
        """Take a command `(v, omega)` at an instant, within the limits."""
        here = self.at(stamp)
        # Written out: dataclasses.replace takes three times as long, and this runs for every message.
        return Robot(
            model=here.model,
            stamp=stamp,
            pose=here.pose,
            covariance=here.covariance,
            wheel_angles=here.wheel_angles,
            command=command,
            twist=here.model.limited(command),
            commanded_at=None if command == STANDSTILL else stamp,
        )

    def placed(self, pose: NDArray[np.float64], covariance: NDArray[np.float64], stamp: int) -> Robot:
        """Begin anew at a pose; the command and the wheel angles go on."""
        return replace(self.at(stamp), pose=pose, covariance=covariance)

    def remodelled(self, model: RobotModel, stamp: int, *, wheels_commanded: bool = False) -> Robot:
        """Go on with another model: the running command is held to the new limits and timeout.

        With `wheels_commanded` the command was one of wheel speeds: on other wheels these stay, and
        the twist changes.
        """
        here = self.at(stamp)
        command = here.command
        if wheels_commanded:
            speeds = body_to_wheel(*command, self.model.wheel_radius, self.model.wheel_separation)
            command = wheel_to_body(*speeds, model.wheel_radius, model.wheel_separation)
        return replace(here, model=model, command=command, twist=model.limited(command))

    def restarted(self, stamp: int) -> Robot:
        """Stand still in the same place on another time line, where old instants mean nothing."""
        return replace(self, stamp=stamp, command=STANDSTILL, twist=STANDSTILL, commanded_at=None)

    def _moved(self, stamp: int) -> Robot:
        dt = (stamp - self.stamp) / NANOSECONDS
        if dt == 0.0 or self.twist == STANDSTILL:
            return replace(self, stamp=stamp)
        model = self.model
        (right, left), (omega_R, omega_L) = self.wheel_angles, self.wheel_speeds
        # Written out, as in `commanded`.
        return Robot(
            model=model,
            stamp=stamp,
            pose=integrate(self.pose, self.twist, dt),
            covariance=propagate_covariance(
                self.covariance,
                self.pose,
                self.twist,
                dt,
                model.wheel_separation,
                model.wheel_travel_variance,
            ),
            wheel_angles=(right + omega_R * dt, left + omega_L * dt),
            command=self.command,
            twist=self.twist,
            commanded_at=self.commanded_at,
        )
