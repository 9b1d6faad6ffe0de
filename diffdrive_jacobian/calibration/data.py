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

"""Wheels and a reference of the pose from a bag, as the calibration takes them."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import (
    BagError,
    open_bag,
    recorded_parameters,
)
from diffdrive_jacobian.bags.decoded import read_messages
from diffdrive_jacobian.calibration.model import CalibrationDrive
from diffdrive_jacobian.messages.codecs import (
    FRAME,
    JOINT_STATE,
    POSE_IN,
    STAMP,
    Codec,
    Wheels,
    pose_fields,
)
from diffdrive_jacobian.messages.conversion import MessageError, from_pose, from_time, quoted
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.time_units import NANOSECONDS

__all__ = ['WheelsAndReference', 'read_wheels_and_reference']

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
    """A pose of a sensor in space (ns, m, rad)."""

    stamp: int
    frame: str
    x: float
    y: float
    z: float
    theta: float
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


class Rows:
    """Messages of k values as columns: a bag may have millions of them."""

    def __init__(self, width: int) -> None:
        """Start without messages of `width` values."""
        self.width = width
        # Time of recording and stamp of each message, one after the other (ns).
        self.times: array[int] = array('q')
        self.values: array[float] = array('d')

    def add(self, received: int, stamp: int, values: Iterable[float]) -> None:
        """Add a message; without a stamp, 0, its time is that of recording."""
        self.times.extend((received, stamp or received))
        self.values.extend(values)

    def samples(self) -> Samples:
        """Return all messages."""
        received, stamps = np.frombuffer(self.times, dtype=np.int64).reshape(-1, 2).T
        values = np.frombuffer(self.values, dtype=np.float64).reshape(-1, self.width)
        return Samples(received=received, stamps=stamps, values=values)


class Joints:
    """Messages of the joints."""

    def __init__(self) -> None:
        """Start without messages."""
        # Positions, then velocities, of the messages with the same joints in the same order.
        self.rows: dict[tuple[str, ...], Rows] = {}

    def add(self, received: int, wheels: Wheels) -> None:
        """Add a message; MessageError if it is invalid."""
        names = wheels.joints
        unknown = [math.nan] * len(names)
        for values in (wheels.positions, wheels.velocities):
            if len(values) not in (0, len(names)):
                raise MessageError('joint state must have as many values as names')
        rows = self.rows.setdefault(names, Rows(2 * len(names)))
        rows.add(
            received, wheels.stamp, [*(wheels.positions or unknown), *(wheels.velocities or unknown)]
        )

    @property
    def names(self) -> list[str]:
        """Names of the joints, each once."""
        return list(dict.fromkeys(name for names in self.rows for name in names))

    def of(self, wheels: tuple[str, str], where: object, topic: str) -> tuple[Samples, bool]:
        """Return angles of right and left wheel, or their speeds, and whether it is these, by joints."""
        left, right = wheels
        for are_speeds in (False, True):
            found = []
            for names, rows in self.rows.items():
                if left in names and right in names:
                    samples, first = rows.samples(), are_speeds * len(names)
                    pairs = samples.values[:, [first + names.index(right), first + names.index(left)]]
                    times = np.column_stack([samples.received, samples.stamps])
                    finite = np.isfinite(pairs).all(axis=1)
                    found.append((times[finite], pairs[finite]))
            if sum(len(pairs) for _, pairs in found) > 1:
                times, values = map(np.concatenate, zip(*found, strict=True))
                order = np.argsort(times[:, 0], kind='stable')
                received, stamps = times[order].T
                return Samples(received=received, stamps=stamps, values=values[order]), are_speeds
        raise BagError(
            f'{where}: {topic} has less than two messages with finite positions or velocities of '
            f'{quoted(wheels)}'
        )


class Poses:
    """Messages of the reference."""

    def __init__(self) -> None:
        """Start without messages."""
        # x, y, theta, z and tilt of each.
        self.rows = Rows(5)
        self.frames: set[str] = set()

    def add(self, received: int, place: SpatialPlace) -> None:
        """Add a message."""
        self.rows.add(received, place.stamp, (place.x, place.y, place.theta, place.z, place.tilt))
        self.frames.add(place.frame)

    def of_floor(self, where: object, topic: str) -> Samples:
        """Return `[x, y, theta]`; BagError if they are in several frames, or not in one of a floor."""
        if len(self.frames) > 1:
            raise BagError(
                f'{where}: the poses on {topic} are in several frames, '
                f'{quoted(sorted(self.frames))}: one is needed'
            )
        samples = self.rows.samples()
        x, y, z = np.ptp(samples.values[:, [0, 1, 3]], axis=0).tolist()
        tilt = float(np.median(samples.values[:, 4]))
        if tilt > MOST_TILT or (np.isfinite(z) and z > 0.2 and z > 0.5 * max(x, y)):
            raise BagError(
                f'{where}: the frame of {topic} is not that of a floor with z up: the sensor is tilted '
                f'by {tilt:.2g} rad and moves by {z:.2g} m in z, {x:.2g} m in x and {y:.2g} m in y'
            )
        return replace(samples, values=samples.values[:, :3])


def common_clock(
    wheels: Samples, poses: Samples, wheels_topic: str, poses_topic: str
) -> tuple[Times, Times, str]:
    """Return the times of wheels and poses: their stamps, or those of recording and a note why."""
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
    """Return times in s, sorted, each once, with their values; BagError if the clock was reset."""
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


def unwrapped(time: Array, angles: Array, what: str) -> Array:
    """Return continuous angles, shape (n, 2) (rad): those within one turn are unwrapped."""
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


NO_REFERENCE = ('odom', 'goal_pose', 'initialpose', 'start_pose')
"""Topics that are no reference unless they are chosen: odometry is computed from the wheels."""
MISSING = 'are missing in the bag'


def chosen_topic(
    reader: Reader,
    given: str | None,
    option: str,
    usual: str,
    types: Sequence[str],
    *,
    any_name: bool = False,
) -> str:
    """Return the topic that is given, or the only one of some types with the usual base name.

    With `any_name` that may also be the only topic of these types, unless it is one of `NO_REFERENCE`.
    """
    where = printable(reader.path, PATH_LIMIT)
    candidates = sorted({one.topic for one in reader.connections if one.msgtype in types})
    found = {f'{printable(one.topic)} ({printable(one.msgtype)})' for one in reader.connections}
    listed = ', '.join(sorted(found)) or 'none'
    allowed = ' or '.join(types)
    if given is not None:
        topic = given if given.startswith('/') else f'/{given}'
        if topic in candidates:
            return topic
        others = sorted({one.msgtype for one in reader.connections if one.topic == topic})
        if others:
            raise BagError(f'{where}: {topic} must be of type {allowed}, got {", ".join(others)}')
        raise BagError(f'{where} has no topic {topic}; it has {listed}')
    named = [topic for topic in candidates if base_name(topic) == usual]
    if not named and any_name:
        named = [topic for topic in candidates if base_name(topic) not in NO_REFERENCE]
    if len(named) == 1:
        return named[0]
    if not named:
        hint = f' (choose one with {option})' if candidates else ''
        raise BagError(f'{where} has no topic {usual} of type {allowed}; it has {listed}{hint}')
    raise BagError(f'{where} has several such topics, {", ".join(named)}: choose one with {option}')


def wheel_names(
    where: object,
    topic: str,
    joints: Collection[str],
    given: tuple[str, str] | None,
    parameters: dict[str, dict[str, Any]],
) -> tuple[str, str]:
    """Return the joints of the left and the right wheel."""
    if given is not None:
        if given[0] == given[1]:
            raise BagError(f"{where}: both wheels are given as the joint '{printable(given[0])}'")
        for name in given:
            if name not in joints:
                raise BagError(
                    f"{where}: {topic} has no joint '{printable(name)}'; it has {quoted(sorted(joints))}"
                )
        return given
    for values in parameters.values():
        pair = (values.get('left_wheel_name'), values.get('right_wheel_name'))
        lists = (values.get('left_wheel_names'), values.get('right_wheel_names'))
        if all(isinstance(one, list) and one for one in lists):
            pair = (lists[0][0], lists[1][0])  # type: ignore[index]
        left, right = pair
        if isinstance(left, str) and isinstance(right, str) and left in joints and right in joints:
            return left, right
    found = [[name for name in joints if side in name.lower()] for side in ('left', 'right')]
    wheels = [[name for name in names if 'wheel' in name.lower()] or names for names in found]
    if [len(names) for names in wheels] != [1, 1]:
        raise BagError(
            f'{where}: the joints of the wheels on {topic} must be given with --wheels LEFT RIGHT; '
            f'it has {quoted(sorted(joints))}'
        )
    return wheels[0][0], wheels[1][0]


def dimensions_of(where: object, parameters: dict[str, dict[str, Any]]) -> tuple[float, float] | None:
    """Return the wheel radius and the wheel separation of the nodes; None: not recorded (m)."""
    found = set()
    for values in parameters.values():
        pair = (values.get('wheel_radius'), values.get('wheel_separation'))
        if all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in pair):
            radius, separation = (float(one) for one in pair if one is not None)
            if 0.0 < radius < math.inf and 0.0 < separation < math.inf:
                found.add((radius, separation))
    if len(found) > 1:
        listed = ', '.join(f'{radius:g} and {separation:g} m' for radius, separation in sorted(found))
        raise BagError(
            f'{where}: its nodes have several wheel radii and separations, {listed}: choose with '
            '--wheel-radius and --wheel-separation'
        )
    return found.pop() if found else None


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelsAndReference:
    """What a bag has for a calibration."""

    recording: CalibrationDrive
    wheels_topic: str
    reference_topic: str
    wheel_names: tuple[str, str]
    """Joints of the left and the right wheel."""
    dimensions: tuple[float, float] | None
    """Nominal wheel radius and wheel separation that the bag's parameters have (m)."""
    notes: tuple[str, ...] = ()


