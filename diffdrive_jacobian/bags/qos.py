"""Quality of service of recorded topics: numbers, rosbags' objects, and the text in a file."""

from __future__ import annotations

from collections.abc import Iterable
from io import StringIO
from typing import Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v9
from ruamel.yaml import YAML

from diffdrive_jacobian.time_units import NANOSECONDS


def to_rosbags(fields: dict[str, Any]) -> Qos:
    """Return a profile for rosbags.

    Args:
        fields: Policies by their numbers in rmw, which rosbag2 shares; durations in nanoseconds.

    Raises:
        KeyError, ValueError: A policy is missing, or its number is invalid.
    """

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


def from_rosbags(profile: Qos) -> dict[str, Any]:
    """Return the fields of a profile of rosbags, as `to_rosbags` takes them."""
    return {
        'history': profile.history.value,
        'depth': int(profile.depth),
        'reliability': profile.reliability.value,
        'durability': profile.durability.value,
        'deadline': _nanoseconds(profile.deadline),
        'lifespan': _nanoseconds(profile.lifespan),
        'liveliness': profile.liveliness.value,
        'liveliness_lease_duration': _nanoseconds(profile.liveliness_lease_duration),
    }


def to_text(profiles: Iterable[dict[str, Any]]) -> str:
    """Return profiles as rosbag2 writes them to MCAP files (YAML)."""
    stream = StringIO()
    YAML(typ='safe').dump(dump_qos_v9([to_rosbags(one) for one in profiles]), stream)
    return stream.getvalue()


def is_valid(fields: dict[str, Any]) -> bool:
    """Return whether a bag can store a profile: known policies, and no negative or huge number."""
    try:
        to_rosbags(fields)
    except (KeyError, ValueError):
        return False
    return all(0 <= value < 2**63 for value in fields.values())


def _nanoseconds(time: QosTime) -> int:
    return NANOSECONDS * int(time.sec) + int(time.nsec)
