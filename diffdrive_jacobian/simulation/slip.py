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

"""The true motion of a robot whose wheels slip, and whose wheels are not as its odometry assumes.

Model: the distance that a true rim rolls has a random error whose variance is `k |ds|`. Time is divided
into cells of `CELL`. For each wheel and cell there is one standard normal number xi, a pure function of
seed, wheel and cell. From a command to the next one, or to the end of the cell, the wheel slips at

    xi (sqrt(V + k |v| t) - a) / t

with v its rim speed, t the time that is left of the cell, V the variance of the distance rolled so far
in it, and `xi a` what has been slipped. So the state at a time does not depend, to the last bit, on when
it is computed. Cells of a command that is held for longer than `HOLD` become wider.

Sources: doc/moments.md, "Slip"; Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as
1, 2, 3", 2011.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated, NamedTuple

import numpy as np

from diffdrive_jacobian.numerics.checks import Checked, Positive, integer, optional
from diffdrive_jacobian.simulation.speeds import (
    STANDSTILL,
    Course,
    Piece,
    Pose,
    Profile,
    combined,
    moved,
)
from diffdrive_jacobian.time_units import NANOSECONDS

CELL = 20_000_000
"""Width of a cell (ns)."""
HOLD = 600 * NANOSECONDS
"""Time of one command after which cells become wider (ns)."""
MAX_SEED = 2**63 - 1
"""Largest seed, that of an integer parameter of ROS."""
_BLOCK = 256
"""Number of cells whose random numbers are computed at once."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Drift(Checked):
    """In what the true motion differs from the odometry.

    Raises:
        ValueError: The seed is not an integer from 0 to `MAX_SEED`, or a multiplier is not positive and
            finite.
    """

    seed: Annotated[int | None, optional(partial(integer, low=0, high=MAX_SEED))] = None
    """Seed of the random slip. None: the wheels do not slip."""
    right_wheel_radius_multiplier: Positive = 1.0
    """True radius of the right wheel, relative to the one that the odometry assumes [-]."""
    left_wheel_radius_multiplier: Positive = 1.0
    """True radius of the left wheel, relative to the one that the odometry assumes [-]."""
    wheel_separation_multiplier: Positive = 1.0
    """True wheel separation, relative to the one that the odometry assumes [-]."""


class Wheel(NamedTuple):
    """What a wheel has slipped in the present cell."""

    a: float = 0.0
    """Distance slipped, for xi = 1 (m)."""
    V: float = 0.0
    """Variance of the distance rolled (m^2)."""

    def slip(self, rolling: Course, seconds: float, k: float) -> float:
        """Return the speed of the slip for xi = 1, which has the variance of the distance after a time
        (s).
        """
        return (math.sqrt(self.V + k * rolling.rolled(seconds)) - self.a) / seconds

    def after(self, rolling: Course, slip: float, seconds: float, k: float) -> Wheel:
        """Return the wheel after a time (s) in which it slipped at a speed for xi = 1."""
        return Wheel(self.a + slip * seconds, self.V + k * rolling.rolled(seconds))


class Cell(NamedTuple):
    """A cell of time, with the wheels in it."""

    level: int
    """The cell has the width `CELL << level`."""
    number: int
    """It begins at this multiple of its width."""
    wheels: tuple[Wheel, Wheel] = (Wheel(), Wheel())
    """Right, left."""

    @property
    def end(self) -> int:
        """Time of the end (ns)."""
        return (self.number + 1) * (CELL << self.level)


