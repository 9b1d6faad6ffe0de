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

"""What a calibration starts from, and its parameters with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.motion import Geometry
from diffdrive_jacobian.errors import NotDoneError

Array = NDArray[np.float64]


class CalibrationError(NotDoneError):
    """The recordings contradict the model or each other; the message says why."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationDrive:
    """One drive. Both times are of the same clock, up to a constant offset."""

    name: str
    """For messages."""
    wheel_time: Array
    """Times of the samples of the wheels, shape (m,) (s)."""
    wheel_angles: Array
    """Angles of the right and the left wheel, not wrapped, shape (m, 2) (rad)."""
    pose_time: Array
    """Times of the poses, shape (n,) (s)."""
    poses: Array
    """`[x, y, theta]` of the sensor in the frame of the reference, shape (n, 3)."""


GIVEN_NOISE = {
    'wheel_noise': (1e-9, 1.0),
    'position_noise': (1e-5, 1e3),
    'heading_noise': (1e-5, 1e2),
}
"""Bounds of a noise that is given (m, m, rad). With less, rounding errors dominate."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Given:
    """Quantities that are known, and so are not estimated. None: estimated."""

    lever_arm: tuple[float, float] | None = None
    """Position of the sensor in the body frame (m)."""
    yaw_offset: float | None = None
    """Heading of the sensor in the body frame (rad)."""
    time_offset: float | None = None
    """What must be added to the times of the poses (s). The clocks do not drift then."""
    wheel_noise: float | None = None
    """Variance of the distance travelled by a wheel, per distance, within `GIVEN_NOISE` (m)."""
    position_noise: float | None = None
    """Standard deviation of the positions, within `GIVEN_NOISE` (m)."""
    heading_noise: float | None = None
    """Standard deviation of the headings, within `GIVEN_NOISE` (rad)."""

    @property
    def variances(self) -> Array:
        """Those of `Noise.variances` that are known, else NaN."""
        wheel, *deviations = (
            np.nan if value is None else value
            for value in (self.wheel_noise, self.position_noise, self.heading_noise)
        )
        return np.array([wheel, *np.square(deviations)])


@dataclass(frozen=True, kw_only=True, slots=True)
class Noise:
    """Noise of the wheels and of the reference."""

    wheel: float
    """Variance of the distance travelled by a wheel, per distance (m)."""
    position: float
    """Standard deviation of each coordinate of the positions (m)."""
    heading: float
    """Standard deviation of the headings (rad)."""

    @property
    def variances(self) -> Array:
        """Of the motion for a travel of 1 m, of a coordinate and of a heading, shape (3,)."""
        return np.array([self.wheel, self.position**2, self.heading**2])

    @classmethod
    def of(cls, variances: Array) -> Noise:
        """Return the noise with given variances."""
        wheel, position, heading = variances.tolist()
        return cls(wheel=wheel, position=position**0.5, heading=heading**0.5)


@dataclass(frozen=True, kw_only=True, slots=True)
class Segment:
    """A part of a recording that is one continuous motion, and what is known of its poses."""

    recording: int
    """Index of the recording."""
    wheel_time: Array
    wheel_angles: Array
    """Most likely angles of the right and the left wheel, shape (m, 2) (rad)."""
    wheel_errors: Array
    """Their standard deviations by the steps of the encoders, shape (m, 2) (rad)."""
    epoch: float
    """Time by the clock of the reference at which its offset is estimated (s)."""
    time: Array
    """Times of the poses by the clock of the reference, increasing, shape (n,) (s)."""
    poses: Array
    """Poses of the sensor, shape (n, 3)."""
    samples: Array
    """Number of samples for which each pose counts, shape (n,)."""

    @property
    def clock(self) -> slice:
        """Where the clock of the recording is among the parameters."""
        return slice(begin := CLOCKS + 2 * self.recording, begin + 2)

    def at(self, parameters: Array) -> Array:
        """Return the times of the poses by the clock of the wheels (s)."""
        offset, drift = parameters[self.clock].tolist()
        return np.asarray(self.time + offset + drift * (self.time - self.epoch))

    def part(self, here: slice | NDArray[np.intp]) -> Segment:
        """Return the segment with only some of its poses."""
        return replace(self, time=self.time[here], poses=self.poses[here], samples=self.samples[here])


MULTIPLIERS, SENSOR, CLOCKS = slice(0, 3), slice(3, 6), 6
LEVER_ARM, YAW_OFFSET = slice(3, 5), 5
"""Where the parameters are in their vector: logarithms of the multipliers (left, right, separation), the
pose of the sensor in the body frame, and for each recording the offset and the drift of its clock."""
SCALES, CLOCK_SCALES = (0.2, 0.2, 0.2, 0.3, 0.3, 0.5), (0.3, 1e-3)
"""Prior standard deviations about the approximate parameters (-, m, rad), and of the offset (s) and the
drift (-) of a clock. They keep parameters that the data do not determine near these, and are without
effect on the others."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """Parameters of the model and the state of their estimation."""

    parameters: Array
    """As described at `MULTIPLIERS`, shape (6 + 2 * number of recordings,)."""
    noise: Noise
    free: NDArray[np.bool_]
    """Which of the parameters are estimated, shape as `parameters`."""
    prior: Array
    """Where the prior of the parameters lies, shape as `parameters`."""
    states: tuple[Array, ...] = ()
    """Most likely poses of the body at the times of each segment, shapes (n, 3)."""
    covariance: Array
    """Of all parameters, 0 for those that are not free. Directions that the data do not determine have
    about the variance of `SCALES`."""

    def geometry(self, nominal: Geometry) -> Geometry:
        """Return the dimensions of the robot with the estimated multipliers."""
        return calibrated(nominal, self.parameters)

    @property
    def sensor(self) -> Array:
        """Pose of the sensor in the body frame, shape (3,)."""
        return self.parameters[SENSOR]

    def moved(self, size: float, variance: float, unit: Array) -> Estimate:
        """Return the estimate with a further parameter.

        `unit` is what a change of 1 of it adds to the others, shape as `parameters`.
        """
        return replace(
            self,
            parameters=self.parameters + size * unit,
            covariance=self.covariance + variance * np.outer(unit, unit),
        )

    def of_free(self, covariance: Array) -> Array:
        """Return the covariance of all parameters, given that of the free ones."""
        full = np.zeros((len(self.parameters),) * 2)
        full[np.ix_(self.free, self.free)] = covariance
        return full


def calibrated(nominal: Geometry, parameters: Array) -> Geometry:
    """Return the dimensions of the robot with the multipliers among the parameters."""
    left, right, separation = np.exp(parameters[MULTIPLIERS]).tolist()
    return replace(nominal, multipliers=(left, right, separation))


def prior_deviations(count: int) -> Array:
    """Return the prior standard deviations of a number of parameters."""
    return np.array([*SCALES, *CLOCK_SCALES * ((count - CLOCKS) // 2)])


def prior_information(free: NDArray[np.bool_]) -> Array:
    """Return the information of the prior of the parameters that are free, out of all."""
    return np.diag(prior_deviations(len(free))[free] ** -2.0)
