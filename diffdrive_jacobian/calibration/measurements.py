"""What a calibration starts from: angles of the wheels, and poses of a reference."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.errors import DiffdriveError

Array = NDArray[np.float64]


class CalibrationError(DiffdriveError):
    """The recordings do not determine the parameters, or contradict the model; the message says why."""


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Given:
    """Quantities that are known, and so are not estimated. None: estimated."""

    lever_arm: tuple[float, float] | None = None
    """Position of the sensor in the body frame (m)."""
    yaw_offset: float | None = None
    """Heading of the sensor in the body frame (rad)."""
    time_offset: float | None = None
    """What must be added to the times of the poses (s)."""
    wheel_noise: float | None = None
    """Variance of the distance travelled by a wheel, per distance, positive (m)."""
    position_noise: float | None = None
    """Standard deviation of the positions, positive (m)."""
    heading_noise: float | None = None
    """Standard deviation of the headings, positive (rad)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Noise:
    """Noise of the wheels and of the reference."""

    wheel: float
    """Variance of the distance travelled by a wheel, per distance (m)."""
    position: float
    """Standard deviation of each coordinate of the positions (m)."""
    heading: float
    """Standard deviation of the headings (rad)."""


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
    time: Array
    """Times of the poses, not corrected by the time offset, increasing, shape (n,) (s)."""
    poses: Array
    """Poses of the sensor, shape (n, 3)."""
    weights: Array = field(default_factory=lambda: np.empty(0))
    """Number of samples that each pose is the mean of, shape (n,)."""

    def part(self, here: slice | NDArray[np.intp]) -> Segment:
        """Return the segment with only some of its poses."""
        return replace(self, time=self.time[here], poses=self.poses[here], weights=self.weights[here])
