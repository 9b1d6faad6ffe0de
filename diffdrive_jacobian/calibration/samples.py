"""Messages of wheels and of a reference as samples over time."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError
from diffdrive_jacobian.messages.codecs import FRAME, POSE_IN, STAMP, Codec, Wheels, pose_fields
from diffdrive_jacobian.messages.conversion import MessageError, from_pose, from_time, quoted
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
Times = NDArray[np.int64]

MOST_TILT = 0.5
"""Median tilt of the sensor beyond which its frame is not that of a floor (rad)."""
FARTHEST = 2e7
"""Largest coordinate of a reference, such as UTM coordinates (m)."""
FASTEST = 300.0
"""Wheel speed beyond which angles jump (rad/s)."""
BACK = 0.5
"""A clock that goes back further was reset (s)."""


class SpatialPlace(NamedTuple):
    """A pose of a sensor in space."""

    stamp: int
    """(ns)"""
    frame: str
    x: float
    """(m), as y and z."""
    y: float
    z: float
    theta: float
    """Yaw (rad)."""
    tilt: float
    """Angle between its z axis and that of the frame (rad)."""


def _spatial(sec: int, nanosec: int, frame: str, x: float, y: float, *more: float) -> SpatialPlace:
    qx, qy, qz, qw, z = more
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST):
        raise MessageError(f'position must be finite and within {FARTHEST:g} m')
    _, _, theta = from_pose(0.0, 0.0, qx, qy, qz, qw)
    tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (qx**2 + qy**2))))
    return SpatialPlace(from_time(sec, nanosec), frame, x, y, z, theta, tilt)


POSES = {
    kind: Codec(kind, (*STAMP, FRAME, *pose_fields(kind), f'{prefix}position.z'), _spatial)
    for kind, prefix in POSE_IN.items()
}
"""Types of a reference."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Samples:
    """Values over time, in the order of their recording."""

    received: Times
    """Times of recording, shape (n,) (ns)."""
    stamps: Times
    """Stamps, shape (n,) (ns)."""
    values: Array
    """Shape (n, k)."""


@dataclass(slots=True)
class _Layout:
    """Messages with the same joints, as columns: a bag may have millions of them."""

    order: array[int] = field(default_factory=lambda: array('q'))
    """Index of each message on its topic, time of recording and stamp (ns), one after the other."""
    positions: array[float] = field(default_factory=lambda: array('d'))
    speeds: array[float] = field(default_factory=lambda: array('d'))


@dataclass(slots=True)
class JointRows:
    """Messages of the joints: time of recording, stamp, positions and speeds by name."""

    layouts: dict[tuple[str, ...], _Layout] = field(default_factory=dict)
    count: int = 0

    def add(self, received: int, wheels: Wheels) -> None:
        """Add a message.

        Raises:
            MessageError: It is invalid.
        """
        names = wheels.joints
        for values in (wheels.positions, wheels.velocities):
            if len(values) not in (0, len(names)):
                raise MessageError('joint state must have as many values as names')
        layout = self.layouts.setdefault(names, _Layout())
        layout.order.extend((self.count, received, wheels.stamp or received))
        for table, values in ((layout.positions, wheels.positions), (layout.speeds, wheels.velocities)):
            table.extend(values if len(values) else [math.nan] * len(names))
        self.count += 1

    @property
    def names(self) -> list[str]:
        """Names of the joints, each once."""
        return list(dict.fromkeys(name for names in self.layouts for name in names))

    def of(self, wheels: tuple[str, str], where: object, topic: str) -> tuple[Samples, bool]:
        """Return the angles of the right and the left wheel, or their speeds if there are none.

        Args:
            wheels: Joints of the left and the right wheel.
            where: The bag, for messages.
            topic: The topic, for messages.

        Returns:
            The samples, and whether these are speeds.

        Raises:
            BagError: There are fewer than two.
        """
        left, right = wheels
        for are_speeds in (False, True):
            orders: list[Any] = [np.empty((0, 3), dtype=np.int64)]
            values: list[Any] = [np.empty((0, 2))]
            for names, layout in self.layouts.items():
                if left not in names or right not in names:
                    continue
                table = layout.speeds if are_speeds else layout.positions
                pairs = _columns(table, len(names))[:, [names.index(right), names.index(left)]]
                finite = np.isfinite(pairs).all(axis=1)
                orders.append(np.frombuffer(layout.order, dtype=np.int64).reshape(-1, 3)[finite])
                values.append(pairs[finite])
            order, found = np.concatenate(orders), np.concatenate(values)
            if len(order) > 1:
                order, found = order[(rank := np.argsort(order[:, 0]))], found[rank]
                return Samples(received=order[:, 1], stamps=order[:, 2], values=found), are_speeds
        raise BagError(
            f'{where}: {topic} has less than two messages with finite positions or velocities of '
            f'{quoted(wheels)}'
        )