def read_wheels_and_reference(
    path: str | Path,
    *,
    wheels: str | None = None,
    reference: str | None = None,
    names: tuple[str, str] | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> WheelsAndReference:
    """Read the angles of the wheels and the poses of a reference.

    Args:
        path: The bag's directory, or an MCAP or SQLite file.
        wheels: Topic of the wheels (default: joint_states, in any namespace).
        reference: Topic of the reference (default: ground_truth, or the only topic of poses).
        names: Joints of the left and the right wheel (default: from the parameters in the bag, or the
            two joints with left and right in their names).
        interrupted: Is called for each message; once it returns True, reading ends.

    Raises:
        InterruptionError: `interrupted` returned True.
        BagError: It is not a bag, is damaged, or has not what is needed.
    """
    path = Path(path)
    with open_bag(path) as reader:
        parameters = recorded_parameters(reader)
        wheels_topic = chosen_topic(
            reader, wheels, '--wheels-topic', 'joint_states', (JOINT_STATE.type_name,)
        )
        poses_topic = chosen_topic(
            reader, reference, '--reference', 'ground_truth', tuple(POSES), any_name=True
        )
        joints, poses = Joints(), Poses()
        sinks: dict[str, Joints | Poses] = {wheels_topic: joints, poses_topic: poses}
        kinds: dict[str, Codec[Any]] = {JOINT_STATE.type_name: JOINT_STATE, **POSES}
        codecs = {
            one.id: kinds[one.msgtype]
            for one in reader.connections
            if one.topic in sinks and one.msgtype in kinds
        }
        tally = read_messages(
            reader,
            codecs,
            lambda connection, received, value: sinks[connection.topic].add(received, value),
            interrupted,
        )
    where = printable(path, PATH_LIMIT)
    for topic, found in ((wheels_topic, joints.names), (poses_topic, poses.frames)):
        if not found:
            reasons = [f'{number} {why}' for why, number in tally.reasons[topic].items()]
            reasons += [f'{tally.missing[topic]} {MISSING}'] if tally.missing[topic] else []
            colon = ': ' if reasons else ''
            raise BagError(f'{where} has no usable message on {topic}{colon}{", ".join(reasons)}')
    chosen = wheel_names(where, wheels_topic, joints.names, names, parameters)
    measured, from_speeds = joints.of(chosen, where, wheels_topic)
    observed = poses.of_floor(where, poses_topic)
    notes = [*tally.notes()]
    wheel_time, pose_time, note = common_clock(measured, observed, wheels_topic, poses_topic)
    notes += [note] if note else []
    origin = min(int(np.min(wheel_time)), int(np.min(pose_time)))
    wheel_seconds, angles = increasing(wheel_time - origin, measured.values, f'{where}: {wheels_topic}')
    pose_seconds, values = increasing(pose_time - origin, observed.values, f'{where}: {poses_topic}')
    if from_speeds:
        steps = (angles[1:] + angles[:-1]) / 2.0 * np.diff(wheel_seconds)[:, None]
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        notes.append(f'{wheels_topic} has no angles: they are integrated from the speeds')
    else:
        angles = unwrapped(wheel_seconds, angles, f'{where}: {wheels_topic}')
    return WheelsAndReference(
        recording=CalibrationDrive(
            name=str(where),
            wheel_time=wheel_seconds,
            wheel_angles=angles,
            pose_time=pose_seconds,
            poses=values,
        ),
        wheels_topic=wheels_topic,
        reference_topic=poses_topic,
        wheel_names=chosen,
        dimensions=dimensions_of(where, parameters),
        notes=tuple(notes),
    )
