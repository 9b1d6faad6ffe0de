"""The true motion of a robot whose wheels slip, and whose wheels are not as its odometry assumes.

Model: the distance that a true rim rolls has a random error whose variance is `k |ds|`. Time is divided
into cells of `CELL`. For each wheel and cell there is one standard normal number xi, a pure function of
seed, wheel and cell. From a command to the next one, or to the end of the cell, the wheel slips at

    xi (sqrt(V + k |v| t) - a) / t

with v its rim speed, t the time that is left of the cell, V the variance of the distance rolled so far
in it, and `xi a` what has been slipped. So the state at a time does not depend, to the last bit, on when
it is computed. Cells of a command that is held for longer than `HOLD` become wider.

Sources: doc/mathematics.md, "Slip"; Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as
1, 2, 3", 2011.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated, Any, TypeAlias

import numpy as np

from diffdrive_jacobian.numerics.checks import Checked, Positive, integer, optional
from diffdrive_jacobian.simulation.speeds import Piece, Profile, arc_end, moved, rolled
from diffdrive_jacobian.time_units import NANOSECONDS

CELL = 20_000_000
"""Width of a cell (ns)."""
HOLD = 600 * NANOSECONDS
"""Time of one command after which cells become wider (ns)."""
MAX_SEED = 2**63 - 1
"""Largest seed, that of an integer parameter of ROS."""
_BLOCK = 256
"""Number of cells whose random numbers are computed at once."""

Pose: TypeAlias = tuple[float, float, float]
_Slipped: TypeAlias = tuple[int, int, float, float, float, float]
"""Level and index of a cell; a and V of the right wheel, then of the left one (m, m^2)."""


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


class Truth:
    """The true pose of a robot, at the time of the `Robot` that has it. An immutable value to its users.

    The methods take the motion as the odometry has it: the nominal twist `(v, omega)`, the nominal wheel
    separation L (m), and k (m). All values were checked before.
    """

    __slots__ = ('_ahead', '_drift', '_held', '_slipped', 'pose')

    def __init__(
        self,
        drift: Drift,
        pose: Pose,
        slipped: _Slipped | None = None,
        held: tuple[tuple[float, float], int] | None = None,
    ) -> None:
        """Place the robot.

        `slipped` is what its wheels slipped in the present cell; None: it begins, or they rested in it.
        `held` is the twist that led here, and since when (ns); None: the robot rested.
        """
        self.pose = pose
        self._drift = drift
        self._slipped = slipped
        self._held = held
        # The last boundary of cells that was reached from here, and the motion that led to it.
        self._ahead: tuple[Any, int, Pose] | None = None

    def with_drift(self, drift: Drift) -> Truth:
        """Return the same pose with another drift."""
        return self if drift == self._drift else Truth(drift, self.pose)

    def moved(self, pose: Pose) -> Truth:
        """Return the truth of a robot that was put elsewhere. Its slip goes on."""
        return Truth(self._drift, pose, self._slipped, self._held)

    def at_rest(self) -> Truth:
        """Return the same pose of a robot that rests."""
        return self if self._held is None else Truth(self._drift, self.pose)

    def after(self, start: int, stamp: int, twist: tuple[float, float], L: float, k: float) -> Truth:
        """Return the truth after a nominal twist from `start`, the present time, to `stamp` (ns)."""
        drift = self._drift
        right, left, separation = self._wheels(twist, L)
        if drift.seed is None or not k:
            dt = (stamp - start) / NANOSECONDS
            v, omega = (right + left) / 2.0, (right - left) / separation
            return Truth(drift, arc_end(self.pose, (v, omega), dt))
        motion = start, twist, L, k
        since = self._since(start, twist)
        time, pose, slipped = start, self.pose, self._present(start, twist)
        if self._ahead is not None and self._ahead[1] <= stamp and self._ahead[0] == motion:
            _, time, pose = self._ahead
            slipped = None
        growth_R, growth_L = k * abs(right), k * abs(left)
        # Wheels at rest slip only to the end of the cell in which they stopped.
        while slipped is not None or right or left:
            level, cell, a_R, V_R, a_L, V_L = slipped or _fresh(time, time - since)
            end = (cell + 1) * (CELL << level)
            xi_R, xi_L = normals(drift.seed, level, cell)
            rest = (end - time) / NANOSECONDS
            gain_R, gain_L = _gain(a_R, V_R, growth_R, rest), _gain(a_L, V_L, growth_L, rest)
            rim_R, rim_L = right + gain_R * xi_R, left + gain_L * xi_L
            v, omega = (rim_R + rim_L) / 2.0, (rim_R - rim_L) / separation
            if stamp < end:
                dt = (stamp - time) / NANOSECONDS
                pose = arc_end(pose, (v, omega), dt)
                a_R, V_R = a_R + gain_R * dt, V_R + growth_R * dt
                a_L, V_L = a_L + gain_L * dt, V_L + growth_L * dt
                slipped = level, cell, a_R, V_R, a_L, V_L
                break
            pose = arc_end(pose, (v, omega), rest)
            time, slipped = end, None
            self._ahead = motion, time, pose
        return Truth(drift, pose, slipped, (twist, since))

    def along(self, motion: Profile, begin: int, end: int, L: float, k: float) -> Truth:
        """Return the truth after a nominal motion whose speeds change, from `begin`, now, to `end` (ns).

        In a cell a wheel slips at a constant speed from one piece of the motion to the next, such that
        at the end of the piece what was slipped has the variance of the distance so far.
        """
        # From the first cell on in which the twist is constant, as if it was commanded there.
        settled = max(begin, (motion.settled_at // CELL + 1) * CELL)
        here, time, last = self, begin, min(end, settled)
        if self._ahead is not None and self._ahead[0] is motion and self._ahead[1] <= last:
            _, time, pose = self._ahead
            here = Truth(self._drift, pose)
        while time < last:
            cell_end = (time // CELL + 1) * CELL
            here = here._in_cell(motion, time, min(cell_end, last), L, k)
            time = cell_end
            if cell_end <= last:
                self._ahead = motion, cell_end, here.pose
        return here.after(settled, end, motion.final, L, k) if end > settled else here

    def twist_along(self, motion: Profile, stamp: int, L: float, k: float) -> tuple[float, float]:
        """Return the true twist from a time (ns) on in such a motion."""
        wheels, _, _ = next(self._slipping(motion, stamp, L, k))
        right, left = wheels.twist(0.0)
        return (right + left) / 2.0, (right - left) / (L * self._drift.wheel_separation_multiplier)

    def _in_cell(self, motion: Profile, begin: int, end: int, L: float, k: float) -> Truth:
        """Return the truth after a part of a cell."""
        pose, slipped, cell = self.pose, None, begin // CELL
        separation = L * self._drift.wheel_separation_multiplier
        time, last = motion.seconds(begin), motion.seconds(end)
        for wheels, rolling, (a_R, V_R, gain_R, a_L, V_L, gain_L) in self._slipping(motion, begin, L, k):
            seconds = min(wheels.seconds, last - time)
            part = wheels.part(0.0, seconds)
            pose = moved(pose, part.mapped(((0.5, 0.5), (1.0 / separation, -1.0 / separation))))
            if end % CELL:
                rolled_R, rolled_L = (
                    k * rolled(rim, rolling, seconds) for rim in (rolling.v, rolling.omega)
                )
                slipped = (
                    *(0, cell, a_R + gain_R * seconds, V_R + rolled_R),
                    *(a_L + gain_L * seconds, V_L + rolled_L),
                )
            time += seconds
            if time >= last:
                break
        return Truth(self._drift, pose, slipped)

    def _slipping(
        self, motion: Profile, begin: int, L: float, k: float
    ) -> Iterator[tuple[Piece, Piece, tuple[float, float, float, float, float, float]]]:
        """Yield the pieces from a time (ns) to the end of its cell.

        Each is the speeds of the true rims of right and left wheel, with and without the slip, and a, V
        and the slip for xi = 1 of the right wheel, then of the left one, at its beginning.
        """
        drift, cell = self._drift, begin // CELL
        slips = drift.seed is not None and k > 0.0
        xi_R, xi_L = normals(drift.seed, 0, cell) if drift.seed is not None else (0.0, 0.0)
        a_R = V_R = a_L = V_L = gain_R = gain_L = 0.0
        if self._slipped is not None and self._slipped[:2] == (0, cell):
            _, _, a_R, V_R, a_L, V_L = self._slipped
        m_R, m_L = drift.right_wheel_radius_multiplier, drift.left_wheel_radius_multiplier
        rims = (m_R, m_R * L / 2.0), (m_L, -m_L * L / 2.0)
        end = motion.seconds((cell + 1) * CELL)
        for piece in motion.between(motion.seconds(begin), end):
            rolling = wheels = piece.mapped(rims)
            seconds = piece.seconds
            if slips:
                grown_R = V_R + k * rolled(rolling.v, rolling, seconds)
                grown_L = V_L + k * rolled(rolling.omega, rolling, seconds)
                gain_R = (math.sqrt(grown_R) - a_R) / seconds
                gain_L = (math.sqrt(grown_L) - a_L) / seconds
                wheels = rolling.faster(gain_R * xi_R, gain_L * xi_L)
            yield wheels, rolling, (a_R, V_R, gain_R, a_L, V_L, gain_L)
            if slips:
                a_R, V_R, a_L, V_L = math.sqrt(grown_R), grown_R, math.sqrt(grown_L), grown_L

    def twist(self, stamp: int, twist: tuple[float, float], L: float, k: float) -> tuple[float, float]:
        """Return the true twist, the slip included, while a nominal one is held from a time (ns) on."""
        right, left, separation = self._wheels(twist, L)
        seed = self._drift.seed
        if seed is not None and k:
            slipped = self._present(stamp, twist) or _fresh(stamp, stamp - self._since(stamp, twist))
            level, cell, a_R, V_R, a_L, V_L = slipped
            rest = ((cell + 1) * (CELL << level) - stamp) / NANOSECONDS
            xi_R, xi_L = normals(seed, level, cell)
            right += xi_R * _gain(a_R, V_R, k * abs(right), rest)
            left += xi_L * _gain(a_L, V_L, k * abs(left), rest)
        return (right + left) / 2.0, (right - left) / separation

    def _since(self, start: int, twist: tuple[float, float]) -> int:
        """Return since when a twist from a time on is held (ns)."""
        return self._held[1] if self._held is not None and self._held[0] == twist else start

    def _present(self, start: int, twist: tuple[float, float]) -> _Slipped | None:
        """Return what was slipped so far in the cell of a time, from which on a twist is held.

        A wide cell ends with the twist that was held.
        """
        if self._slipped is None:
            return None
        level, cell, *_ = self._slipped
        valid = level == 0 or self._since(start, twist) < start
        return self._slipped if valid and cell == start // (CELL << level) else None

    def _wheels(self, twist: tuple[float, float], L: float) -> tuple[float, float, float]:
        """Return the true rim speeds of right and left wheel without slip, and the true separation."""
        (v, omega), drift = twist, self._drift
        half = omega * L / 2.0
        return (
            (v + half) * drift.right_wheel_radius_multiplier,
            (v - half) * drift.left_wheel_radius_multiplier,
            L * drift.wheel_separation_multiplier,
        )


def _fresh(time: int, held: int) -> _Slipped:
    """Return the cell of a time (ns), in which nothing was slipped yet, by the time of its command."""
    level = (held // HOLD).bit_length()
    return level, time // (CELL << level), 0.0, 0.0, 0.0, 0.0


def _gain(a: float, variance: float, growth: float, rest: float) -> float:
    """Return the slip speed for xi = 1 in the rest of a cell (s), as in the module's equation (m/s).

    The variance of the slip so far grows by `growth = k |v|` (m^2/s).
    """
    return (math.sqrt(variance + growth * rest) - a) / rest


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
