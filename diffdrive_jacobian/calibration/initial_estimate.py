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

"""Approximate parameters by linear least squares over short parts of the drives.

They are where the estimate starts, and what jumps of the reference are compared with. Robust: parts that
do not fit have no weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.calibration.model import (
    CLOCKS,
    SENSOR,
    Array,
    CalibrationError,
    Segment,
    calibrated,
)
from diffdrive_jacobian.calibration.motion import (
    Geometry,
    Increments,
    composed,
    increments,
    inverted,
    relative,
)
from diffdrive_jacobian.numerics.elementary import wrap

PARTS = 400
"""Largest number of parts into which the drives are divided."""
ROUNDS = 6
LEAST = 0.05
"""Wheel angle below which the wheels count as never turning (rad)."""
LEAST_MOVE = 0.1
"""Extent of the path of a reference that moves (m)."""
LEAST_TURN, FIXED = 1.0, 0.05
"""Turn of the robot (rad), and share of it, below which the heading of the reference is fixed."""
UNITS = {
    'feet': 3.2808,
    'inches': 39.370,
    'centimetres': 100.0,
    'millimetres': 1000.0,
    'kilometres': 1e-3,
}
"""Units of a reference, by how many of them are a metre."""


def differences(segment: Segment, nominal: Geometry, parameters: Array) -> tuple[Array, Array]:
    """Return how steps of the reference differ from those of the wheels, and these distances.

    Shapes (n - 1, 3) and (n - 1,).
    """
    sensor = parameters[SENSOR]
    moved = _moved(segment, calibrated(nominal, parameters), parameters)
    expected = composed(composed(inverted(sensor), moved.steps), sensor)
    found = relative(segment.poses[:-1], segment.poses[1:])
    difference = relative(expected, found)
    difference[:, 2] = wrap(difference[:, 2])
    return difference, moved.travel


def _moved(segment: Segment, geometry: Geometry, parameters: Array) -> Increments:
    return increments(segment.wheel_time, segment.wheel_angles, segment.at(parameters), geometry)


def initial_estimate(segments: Sequence[Segment], nominal: Geometry, parameters: Array) -> Array:
    """Return parameters from continuous motions, given those of the clocks."""
    parts = [_parts(one, nominal, parameters) for one in segments]
    radii, separation = np.array(nominal.radii), nominal.separation
    angles = np.concatenate([angle for angle, _ in parts])
    rims = angles * radii
    if np.abs(angles).sum() < LEAST:
        raise CalibrationError(
            f'the wheels never turn: they move by {np.abs(angles).sum():.3g} rad in all'
        )
    turns = np.concatenate([turn for _, turn in parts])
    moves = max(float(np.max(np.ptp(one.poses[:, :2], axis=0))) for one in segments) > LEAST_MOVE
    _check_turning(angles, turns, (rims[:, 0] - rims[:, 1]) / separation, moves)
    gains = _robust(
        np.column_stack([rims[:, 0], -rims[:, 1]]) / separation, turns, [1.0, 1.0], [0.7, 0.7], 0.02
    )
    if gains.sum() < 0.0:
        raise CalibrationError(
            'the headings of the reference turn against those of the wheels: the left and the right '
            'wheel are swapped, an angle has the wrong sign, or the frame of the reference is mirrored '
            'or upside down'
        )
    # From here on the turns of the wheels agree with those of the reference.
    gains = np.clip(gains, 0.05, 20.0)
    turning = replace(nominal, multipliers=(float(gains[1]), float(gains[0]), 1.0))
    equations = (_positions(one, turning, parameters) for one in segments)
    A, b = map(np.concatenate, zip(*equations, strict=True))
    found = _robust(A, b, [1.0, 0.0, 0.0, 0.0], [10.0, 10.0, 1.0, 1.0], 0.01)
    scale = float(np.hypot(*found[:2]))
    if not 0.05 <= scale <= 20.0:
        raise CalibrationError(
            f'the reference moves {scale:.4g} times as far as the wheels: its poses are not those of '
            f'this robot, or in {unit(scale)} instead of metres, or the nominal wheel radius is wrong'
        )
    yaw = float(np.arctan2(found[1], found[0]))
    c, s = np.cos(yaw), np.sin(yaw)
    lever = np.array([[c, -s], [s, c]]) @ found[2:]
    left, right = (float(np.clip(gain * scale, 0.05, 20.0)) for gain in (gains[1], gains[0]))
    found = np.array([*np.log([left, right, scale]), *lever, yaw])
    return np.concatenate([found, parameters[CLOCKS:]])


def unit(scale: float) -> str:
    """Return the unit of a reference that explains its scale."""
    found = [name for name, per_metre in UNITS.items() if abs(scale / per_metre - 1.0) < 0.1]
    return found[0] if found else 'another unit'


def _check_turning(angles: Array, turns: Array, expected: Array, moves: bool) -> None:
    """Raise CalibrationError if a wheel never turns, or only the headings of the reference are fixed."""
    right, left = np.abs(angles).sum(axis=0).tolist()
    for name, value, other in (('right', right, left), ('left', left, right)):
        if value < LEAST:
            raise CalibrationError(
                f'the {name} wheel never turns: it moves by {value:.3g} rad in all, the other one by '
                f'{other:.3g} rad'
            )
    turned, should = float(np.abs(turns).sum()), float(np.abs(expected).sum())
    if moves and should > LEAST_TURN and turned < FIXED * should:
        raise CalibrationError(
            f'the heading of the reference changes by {turned:.2g} rad while the wheels turn the robot '
            f'by {should:.3g} rad: it observes positions only, but its headings are needed'
        )


def _ends(travel: Array, separation: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last pose of each part."""
    length = max(2.0 * separation, float(travel.sum()) / PARTS)
    place = np.concatenate([[0.0], np.cumsum(travel)])
    bounds = np.unique(np.searchsorted(place, np.arange(0.0, place[-1] + length, length)))
    bounds = np.unique(np.minimum(bounds, len(place) - 1))
    return bounds[:-1], bounds[1:]


