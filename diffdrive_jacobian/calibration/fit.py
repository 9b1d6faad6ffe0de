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

"""Maximum likelihood estimate of the multipliers from wheel angles and poses of a reference.

All poses of the body and all parameters are estimated together by Gauss-Newton steps, the noise by
restricted maximum likelihood. Source: doc/moments.md, "Calibration".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_jacobian.calibration.linear_model import LinearModel, Solution, linearized
from diffdrive_jacobian.calibration.model import (
    MULTIPLIERS,
    Array,
    CalibrationError,
    Estimate,
    Given,
    Noise,
    Segment,
    prior_deviations,
)
from diffdrive_jacobian.calibration.motion import Geometry, composed, inverted

MAX_STEPS = 40
MAX_NOISE_STEPS = 5
"""For one step of the parameters."""
NOISE_CONVERGED = 2e-3
"""Largest relative change of a variance in the last step."""
CONVERGED = 0.05
"""Largest change of a parameter in the last step, relative to its standard deviation."""
NEGLIGIBLE = 1e-7
"""Change of a parameter that is negligible in any case (-, m, rad, s)."""
SMALLEST = Noise(wheel=1e-9, position=2e-4, heading=1e-3)
"""Smallest noise that is estimated. Between two samples of the wheels about as much of the motion is
unknown: at 20 Hz and 0.5 m/s^2 it is 0.16 mm, and 1 mrad for a separation of 0.16 m."""
LARGEST = Noise(wheel=1.0, position=1e3, heading=1e2)
LEAST, MOST = SMALLEST.variances, LARGEST.variances
PRIOR_WHEEL_NOISE, PRIOR_FREEDOM = 1e-5, 1.0
"""Wheel travel variance that is assumed in advance (m), about that of a small robot on a hard floor, and
how many squares it counts as. In short drives with a coarse reference the likelihood alone is largest at
zero, where the stated covariance would be far too small."""


def fit(segments: Sequence[Segment], nominal: Geometry, start: Estimate, given: Given) -> Estimate:
    """Return the most likely parameters of continuous motions of at least two poses each.

    Raises:
        CalibrationError: They do not converge: some multiplier still changes by more than a fifth of its
            standard deviation.
    """
    sensor = inverted(start.sensor)
    estimate = replace(start, states=tuple(composed(one.poses, sensor) for one in segments))
    scales = prior_deviations(len(start.parameters))
    for _ in range(MAX_STEPS):
        model = linearized(segments, nominal, estimate)
        variances, solution, settled = most_likely_noise(model, estimate.noise.variances, given)
        change = np.zeros(len(scales))
        change[estimate.free] = solution.y
        shorten = float(min(1.0, np.min(scales / np.maximum(np.abs(change), 1e-12))))
        estimate = replace(
            estimate,
            parameters=estimate.parameters + shorten * change,
            noise=Noise.of(variances),
            states=_moved(estimate.states, shorten * solution.x),
            covariance=estimate.of_free(solution.covariance),
        )
        deviations = np.sqrt(np.diag(estimate.covariance))
        limits = np.maximum(CONVERGED * deviations, NEGLIGIBLE)
        if settled and (shorten * np.abs(change) <= limits).all():
            break
    else:
        if (np.abs(change[MULTIPLIERS]) > deviations[MULTIPLIERS] / 5.0).any():
            raise CalibrationError(
                f'the estimate does not converge within {MAX_STEPS} steps: the poses of the reference '
                'do not fit the motion of the wheels'
            )
    return estimate


def _moved(states: Sequence[Array], twists: Array) -> tuple[Array, ...]:
    """Return poses that are moved by twists in their own frames."""
    ends = np.cumsum([len(one) for one in states])[:-1]
    return tuple(map(composed, states, np.split(twists, ends)))


def most_likely_noise(model: LinearModel, start: Array, given: Given) -> tuple[Array, Solution, bool]:
    """Return more likely variances, the solution for them, and whether they are the most likely.

    At the maximum of the restricted likelihood the weighted squares of each kind of residual equal its
    degrees of freedom.
    """
    known = given.variances
    unknown = np.isnan(known)
    variances = np.where(unknown, start, known)
    solution = model.solved(variances)
    settled = not unknown.any()
    for _ in range(0 if settled else MAX_NOISE_STEPS):
        squares, freedom = model.squares_and_freedom(variances, solution)
        squares[0] += PRIOR_FREEDOM * PRIOR_WHEEL_NOISE / variances[0]
        freedom[0] += PRIOR_FREEDOM
        ratios = np.where(unknown, np.maximum(squares, 1e-300) / freedom, 1.0)
        before = variances
        variances = np.where(unknown, np.clip(variances * ratios, LEAST, MOST), known)
        solution = model.solved(variances)
        settled = bool(np.abs(np.log(variances / before)).max() < NOISE_CONVERGED)
        if settled:
            break
    return variances, solution, settled
