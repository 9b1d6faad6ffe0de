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

"""The topics of the robot, each defined once.

A new topic is an entry in `TOPICS`, its codec in `messages.codecs`, and the node that publishes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from diffdrive_jacobian.messages import codecs
from diffdrive_jacobian.messages.codecs import Codec

Names = tuple[str, str]
"""Names of the left and the right wheel joint."""


class Row(NamedTuple):
    """What one message adds to a series of a run."""

    stamp: int
    """(ns); 0: it has none."""
    values: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Recorded:
    """What the messages of a topic are in a run: rows of a table."""

    series: str
    """Field of `Run` with the table. Several topics may have one."""
    columns: tuple[str, ...]
    rows: Callable[[Any, Names], Iterable[Row]]
    """Returns the rows of a value. It raises MessageError if the value lacks what is needed."""
    covariances: tuple[str, ...] = ()
    """Names of the values that follow those of the columns in the rows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Topic:
    """A topic, and what the tools do with it."""

    name: str
    """Without namespace; of one that all robots share, from `/` on."""
    codecs: tuple[Codec[Any], ...] = ()
    """One for each type that it may have. Empty: its messages are only passed on."""
    of_run: bool = True
    """Whether it is recorded as part of a run."""
    of_robot: bool = True
    """Whether its messages are the behaviour of a robot, and not of ROS or of the test."""
    table: Recorded | None = None
    """What its messages are in a run; None: no table."""
    followed: bool = False
    """Whether the live page looks at its latest value."""
    if_unread: str = ''
    """What to start if nobody is subscribed to it; '': nothing."""
    if_unpublished: str = ''
    """What to start if it has subscriptions and no publisher; '': nothing."""
    if_several: str = ''
    """What to do about several publishers; '': they are allowed."""

    @property
    def shared(self) -> bool:
        """Whether all robots share it."""
        return self.name.startswith('/')

    @property
    def base_name(self) -> str:
        """The name without namespace."""
        return self.name.removeprefix('/')

    @property
    def readable(self) -> bool:
        """Whether reading a run takes something from it."""
        return self.table is not None or self.name in (PARAMETER_EVENTS, FAULT_EVENTS)

    def codec(self, type_name: str) -> Codec[Any]:
        """Return the codec of a type that it may have.

        Raises:
            KeyError: It may not.
        """
        return {codec.type_name: codec for codec in self.codecs}[type_name]

    @property
    def types(self) -> tuple[str, ...]:
        """The types that it may have, `package/msg/Name`."""
        return tuple(codec.type_name for codec in self.codecs)


# --- Rows of a run

_POSE = ('x', 'y', 'theta')
_TWIST = ('v', 'omega')
_WHEELS = ('omega_R', 'omega_L')
OF_POSE = ('xx', 'xy', 'xt', 'yy', 'yt', 'tt')
"""Names of the covariances of a pose in a run."""
_OF_TWIST = ('vv', 'vw', 'ww')


def _command(command: codecs.Command, _: Names) -> list[Row]:
    return [Row(command.stamp, command.twist)]


def _motion(motion: codecs.Motion, _: Names) -> list[Row]:
    return [Row(motion.stamp, (*motion.pose, *motion.twist))]


def _odometry(motion: codecs.Motion, _: Names) -> list[Row]:
    vv, vw, _vw, ww = motion.twist_covariance
    covariances = (*_upper(motion.covariance), vv, vw, ww)
    return [Row(motion.stamp, (*motion.pose, *motion.twist, *covariances))]


def _place(place: codecs.Place, _: Names) -> list[Row]:
    return [Row(place.stamp, (*place.pose, *_upper(place.covariance)))]


def _upper(covariance: tuple[float, ...]) -> tuple[float, ...]:
    """Return the entries xx, xy, xt, yy, yt, tt."""
    return covariance[:3] + covariance[4:6] + covariance[8:]


def _route(route: codecs.Route, _: Names) -> list[Row]:
    time = route.time
    return [Row(time, pose) for pose in route.poses]


def _path(route: codecs.Route, _: Names) -> list[Row]:
    time, times = route.time, route.times or (math.nan,) * len(route.poses)
    return [Row(time, (*pose, t)) for pose, t in zip(route.poses, times, strict=True)]


def _status(status: codecs.Status, _: Names) -> list[Row]:
    return [Row(status.time, (float(status.status),))]


def _wheels(wheels: codecs.Wheels | codecs.WheelArray, names: Names) -> list[Row]:
    return [Row(wheels.stamp, wheels.speeds(names))]


# --- The table

CLOCK = '/clock'
ROSOUT = '/rosout'
PARAMETER_EVENTS = '/parameter_events'
FAULT_EVENTS = '/fault_events'
TRANSFORMS = '/tf'

