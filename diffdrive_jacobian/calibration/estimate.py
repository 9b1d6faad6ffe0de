"""The parameters of the calibration with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.measurements import Array, Noise
from diffdrive_jacobian.calibration.motion import Geometry

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
        scales = prior_deviations(len(self.parameters))[self.free]
        inverse = np.linalg.inv(self.information + np.diag(scales**-2.0))
        full[np.ix_(self.free, self.free)] = (inverse + inverse.T) / 2.0
        return full

    def widened(self, errors: Array) -> Estimate:
        """Return the estimate with additional errors, shape (any, number of parameters)."""
        free = np.ix_(self.free, self.free)
        covariance = self.covariance()[free] + (errors.T @ errors)[free]
        scales = prior_deviations(len(self.parameters))[self.free]
        information = np.linalg.inv(covariance) - np.diag(scales**-2.0)
        return replace(self, information=np.asarray(information, dtype=np.float64))


def prior_deviations(count: int) -> Array:
    """Return `SCALES` for a number of parameters."""
    return np.array([*SCALES[:TIME_OFFSETS], *[SCALES[-1]] * (count - TIME_OFFSETS)])
