"""Which topics, joints and dimensions of a bag a calibration takes."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from diffdrive_jacobian.bags.bag_reader import BagError, base_name
from diffdrive_jacobian.messages.conversion import quoted
from diffdrive_jacobian.text import PATH_LIMIT, printable

NO_REFERENCE = ('odom', 'goal_pose', 'initialpose', 'start_pose')
"""Topics that are no reference unless they are chosen: odometry is computed from the wheels."""


def chosen_topic(
    reader: Reader,
    given: str | None,
    option: str,
    usual: str,
    types: Sequence[str],
    *,
    any_name: bool = False,
) -> str:
    """Return the topic with the wheels or with the reference.

    Args:
        reader: An open bag.
        given: The topic that the user chose; None: none.
        option: The option with which it is chosen.
        usual: Base name of the usual topic.
        types: Allowed types.
        any_name: Whether the only topic of these types is taken whatever its name, unless it is one of
            `NO_REFERENCE`.

    Raises:
        BagError: There is none or several, or the given one is missing or has another type.
    """
    where = printable(reader.path, PATH_LIMIT)
    fitting = [one for one in reader.connections if one.msgtype in types]
    candidates = sorted({one.topic for one in fitting})
    allowed = ' or '.join(types)
    if given is not None:
        topic = given if given.startswith('/') else f'/{given}'
        if topic in candidates:
            return topic
        others = sorted({one.msgtype for one in reader.connections if one.topic == topic})
        if others:
            raise BagError(f'{where}: {topic} must be of type {allowed}, got {", ".join(others)}')
        raise BagError(f'{where} has no topic {topic}; it has {_listed(reader.connections)}')
    named = [topic for topic in candidates if base_name(topic) == usual]
    if not named and any_name:
        named = [topic for topic in candidates if base_name(topic) not in NO_REFERENCE]
    if len(named) == 1:
        return named[0]
    if not named:
        hint = f' (choose one with {option})' if candidates else ''
        raise BagError(
            f'{where} has no topic {usual} of type {allowed}; it has {_listed(reader.connections)}{hint}'
        )
    raise BagError(f'{where} has several such topics, {", ".join(named)}: choose one with {option}')


def _listed(connections: Sequence[Connection]) -> str:
    found = sorted({f'{printable(one.topic)} ({printable(one.msgtype)})' for one in connections})
    return ', '.join(found) or 'none'


def wheel_names(
    where: object,
    topic: str,
    joints: Collection[str],
    given: tuple[str, str] | None,
    parameters: dict[str, dict[str, Any]],
) -> tuple[str, str]:
    """Return the joints of the left and the right wheel.

    Raises:
        BagError: They are missing, or not to be told apart by their names.
    """
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
    """Return the wheel radius and the wheel separation of the nodes; None: not recorded (m).

    Raises:
        BagError: The nodes differ.
    """
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
