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

"""Values as they are read from their messages, in which headings are rounded as quaternions. No ROS."""

from __future__ import annotations

import math
from typing import Any

from diffdrive_jacobian.messages.codecs import (
    GOALS,
    ODOMETRY,
    ODOMETRY_STATE,
    PATH,
    Motion,
    Place,
    Route,
    State,
)
from diffdrive_jacobian.messages.conversion import from_pose
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds


def read_route(route: Route, *, along_path: bool) -> Route:
    """Return goals as they are read from their message, a path or goals.

    Raises:
        GoalError: A receiver refuses them.
    """
    zeros, frames = (0.0,) * len(route.poses), ('',) * len(route.poses)
    x, y, headings = zip(*route.poses, strict=True)
    z, w = ((*(of(theta / 2.0) for theta in headings),) for of in (math.sin, math.cos))
    columns = x, y, zeros, zeros, z, w
    if not along_path:
        return GOALS.value(*route.stamp, '', frames, *columns)
    stamps = [(0, 0)] * len(route.poses)
    if route.times is not None:
        times = (route.time + nanoseconds(time) for time in route.times)
        stamps = [divmod(time, NANOSECONDS) for time in times]
    return PATH.value(*route.stamp, '', frames, *zip(*stamps, strict=True), *columns)


def as_read(topic: str, value: Any) -> Any:
    """Return the value of a message as it is read from it, whose headings are rounded as quaternions.

    Raises:
        MessageError: A receiver refuses it.
    """
    if isinstance(value, Route):
        return read_route(value, along_path=topic == 'path')
    if not isinstance(value, (Motion, Place)):
        return value
    x, y, theta = value.pose
    sine, cosine = math.sin(theta / 2.0), math.cos(theta / 2.0)
    return value._replace(pose=from_pose(x, y, 0.0, 0.0, sine, cosine))


def read_state(motion: Motion, frame: str) -> State:
    """Return what is read from an odometry message, whose heading is rounded as a quaternion."""
    sec, nanosec, x, y, z, w, *_ = ODOMETRY.numbers(motion)
    return ODOMETRY_STATE.value(frame, sec, nanosec, *motion.twist, x, y, 0.0, 0.0, z, w)