@dataclass(slots=True)
class PoseRows:
    """Messages of the reference: time of recording, stamp, x, y, theta, z, tilt."""

    times: array[int] = field(default_factory=lambda: array('q'))
    """Time of recording and stamp of each message, one after the other (ns)."""
    poses: array[float] = field(default_factory=lambda: array('d'))
    """x, y, theta, z and tilt of each."""
    frames: Counter[str] = field(default_factory=Counter)
    count: int = 0

    def add(self, received: int, place: SpatialPlace) -> None:
        """Add a message."""
        self.times.extend((received, place.stamp or received))
        self.poses.extend((place.x, place.y, place.theta, place.z, place.tilt))
        self.frames[place.frame] += 1
        self.count += 1

    def samples(self) -> Samples:
        """Return `[x, y, theta]` over time."""
        received, stamps = np.frombuffer(self.times, dtype=np.int64).reshape(-1, 2).T
        return Samples(received=received, stamps=stamps, values=_columns(self.poses, 5)[:, :3])

    def check(self, where: object, topic: str) -> None:
        """Raise BagError if the poses are in several frames, or not in one of the floor."""
        if len(self.frames) > 1:
            raise BagError(
                f'{where}: the poses on {topic} are in several frames, '
                f'{quoted(sorted(self.frames))}: one is needed'
            )
        values = _columns(self.poses, 5)
        x, y, z = (float(np.ptp(values[:, column])) for column in (0, 1, 3))
        tilt = float(np.median(values[:, 4]))
        if tilt > MOST_TILT or (np.isfinite(z) and z > 0.2 and z > 0.5 * max(x, y)):
            raise BagError(
                f'{where}: the frame of {topic} is not that of a floor with z up: the sensor is tilted '
                f'by {tilt:.2g} rad and moves by {z:.2g} m in z, {x:.2g} m in x and {y:.2g} m in y'
            )


def _columns(table: array[float], width: int) -> Array:
    """Return a table as rows, shape (n, width)."""
    return np.frombuffer(table, dtype=np.float64).reshape(-1, width)


def common_clock(
    wheels: Samples, poses: Samples, wheels_topic: str, poses_topic: str
) -> tuple[Times, Times, str]:
    """Return the times of the wheels and of the poses, and a note.

    These are the stamps. If the stamps have no time in common, the clocks differ, and the times of
    recording are returned.
    """
    begin = max(int(np.min(wheels.stamps)), int(np.min(poses.stamps)))
    end = min(int(np.max(wheels.stamps)), int(np.max(poses.stamps)))
    if begin < end:
        return wheels.stamps, poses.stamps, ''
    apart = (int(poses.stamps[0]) - int(wheels.stamps[0])) / NANOSECONDS
    note = (
        f'the stamps on {poses_topic} and {wheels_topic} are {apart:.1f} s apart: they are of different '
        'clocks, so the times of recording are used'
    )
    return wheels.received, poses.received, note


def increasing(times: Times, values: Array, what: str) -> tuple[Array, Array]:
    """Return times in s, sorted, each once, with their values.

    Raises:
        BagError: The clock was reset.
    """
    steps = np.diff(times)
    if len(steps) and steps.min() < -BACK * NANOSECONDS:
        at = int(np.argmin(steps))
        raise BagError(
            f'{what} goes back in time by {-steps[at] / NANOSECONDS:.3f} s after '
            f'{(times[at] - np.min(times)) / NANOSECONDS:.3f} s: its clock was reset; '
            'split the bag there'
        )
    unique, first = np.unique(times, return_index=True)
    return np.asarray(unique / NANOSECONDS), values[first]


def integrated(time: Array, speeds: Array) -> Array:
    """Return angles from speeds, by trapezoids, shape (n, 2) (rad)."""
    means = (speeds[1:] + speeds[:-1]) / 2.0
    steps = means * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def unwrapped(time: Array, angles: Array, what: str) -> Array:
    """Return angles that are continuous, shape (n, 2) (rad). Those within one turn are unwrapped.

    Raises:
        BagError: An angle jumps.
    """
    if len(angles) > 1 and np.ptp(angles) <= 2.0 * math.pi + 1e-3:
        angles = np.asarray(np.unwrap(angles, axis=0), dtype=np.float64)
    speeds = np.abs(np.diff(angles, axis=0)).max(axis=1) / np.maximum(np.diff(time), 1e-3)
    if len(speeds) and np.max(speeds) > FASTEST:
        at = int(np.argmax(speeds))
        step = float(np.abs(angles[at + 1] - angles[at]).max())
        raise BagError(
            f'{what}: an angle of a wheel jumps by {step:.3g} rad after {time[at]:.3f} s: its counter '
            'was reset; split the bag there'
        )
    return angles