TOPICS = {
    topic.name: topic
    for topic in (
        Topic(
            name='cmd_vel',
            codecs=(codecs.TWIST, codecs.TWIST_STAMPED),
            table=Recorded(series='cmd_vel', columns=_TWIST, rows=_command),
            if_unread='start virtual_robot, wheel_bridge or the driver of your robot',
        ),
        Topic(
            name='cmd_vel_out',
            codecs=(codecs.TWIST_STAMPED,),
            table=Recorded(series='cmd_vel_out', columns=_TWIST, rows=_command),
        ),
        Topic(
            name='odom',
            codecs=(codecs.ODOMETRY,),
            table=Recorded(
                series='odometry',
                columns=_POSE + _TWIST,
                rows=_odometry,
                covariances=OF_POSE + _OF_TWIST,
            ),
            followed=True,
            if_unpublished='start virtual_robot or the driver of your robot',
            if_several='their poses alternate; stop one of them, or give each robot a namespace '
            '(-r __ns:=/NAME)',
        ),
        Topic(
            name='ground_truth',
            codecs=(codecs.ODOMETRY,),
            table=Recorded(series='ground_truth', columns=_POSE + _TWIST, rows=_motion),
            followed=True,
        ),
        Topic(
            name='start_pose',
            codecs=(codecs.POSE_WITH_COVARIANCE,),
            table=Recorded(series='start_pose', columns=_POSE, rows=_place, covariances=OF_POSE),
            if_several='give each robot a namespace (-r __ns:=/NAME)',
        ),
        Topic(name='initialpose', codecs=(codecs.POSE_WITH_COVARIANCE,)),
        Topic(
            name='goal_pose',
            codecs=(codecs.POSE,),
            table=Recorded(series='goals', columns=_POSE, rows=_route),
            if_unread='start go_to_goal',
        ),
        Topic(
            name='goals',
            codecs=(codecs.GOALS,),
            table=Recorded(series='goals', columns=_POSE, rows=_route),
            if_unread='start go_to_goal',
        ),
        Topic(
            name='path',
            codecs=(codecs.PATH,),
            table=Recorded(series='planned_path', columns=(*_POSE, 't'), rows=_path),
            if_unread='start go_to_goal',
        ),
        Topic(
            name='goal_status',
            codecs=(codecs.GOAL_STATUS,),
            table=Recorded(series='goal_status', columns=('status',), rows=_status),
            if_several='two controllers drive one robot; stop one of them, or give each a namespace',
        ),
        Topic(
            name='joint_command',
            codecs=(codecs.JOINT_STATE, codecs.WHEEL_ARRAY),
            table=Recorded(series='wheel_commands', columns=_WHEELS, rows=_wheels),
            if_unread='start virtual_robot with -p command_interface:=wheels, or your motor driver',
            if_unpublished='start wheel_bridge (or the robot without command_interface:=wheels)',
            if_several='their commands alternate; stop one of them, or give each robot a namespace',
        ),
        Topic(
            name='joint_states',
            codecs=(codecs.JOINT_STATE,),
            table=Recorded(series='wheels', columns=_WHEELS, rows=_wheels),
            followed=True,
        ),
        Topic(name=TRANSFORMS),
        Topic(name=PARAMETER_EVENTS, codecs=(codecs.PARAMETER_EVENT,), of_robot=False),
        Topic(name=FAULT_EVENTS, codecs=(codecs.FAULT_EVENT,), of_robot=False),
        Topic(name=CLOCK, codecs=(codecs.CLOCK,), of_run=False, of_robot=False),
        Topic(name=ROSOUT, of_run=False, of_robot=False),
    )
}
"""All topics of the package by their names."""
OF_EVERY_NODE = (PARAMETER_EVENTS, ROSOUT)
"""Topics that every node publishes."""
NOT_OF_ROBOTS = tuple(topic.name for topic in TOPICS.values() if not topic.of_robot)
"""Topics that do not belong to the behaviour of the nodes."""
TABLES = [topic.table for topic in TOPICS.values() if topic.table is not None]
"""The tables of a run. Those of one series have the same columns."""
READABLE = {topic.base_name: topic for topic in TOPICS.values() if topic.readable}
"""Topics from which a run is read, by their names without namespace."""


RUN_TOPICS = tuple(topic.name for topic in TOPICS.values() if topic.of_run)
"""The topics of a run."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """Which topics are recorded."""

    topics: tuple[str, ...] = RUN_TOPICS
    """Names, resolved by the recorder's namespace and remappings."""
    everything: bool = False
    """Whether to record every topic that is not hidden."""
    pattern: str = ''
    """Regular expression. Topics in whose full name it is found are recorded as well."""
