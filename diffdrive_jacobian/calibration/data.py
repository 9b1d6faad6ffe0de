"""Wheels and a reference of the pose from a bag, as the calibration takes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import (
    BagError,
    ReadingInterruptedError,
    messages,
    open_bag,
    recorded_parameters,
    stored_connections,
)
from diffdrive_jacobian.bags.known_types import (
    known_structure,
    recorded_definition_differs,
    type_hashes,
)
from diffdrive_jacobian.calibration.choice import chosen_topic, dimensions_of, wheel_names
from diffdrive_jacobian.calibration.measurements import Recording
from diffdrive_jacobian.calibration.samples import (
    POSES,
    JointRows,
    PoseRows,
    common_clock,
    increasing,
    integrated,
    unwrapped,
)
from diffdrive_jacobian.messages.cdr import DecodingError, LongMessageError
from diffdrive_jacobian.messages.codecs import JOINT_STATE, Codec
from diffdrive_jacobian.messages.errors import MessageError
from diffdrive_jacobian.text import PATH_LIMIT, printable

__all__ = ['WheelsAndReference', 'read_wheels_and_reference']

MISSING = 'are missing in the bag'
WHEELS, REFERENCE = 'joint_states', 'ground_truth'


@dataclass(frozen=True, kw_only=True, slots=True)
class WheelsAndReference:
    """What a bag has for a calibration."""

    recording: Recording
    wheels_topic: str
    reference_topic: str
    wheel_names: tuple[str, str]
    """Joints of the left and the right wheel."""
    from_speeds: bool
    """Whether the angles were integrated from speeds, because the bag has none."""
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
        ReadingInterruptedError: `interrupted` returned True.
        BagError: It is not a bag, is damaged, or has not what is needed.
    """
    path = Path(path)
    with open_bag(path) as reader:
        parameters = recorded_parameters(reader)
        wheels_topic = chosen_topic(reader, wheels, '--wheels-topic', WHEELS, (JOINT_STATE.type_name,))
        poses_topic = chosen_topic(
            reader, reference, '--reference', REFERENCE, tuple(POSES), any_name=True
        )
        joints, poses = JointRows(), PoseRows()
        tally = _read(reader, {wheels_topic: joints, poses_topic: poses}, interrupted)
    where = printable(path, PATH_LIMIT)
    for topic, count in ((wheels_topic, joints.count), (poses_topic, poses.count)):
        if not count:
            raise BagError(f'{where} has no usable message on {topic}{_why(tally, topic)}')
    chosen = wheel_names(where, wheels_topic, joints.names, names, parameters)
    measured, from_speeds = joints.of(chosen, where, wheels_topic)
    poses.check(where, poses_topic)
    notes = [
        f'{count} messages on {printable(topic)} {why}{"" if why == MISSING else " and were skipped"}'
        for (topic, why), count in tally.items()
    ]
    observed = poses.samples()
    wheel_time, pose_time, note = common_clock(measured, observed, wheels_topic, poses_topic)
    notes += [note] if note else []
    origin = min(int(np.min(wheel_time)), int(np.min(pose_time)))
    wheel_seconds, angles = increasing(wheel_time - origin, measured.values, f'{where}: {wheels_topic}')
    pose_seconds, values = increasing(pose_time - origin, observed.values, f'{where}: {poses_topic}')
    if from_speeds:
        angles = integrated(wheel_seconds, angles)
        notes.append(f'{wheels_topic} has no angles: they are integrated from the speeds')
    else:
        angles = unwrapped(wheel_seconds, angles, f'{where}: {wheels_topic}')
    return WheelsAndReference(
        recording=Recording(
            name=str(where),
            wheel_time=wheel_seconds,
            wheel_angles=angles,
            pose_time=pose_seconds,
            poses=values,
        ),
        wheels_topic=wheels_topic,
        reference_topic=poses_topic,
        wheel_names=chosen,
        from_speeds=from_speeds,
        dimensions=dimensions_of(where, parameters),
        notes=tuple(notes),
    )


def _read(
    reader: Reader, sinks: dict[str, JointRows | PoseRows], interrupted: Callable[[], bool]
) -> Counter[tuple[str, str]]:
    """Read the messages of some topics; return how many were skipped, by topic and reason."""
    tally: Counter[tuple[str, str]] = Counter()
    invalid: Counter[str] = Counter()
    codecs: dict[str, Codec[Any]] = {JOINT_STATE.type_name: JOINT_STATE, **POSES}
    connections = [one for one in reader.connections if one.topic in sinks and one.msgtype in codecs]
    readers = {
        kind: codecs[kind].reader(known_structure(kind)) for kind in {one.msgtype for one in connections}
    }
    stored = stored_connections(reader)
    foreign = {
        one.id
        for one in connections
        if recorded_definition_differs(one.msgtype, type_hashes(one, stored))
    }
    found: Counter[str] = Counter()
    for connection, received, data in messages(reader, connections, invalid):
        if interrupted():
            raise ReadingInterruptedError
        topic = connection.topic
        found[topic] += 1
        if connection.id in foreign:
            tally[topic, f'were recorded with another definition of {connection.msgtype}'] += 1
            continue
        try:
            sinks[topic].add(received, readers[connection.msgtype](data))
        except LongMessageError:
            tally[topic, 'have more values than are read'] += 1
        except DecodingError:
            tally[topic, 'cannot be decoded'] += 1
        except MessageError:
            tally[topic, 'hold invalid or implausible values'] += 1
    for topic, count in invalid.items():
        tally[topic, 'cannot be decoded'] += count
    for topic in sinks:
        expected = sum(one.msgcount for one in connections if one.topic == topic)
        if (missing := expected - found[topic] - invalid[topic]) > 0:
            tally[topic, MISSING] = missing
    return tally


def _why(tally: Counter[tuple[str, str]], topic: str) -> str:
    reasons = [f'{count} {why}' for (other, why), count in tally.items() if other == topic]
    return f': {", ".join(reasons)}' if reasons else ''
