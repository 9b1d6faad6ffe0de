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

"""Quality of service of rclpy: as recorded, and for subscriptions and publishers that match others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from diffdrive_jacobian.time_units import NANOSECONDS


def to_rosbags(profile: QoSProfile) -> Qos:
    """Return a profile as it is recorded. rosbag2 has the numbers of rmw for the policies."""
    return Qos(
        history=QosHistory(int(profile.history)),
        depth=profile.depth,
        reliability=QosReliability(int(profile.reliability)),
        durability=QosDurability(int(profile.durability)),
        deadline=_time(profile.deadline),
        lifespan=_time(profile.lifespan),
        liveliness=QosLiveliness(int(profile.liveliness)),
        liveliness_lease_duration=_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=False,
    )


def _time(duration: Duration) -> QosTime:
    return QosTime(*divmod(duration.nanoseconds, NANOSECONDS))


def subscription_profile(offered: Iterable[QoSProfile], depth: int) -> QoSProfile:
    """Return the strictest profile that is compatible with every publisher of a topic.

    Args:
        offered: The profiles of the publishers.
        depth: Length of the queue.
    """
    offered = list(offered)
    profile = QoSProfile(depth=depth)
    if any(one.reliability == ReliabilityPolicy.BEST_EFFORT for one in offered):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if offered and all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def publisher_profile(recorded: Sequence[Qos], depth: int) -> QoSProfile:
    """Return a profile for the replay of a topic: latched if a publisher was, reliable unless none was.

    Args:
        recorded: The profiles that the recorded publishers offered.
        depth: Length of the queue.
    """
    profile = QoSProfile(depth=depth)
    if recorded and all(one.reliability == QosReliability.BEST_EFFORT for one in recorded):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if any(one.durability == QosDurability.TRANSIENT_LOCAL for one in recorded):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    # 0 means none.
    deadlines = [one.deadline for one in recorded if one.deadline != QosTime(0, 0)]
    if deadlines:
        shortest = min(deadlines)
        profile.deadline = Duration(seconds=shortest.sec, nanoseconds=shortest.nsec)
    return profile
