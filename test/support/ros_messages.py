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

"""Messages as the tests of the nodes write and read them."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry, Path
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from diffdrive_jacobian.messages.codecs import ODOMETRY, POSE_WITH_COVARIANCE
from diffdrive_jacobian.messages.conversion import from_time, set_pose, set_time

PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
WHEELS = ['left_wheel_joint', 'right_wheel_joint']


def stamp(nanoseconds):
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def twist(v, omega=0.0):
    message = Twist()
    message.linear.x, message.angular.z = float(v), float(omega)
    return message


def twist_stamped(v, omega, nanoseconds):
    message = TwistStamped(twist=twist(v, omega))
    message.header.stamp = stamp(nanoseconds)
    return message


def joint_command(left, right, nanoseconds=0):
    message = JointState(name=WHEELS, velocity=[float(left), float(right)])
    message.header.stamp = stamp(nanoseconds)
    return message


def placement(x, y=0.0, theta=0.0, *, variances=(0.0, 0.0, 0.0), frame=''):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.pose.pose = pose_message([x, y, theta])
    planar = np.zeros((6, 6))
    planar[PLANAR] = np.diag(variances)
    message.pose.covariance = planar.ravel()
    return message


def pose_message(pose):
    """Write a pose exactly as the robot writes it."""
    message = Pose()
    set_pose(message, np.asarray(pose, dtype=float))
    return message


def instants(messages):
    return [time_of(one) for one in messages]


def time_of(message):
    """Return the stamp of a message (ns)."""
    return from_time(message.header.stamp.sec, message.header.stamp.nanosec)


def twists(messages):
    bare = [getattr(one, 'twist', one) for one in messages]
    return [(one.linear.x, one.angular.z) for one in bare]


def value_of(codec, message):
    """Read a message as those who receive it."""
    return codec.reader(type(message))(serialize_message(message))


def pose_of(message):
    codec = ODOMETRY if isinstance(message, Odometry) else POSE_WITH_COVARIANCE
    return np.array(value_of(codec, message).pose)


def covariance_of(odometry):
    return np.asarray(odometry.pose.covariance).reshape(6, 6)[PLANAR]


def at_rest(odometry):
    return odometry.twist.twist == Twist()


def goal(x, y, theta=0.0, frame='', stamp=0):
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.sec = frame, stamp
    message.pose.position.x, message.pose.position.y = float(x), float(y)
    message.pose.orientation.z, message.pose.orientation.w = math.sin(theta / 2), math.cos(theta / 2)
    return message


def goals(*poses, frame='', stamp=0):
    message = Goals(goals=list(poses))
    message.header.frame_id, message.header.stamp.sec = frame, stamp
    return message


def path(*poses, frame='', stamp=0, times=None):
    """A path of `goal`s or of places; the times of a trajectory are seconds."""
    message = Path(poses=[one if isinstance(one, PoseStamped) else goal(*one) for one in poses])
    message.header.frame_id, message.header.stamp.sec = frame, stamp
    for pose, time in zip(message.poses, times or (), strict=False):
        set_time(pose.header.stamp, round(time * 1e9))
    return message


def odometry(x, y, theta, frame='odom'):
    message = Odometry()
    message.header.frame_id = frame
    message.pose.pose = goal(x, y, theta).pose
    return message


def spoiled(message, path, value):
    """Set a field by its path, such as `linear.x` or `covariance.0`."""
    target = message
    *way, last = path.split('.')
    for name in way:
        target = getattr(target, name)
    if last.isdecimal():
        target[int(last)] = value
    else:
        setattr(target, last, value)
    return message


def receive(node, topic, message):
    """Call the callback of a raw subscription of a node with a message."""
    (callback,) = (one.callback for one in node.subscriptions if one.topic_name == topic)
    callback(serialize_message(message))
