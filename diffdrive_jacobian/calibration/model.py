"""What a calibration starts from, and its parameters with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.motion import Geometry
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


MULTIPLIERS, LEVER_ARM, YAW_OFFSET, TIME_OFFSETS = slice(0, 3), slice(3, 5), 5, 6
"""Where the parameters are in their vector: logarithms of the multipliers (left, right, separation), the
pose of the sensor in the body frame, and the time offset of each recording."""
SCALES = (0.2, 0.2, 0.2, 0.3, 0.3, 0.5, 0.3)
"""Prior standard deviations about the approximate parameters (-, m, rad, s). They keep parameters that
the data do not determine near these, and are without effect on the others."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """Parameters of the model and the state of their estimation."""

    parameters: Array
    """As described at `MULTIPLIERS`, shape (6 + number of recordings,)."""
    noise: Noise
    free: NDArray[np.bool_]
    """Which of the parameters are estimated, shape as `parameters`."""
    states: tuple[Array, ...] = ()
    """Most likely poses of the body at the times of each segment, shapes (n, 3)."""
    information: Array
    """Fisher information of the free parameters."""

    def geometry(self, nominal: Geometry) -> Geometry:
        """Return the dimensions of the robot with the estimated multipliers."""
        left, right, separation = np.exp(self.parameters[MULTIPLIERS]).tolist()
        return replace(nominal, multipliers=(left, right, separation))

    @property
    def sensor(self) -> Array:
        """Pose of the sensor in the body frame, shape (3,)."""
        return self.parameters[3:6]

    def covariance(self) -> Array:
        """Return the covariance of all parameters, zero for those that are not free.

        Directions that the data do not determine have about the variance of `SCALES`.
        """
        full = np.zeros((len(self.parameters),) * 2)
        inverse = np.linalg.inv(self.information + prior_information(self.free))
        full[np.ix_(self.free, self.free)] = (inverse + inverse.T) / 2.0
        return full

    def widened(self, errors: Array) -> Estimate:
        """Return the estimate with additional errors, shape (any, number of parameters)."""
        free = np.ix_(self.free, self.free)
        covariance = self.covariance()[free] + (errors.T @ errors)[free]
        return replace(self, information=np.linalg.inv(covariance) - prior_information(self.free))


def prior_deviations(count: int) -> Array:
    """Return `SCALES` for a number of parameters."""
    return np.array([*SCALES[:TIME_OFFSETS], *[SCALES[-1]] * (count - TIME_OFFSETS)])


def prior_information(free: NDArray[np.bool_]) -> Array:
    """Return the information of the prior of the parameters that are free, out of all."""
    return np.diag(prior_deviations(len(free))[free] ** -2.0)


UNDETERMINED = 0.02
"""Standard deviation of a combination of multipliers beyond which it counts as not determined [-]."""
_WITHIN = 0.98
"""Part of a combination that must lie in the undetermined space."""
_TURN = 'turn in place or drive arcs, in both directions'
_STRAIGHT = 'drive straight'
COMBINATIONS: tuple[tuple[str, tuple[float, float, float], str], ...] = (
    ('the wheel separation', (0.0, 0.0, 1.0), _TURN),
    (
        'the common scale of radii and separation (only their ratio is determined)',
        (1.0, 1.0, 1.0),
        _STRAIGHT,
    ),
    ('the mean of the wheel radii', (1.0, 1.0, 0.0), _STRAIGHT),
    ('the difference of the wheel radii', (1.0, -1.0, 0.0), f'{_STRAIGHT}, further'),
    ('the radius of the left wheel', (1.0, 0.0, 0.0), f'{_STRAIGHT}, with both wheels turning'),
    ('the radius of the right wheel', (0.0, 1.0, 0.0), f'{_STRAIGHT}, with both wheels turning'),
)
"""Name, direction in the space of the logarithms of the multipliers (left, right, separation), and what
drive determines it."""


def undetermined(covariance: Array) -> list[tuple[str, str]]:
    """Return the combinations of multipliers that are not determined, and what drive determines them.

    `covariance` is that of the logarithms of the multipliers, shape (3, 3).
    """
    variances, directions = np.linalg.eigh(covariance)
    space = directions[:, variances > UNDETERMINED**2]
    dimension, all_of_them = space.shape[1], f'{_STRAIGHT}, and {_TURN}'
    if dimension == 3:
        return [('any of the multipliers', all_of_them)]
    found: list[tuple[str, str]] = []
    spanned = np.zeros((3, 0))
    others = [('', tuple(direction), all_of_them) for direction in space.T.tolist()]
    for name, direction, remedy in (*COMBINATIONS, *others):
        unit = np.array(direction) / np.linalg.norm(direction)
        if np.linalg.norm(space.T @ unit) < _WITHIN or spanned.shape[1] == dimension:
            continue
        rest = unit - spanned @ (spanned.T @ unit)
        if np.linalg.norm(rest) > 0.5:
            rest /= np.linalg.norm(rest)
            spanned = np.column_stack([spanned, rest])
            left, right, separation = rest.tolist()
            parts = f'{left:+.2f} left radius, {right:+.2f} right radius, {separation:+.2f} separation'
            found.append((name or f'the combination {parts}', remedy))
    return found
