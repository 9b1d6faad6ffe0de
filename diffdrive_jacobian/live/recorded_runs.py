"""The robots in a bag, each as arrays over one common time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError, messages, open_bag
from diffdrive_jacobian.bags.decoding import UndecodableError, decode
from diffdrive_jacobian.messages.conversion import MessageError, from_pose_with_covariance, from_time
from diffdrive_jacobian.reading.reader import base_name, read_run
from diffdrive_jacobian.reading.rows import SERIES_TOPICS
from diffdrive_jacobian.reading.run import Run, Series
from diffdrive_jacobian.reading.trace import Trace, seconds, trace
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
ODOMETRY = 'nav_msgs/msg/Odometry'
MAX_ROBOTS = 16
"""Largest number of robots that are shown."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordedRobot:
    """One robot of a bag. Times are seconds since the first odometry of the bag."""

    name: str
    """Its namespace, `/` or `/NAME`."""
    run: Run
    trace: Trace
    start: float
    """Time of its first odometry (s)."""
    time: Array
    """Of each odometry, shape (n,) (s), never decreasing."""
    covariance: Array
    """Of the pose, at each odometry, shape (n, 3, 3)."""

    def index(self, time: float) -> int:
        """Return the index of the last odometry at a time (s); the first one if there is none."""
        return max(0, int(np.searchsorted(self.time, time, side='right')) - 1)

    def times(self, series: Series) -> Array:
        """Return the times of messages, shape (n,) (s)."""
        return seconds(self.run, series) + self.start

    def latest(
        self, times: Array, series: Series, time: float, life: float
    ) -> tuple[float, float] | None:
        """Return the last values of a series of pairs at a time (s). None: older than `life` (s)."""
        index = int(np.searchsorted(times, time, side='right')) - 1
        if index < 0 or time - times[index] > life:
            return None
        first, second = series.values[index, :2].tolist()
        return first, second


def read_robots(path: Path, topics: Mapping[str, str] | None = None) -> list[RecordedRobot]:
    """Read all robots of a bag.

    Args:
        path: The bag.
        topics: As for `read_run`; the bag is then taken for one of a single robot.

    Raises:
        BagError: It is not a bag, is damaged, or has no odometry.
    """
    robots = _namespaces(path) if not topics else {'/': dict(topics)}
    if not robots:
        raise BagError(f'{path} has no odometry: no message on a topic odom of {ODOMETRY}')
    if len(robots) > MAX_ROBOTS:
        raise BagError(f'{path} has {len(robots)} robots, at most {MAX_ROBOTS} can be shown')
    found = []
    for namespace, names in sorted(robots.items()):
        run = read_run(path, names)
        if namespace != '/' or len(robots) > 1:
            run = replace(run, parameters=_parameters_in(run.parameters, namespace))
        if len(run.odometry):
            found.append((namespace, run, trace(run), names))
    if not found:
        raise BagError(f'{path} has no odometry: no message on a topic odom of {ODOMETRY}')
    first = min(int(run.odometry.stamps[0]) for _, run, _, _ in found)
    made = []
    for namespace, run, traced, names in found:
        start = (int(run.odometry.stamps[0]) - first) / NANOSECONDS
        made.append(
            RecordedRobot(
                name=namespace,
                run=run,
                trace=traced,
                start=start,
                time=np.maximum.accumulate(traced.time + start),
                covariance=_covariances(path, names.get('odom'), run.odometry),
            )
        )
    return made


def _namespaces(path: Path) -> dict[str, dict[str, str]]:
    """Return the topics of each robot by their usual names, by namespace."""
    usual = {name for names in SERIES_TOPICS.values() for name in names}
    with open_bag(path) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
    robots = {
        topic.rpartition('/')[0] or '/': {'odom': topic}
        for topic, kind in topics.items()
        if base_name(topic) == 'odom' and kind == ODOMETRY
    }
    if len(robots) == 1:
        # The other topics may have another namespace, or none: they are found by their names.
        return {namespace: {} for namespace in robots}
    for topic in topics:
        namespace, name = topic.rpartition('/')[0] or '/', base_name(topic)
        if namespace in robots and name in usual:
            robots[namespace][name] = topic
    return robots


def _parameters_in(
    parameters: Mapping[str, dict[str, Any]], namespace: str
) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes in a namespace, or of all if there are none."""
    inside = {
        node: values
        for node, values in parameters.items()
        if (node.rpartition('/')[0] or '/') == namespace
    }
    return inside or dict(parameters)


def _covariances(path: Path, topic: str | None, odometry: Series) -> Array:
    """Return the covariance of the pose at each odometry, shape (n, 3, 3); zero where it is invalid."""
    found: dict[tuple[int, int], Array] = {}
    with open_bag(path) as reader:
        connections = [
            one
            for one in reader.connections
            if one.msgtype == ODOMETRY
            and (one.topic == topic if topic else base_name(one.topic) == 'odom')
        ]
        for _, received, data in messages(reader, connections):
            try:
                message = decode(data, ODOMETRY)
                stamp = from_time(message.header.stamp)
                _, found[received, stamp or received] = from_pose_with_covariance(message.pose)
            except (MessageError, UndecodableError):
                continue
    zero = np.zeros((3, 3))
    pairs = zip(odometry.received.tolist(), odometry.stamps.tolist(), strict=True)
    return np.array([found.get(pair, zero) for pair in pairs]).reshape(-1, 3, 3)