def _parts(segment: Segment, nominal: Geometry, parameters: Array) -> tuple[Array, Array]:
    """Return the turns of both wheels and of the sensor in each part, shapes (n, 2) and (n,) (rad)."""
    moved = _moved(segment, nominal, parameters)
    first, last = _ends(moved.travel, nominal.separation)
    at = segment.at(parameters)
    angles = np.column_stack(
        [np.interp(at, segment.wheel_time, segment.wheel_angles[:, side]) for side in (0, 1)]
    )
    # Relative to the wheels the heading changes too little between two poses to be ambiguous.
    heading = segment.poses[:, 2] - moved.poses[:, 2]
    heading = moved.poses[:, 2] + np.unwrap(heading)
    return angles[last] - angles[first], heading[last] - heading[first]


def _positions(segment: Segment, geometry: Geometry, parameters: Array) -> tuple[Array, Array]:
    """Return equations for the scale, the yaw offset and the lever arm: `A x = b`."""
    moved = _moved(segment, geometry, parameters)
    first, last = _ends(moved.travel, geometry.separation)
    step = relative(moved.poses[first], moved.poses[last])
    found = relative(segment.poses[first], segment.poses[last])
    c, s = np.cos(step[:, 2]), np.sin(step[:, 2])
    x, y = step[:, 0], step[:, 1]
    A = np.concatenate([np.column_stack([x, y, c - 1.0, -s]), np.column_stack([y, -x, s, c - 1.0])])
    return A, np.concatenate([found[:, 0], found[:, 1]])


def _robust(
    A: Array, b: Array, prior: Sequence[float], deviations: Sequence[float], noise: float
) -> Array:
    """Return the least-squares solution of `A x = b` without outliers (Tukey).

    `noise` is the standard deviation of the equations for the weight of the prior, and the least scale.
    """
    ridge = np.diag(noise**2 / np.square(deviations))
    target = ridge @ np.asarray(prior)
    weights: Array = np.ones(len(b))
    x: Array = np.asarray(prior, dtype=np.float64)
    for _ in range(ROUNDS):
        weighted = A * weights[:, None]
        x = np.linalg.solve(weighted.T @ A + ridge, weighted.T @ b + target)
        error = np.abs(b - A @ x)
        scale = max(noise, 1.4826 * float(np.median(error)))
        weights = np.maximum(0.0, 1.0 - (error / (6.0 * scale)) ** 2) ** 2
    return x