class Truth:
    """The true pose of a robot, at the time of the `Robot` that has it. An immutable value to its users.

    The methods take the motion as the odometry has it, the nominal wheel separation L (m), and k (m).
    All values were checked before.
    """

    __slots__ = ('_ahead', '_cell', '_drift', 'pose')

    def __init__(self, drift: Drift, pose: Pose, cell: Cell | None = None) -> None:
        """Place the robot. `cell` is the present one; None: it begins, or the wheels rested in it."""
        self.pose = pose
        self._drift = drift
        self._cell = cell
        # The last boundary of cells that was reached from here, and the motion that led to it.
        self._ahead: tuple[Profile, int, Pose] | None = None

    def with_drift(self, drift: Drift) -> Truth:
        """Return the same pose with another drift."""
        return self if drift == self._drift else Truth(drift, self.pose)

    def moved(self, pose: Pose) -> Truth:
        """Return the truth of a robot that was put elsewhere. Its slip goes on."""
        return Truth(self._drift, pose, self._cell)

    def at_rest(self) -> Truth:
        """Return the same pose of a robot that rests."""
        return Truth(self._drift, self.pose)

    def after(self, motion: Profile, begin: int, end: int, L: float, k: float) -> Truth:
        """Return the truth after a nominal motion from `begin`, the present time, to `end` (ns)."""
        time, pose, cell = begin, self.pose, self._cell
        if self._drift.seed is None or not k:
            for piece, _ in motion.steps(motion.seconds(begin), motion.seconds(end)):
                pose = moved(pose, self._body(piece.seconds, self._rims(piece, L), L))
            return Truth(self._drift, pose)
        if self._ahead is not None and self._ahead[0] is motion and self._ahead[1] <= end:
            _, time, pose = self._ahead
            cell = None
        while time < end:
            if cell is None and motion.holds(STANDSTILL, time):
                # Wheels at rest slip only to the end of the cell in which they stopped.
                break
            cell = _present(cell, motion, time)
            pose, there = self._in_cell(cell, pose, motion, time, min(cell.end, end), L, k)
            time, cell = cell.end, there
            if time <= end:
                cell, self._ahead = None, (motion, time, pose)
        return Truth(self._drift, pose, cell)

    def twist(self, motion: Profile, stamp: int, L: float, k: float) -> tuple[float, float]:
        """Return the true twist, the slip included, from a time (ns) on."""
        cell = _present(self._cell, motion, stamp)
        # None after years, when the rest of a cell is shorter than the resolution of its time.
        pieces = motion.between(motion.seconds(stamp), motion.seconds(cell.end))
        piece = pieces[0] if pieces else motion.pieces[-1].part(0.0, 1.0)
        rims = self._rims(piece, L)
        v, omega = self._body(0.0, self._slipping(cell, rims, piece.seconds, k)[0], L).twist(0.0)
        return v, omega

    def _in_cell(
        self, cell: Cell, pose: Pose, motion: Profile, begin: int, end: int, L: float, k: float
    ) -> tuple[Pose, Cell]:
        """Return the pose and the cell after a part of it, from `begin` to `end` (ns)."""
        remaining = motion.seconds(end) - motion.seconds(begin)
        for piece in motion.between(motion.seconds(begin), motion.seconds(cell.end)):
            rims = self._rims(piece, L)
            # The speed of the slip is that for the whole piece.
            slipping, slips = self._slipping(cell, rims, piece.seconds, k)
            seconds = min(piece.seconds, remaining)
            pose = moved(pose, self._body(seconds, slipping, L))
            right, left = (
                wheel.after(rim, slip, seconds, k)
                for wheel, rim, slip in zip(cell.wheels, rims, slips, strict=True)
            )
            cell, remaining = cell._replace(wheels=(right, left)), remaining - seconds
            if remaining <= 0.0:
                break
        return pose, cell

    def _slipping(
        self, cell: Cell, rims: tuple[Course, Course], seconds: float, k: float
    ) -> tuple[tuple[Course, Course], list[float]]:
        """Return the speeds of the rims with the slip, and those of the slip for xi = 1."""
        seed = self._drift.seed
        if seed is None or not k:
            return rims, [0.0, 0.0]
        slips = [wheel.slip(rim, seconds, k) for wheel, rim in zip(cell.wheels, rims, strict=True)]
        xi_R, xi_L = normals(seed, cell.level, cell.number)
        return (rims[0].plus(xi_R * slips[0]), rims[1].plus(xi_L * slips[1])), slips

    def _rims(self, piece: Piece, L: float) -> tuple[Course, Course]:
        """Return the speeds of the true rims of right and left wheel without slip."""
        drift = self._drift
        return piece.rims(L, drift.right_wheel_radius_multiplier, drift.left_wheel_radius_multiplier)

    def _body(self, seconds: float, rims: tuple[Course, Course], L: float) -> Piece:
        """Return the true motion of the body, from the speeds of the true rims."""
        (right, left), separation = rims, L * self._drift.wheel_separation_multiplier
        v = combined(0.5, right, 0.5, left)
        return Piece(seconds, v, combined(1.0 / separation, right, -1.0 / separation, left))


def _present(cell: Cell | None, motion: Profile, time: int) -> Cell:
    """Return the cell of a time (ns): the present one, or one in which nothing was slipped yet.

    A wide cell ends with the twist that was held.
    """
    held = time - motion.settled_at
    if cell and (cell.level == 0 or held > 0) and cell.number == time // (CELL << cell.level):
        return cell
    level = (max(held, 0) // HOLD).bit_length()
    return Cell(level, time // (CELL << level))


def normals(seed: int, level: int, cell: int) -> tuple[float, float]:
    """Return the numbers xi of the right and the left wheel in the cell of width `CELL << level`."""
    block, place = divmod(cell, _BLOCK)
    return _block(seed, level, block)[place]


@lru_cache(maxsize=32)
def _block(seed: int, level: int, block: int) -> tuple[tuple[float, float], ...]:
    """Compute the numbers of `normals` for `_BLOCK` cells."""
    first = level << 64 | block * _BLOCK % 2**64
    wheels = []
    for wheel in (0, 1):
        # The generator increases its counter before each use. A counter gives four words.
        generator = np.random.Philox(key=wheel << 64 | seed, counter=(first - 1) % 2**256)
        words = generator.random_raw(4 * _BLOCK).tolist()
        wheels.append(list(map(_normal, words[0::4], words[1::4])))
    return tuple(zip(*wheels, strict=True))


def _normal(first: int, second: int) -> float:
    """Return a standard normal number from two random words of 64 bits."""
    # Uniform in (0, 1] and in [0, 1), with 53 bits. Functions of NumPy may differ between processors.
    radius = math.sqrt(-2.0 * math.log(((first >> 11) + 1) * 2.0**-53))
    return radius * math.cos(math.tau * ((second >> 11) * 2.0**-53))
