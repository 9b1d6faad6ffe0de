"""The robots in a bag, each as arrays over one common time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError, open_bag
from diffdrive_jacobian.bags.run import Run, Series, read_run
from diffdrive_jacobian.bags.timeline import Timeline, seconds, timeline
from diffdrive_jacobian.messages.conversion import MessageError, from_covariance
from diffdrive_jacobian.messages.names import base_name, namespace_of
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.time_units import NANOSECONDS

Array = NDArray[np.float64]
MAX_ROBOTS = 16
"""Largest number of robots that are shown."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordedRobot:
    """One robot of a bag. Times are seconds since the first odometry of the bag."""

    name: str
    """Its namespace, `/` or `/NAME`."""
    run: Run
    timeline: Timeline
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


def read_robots(path: Path) -> list[RecordedRobot]:
    """Read all robots of a bag.

    Raises:
        BagError: It is not a bag, is damaged, or has no odometry.
    """
    namespaces = _namespaces(path)
    if len(namespaces) > MAX_ROBOTS:
        raise BagError(f'{path} has {len(namespaces)} robots, at most {MAX_ROBOTS} can be shown')
    runs, notes = {}, list[str]()
    for namespace in namespaces:
        # The other topics of a single robot may have another namespace.
        run = read_run(path, namespace=namespace if len(namespaces) > 1 else None)
        if len(run.odometry):
            runs[namespace] = run
        notes += run.notes
    if not runs:
        why = f'no valid message on a topic odom of {TOPICS["odom"].types[0]}'
        raise BagError('; '.join([f'{path} has no odometry: {why}', *notes]))
    first = min(int(run.odometry.stamps[0]) for run in runs.values())
    robots = []
    for namespace, run in runs.items():
        numbers = timeline(run)
        start = (int(run.odometry.stamps[0]) - first) / NANOSECONDS
        robots.append(
            RecordedRobot(
                name=namespace,
                run=run,
                timeline=numbers,
                start=start,
                time=np.maximum.accumulate(numbers.time + start),
                covariance=_covariances(run),
            )
        )
    return robots


def _is_odometry(topic: str, kind: str) -> bool:
    return base_name(topic) == 'odom' and kind in TOPICS['odom'].types


def _namespaces(path: Path) -> list[str]:
    """Return the namespaces of the robots, sorted."""
    with open_bag(path) as reader:
        return sorted(
            {
                namespace_of(one.topic)
                for one in reader.connections
                if _is_odometry(one.topic, one.msgtype)
            }
        )


def _covariances(run: Run) -> Array:
    """Return the covariance of the pose at each odometry, shape (n, 3, 3); zero where it is invalid."""
    matrices = run.odometry_covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    for matrix in matrices:
        try:
            matrix[:] = from_covariance(matrix)
        except MessageError:
            matrix[:] = 0.0
    return matrices
