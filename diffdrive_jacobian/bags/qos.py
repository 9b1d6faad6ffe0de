"""Quality of service between rclpy, the journal and rosbags: what publishers offer, what readers ask."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

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


def to_fields(profile: QoSProfile) -> dict[str, Any]:
    """Write a profile as plain numbers; rclpy and rosbag2 number the policies alike (as rmw does)."""
    return {
        'history': int(profile.history),
        'depth': profile.depth,
        'reliability': int(profile.reliability),
        'durability': int(profile.durability),
        'deadline': profile.deadline.nanoseconds,
        'lifespan': profile.lifespan.nanoseconds,
        'liveliness': int(profile.liveliness),
        'liveliness_lease_duration': profile.liveliness_lease_duration.nanoseconds,
    }


def to_rosbags(fields: dict[str, Any]) -> Qos:
    """Give those numbers to rosbags."""

    def time(name: str) -> QosTime:
        return QosTime(*divmod(fields[name], NANOSECONDS))

    return Qos(
        history=QosHistory(fields['history']),
        depth=fields['depth'],
        reliability=QosReliability(fields['reliability']),
        durability=QosDurability(fields['durability']),
        deadline=time('deadline'),
        lifespan=time('lifespan'),
        liveliness=QosLiveliness(fields['liveliness']),
        liveliness_lease_duration=time('liveliness_lease_duration'),
        avoid_ros_namespace_conventions=False,
    )


def to_hear_all(offered: Iterable[QoSProfile], depth: int) -> QoSProfile:
    """Ask for what every publisher of a topic offers, and for no more: else one would not be heard."""
    offered = list(offered)
    profile = QoSProfile(depth=depth)
    if any(one.reliability == ReliabilityPolicy.BEST_EFFORT for one in offered):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if offered and all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def to_offer_again(recorded: Sequence[Qos], depth: int) -> QoSProfile:
    """Offer what the recorded publishers offered: latched if one was, reliable unless none was."""
    profile = QoSProfile(depth=depth)
    if recorded and all(one.reliability == QosReliability.BEST_EFFORT for one in recorded):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if any(one.durability == QosDurability.TRANSIENT_LOCAL for one in recorded):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    deadlines = [one.deadline for one in recorded]
    if deadlines:
        shortest = min(deadlines)
        profile.deadline = Duration(seconds=shortest.sec, nanoseconds=shortest.nsec)
    return profile
