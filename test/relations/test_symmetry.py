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

"""Images of messages in the plane: equal to those by matrices, and undone by the opposite motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import (
    Accel,
    Point,
    PointStamped,
    PolygonStamped,
    Pose,
    Pose2D,
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
    Vector3Stamped,
    Wrench,
    WrenchStamped,
)
from nav_msgs.msg import Goals, OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header, String

from diffdrive_jacobian.relations import Mirrored, Moved
from diffdrive_jacobian.relations.differences import differing
from diffdrive_jacobian.testing import LockstepError

X, Y, THETA = 1.5, -0.7, 2.4
MOTION = Moved(X, Y, THETA)
BACK = Moved(
    -(math.cos(THETA) * X + math.sin(THETA) * Y), math.sin(THETA) * X - math.cos(THETA) * Y, -THETA
)
"""Undoes it."""
SIGNS = np.diag([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
"""Of positions and rotations in the mirror."""


# --- Messages with random numbers, the same for the same seed


def vector(kind=Vector3, seed=1):
    x, y, z = map(float, np.random.default_rng(seed).normal(size=3))
    return kind(x=x, y=y, z=z)


def quaternion(seed=1):
    values = np.random.default_rng(seed).normal(size=4)
    values *= np.sign(values[3]) / np.linalg.norm(values)
    return Quaternion(**dict(zip('xyzw', map(float, values), strict=True)))


def pose(seed=1):
    return Pose(position=vector(Point, seed), orientation=quaternion(seed))


def twist():
    return Twist(linear=vector(seed=2), angular=vector(seed=3))


def covariance():
    root = np.random.default_rng(3).normal(size=(6, 6))
    return root @ root.T


def odometry():
    message = Odometry(header=Header(frame_id='odom'), child_frame_id='base_link')
    message.pose.pose, message.twist.twist = pose(), twist()
    message.pose.covariance = message.twist.covariance = covariance().ravel()
    return message


# --- Matrices


def matrix(position, q):
    """Return the homogeneous matrix of a pose."""
    x, y, z, w = q.x, q.y, q.z, q.w
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, [position.x, position.y, position.z]
    return result


def of_pose(pose):
    return matrix(pose.position, pose.orientation)


def square(covariance):
    return np.array(covariance).reshape(6, 6)


MOVE = matrix(Point(x=X, y=Y), Quaternion(z=math.sin(THETA / 2.0), w=math.cos(THETA / 2.0)))
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize('seed', range(5))
def test_a_pose_is_moved_and_mirrored_as_by_matrices(seed):
    before = of_pose(pose(seed))
    moved = MOTION.image('pose', pose(seed))
    assert of_pose(moved) == pytest.approx(MOVE @ before)
    assert moved.orientation.w >= 0.0
    mirrored = Mirrored().image('pose', pose(seed))
    assert of_pose(mirrored) == pytest.approx(MIRROR @ before @ MIRROR)


def test_covariances_are_transformed_as_by_matrices():
    rotation = np.kron(np.eye(2), MOVE[:3, :3])
    expected = rotation @ covariance() @ rotation.T
    moved = MOTION.image('odom', odometry())
    assert square(moved.pose.covariance) == pytest.approx(expected)
    # A twist is given in the frame of the robot.
    assert square(moved.twist.covariance) == pytest.approx(covariance())
    mirrored = Mirrored().image('odom', moved)
    assert square(mirrored.pose.covariance) == pytest.approx(SIGNS @ expected @ SIGNS)
    assert square(mirrored.twist.covariance) == pytest.approx(SIGNS @ covariance() @ SIGNS)
    # An infinite variance stays in its block.
    unknown = Odometry()
    unknown.pose.covariance[35] = math.inf
    assert [one for one in MOTION.image('odom', unknown).pose.covariance if one] == [math.inf]


def test_twists_are_turned_only_in_fixed_frames():
    assert MOTION.image('cmd_vel', twist()) == twist()
    assert MOTION.image('acceleration', Accel(linear=vector())) == Accel(linear=vector())
    before, mirrored = twist(), Mirrored().image('cmd_vel', twist())
    for ours, theirs, signs in (
        (before.linear, mirrored.linear, (1.0, -1.0, 1.0)),
        (before.angular, mirrored.angular, (-1.0, 1.0, -1.0)),
    ):
        expected = [sign * one for sign, one in zip(signs, (ours.x, ours.y, ours.z), strict=True)]
        assert [theirs.x, theirs.y, theirs.z] == expected

    def force(frame):
        wrench = Wrench(force=vector(seed=2), torque=vector(seed=3))
        image = MOTION.image('f', WrenchStamped(header=Header(frame_id=frame), wrench=wrench)).wrench
        return np.array([[one.x, one.y, one.z] for one in (image.force, image.torque)])

    assert force('map') == pytest.approx(force('base_link') @ MOVE[:3, :3].T)


@pytest.mark.parametrize(
    ('parent', 'child', 'expected'),
    [
        ('odom', 'base_link', lambda before: MOVE @ before),
        ('robot/odom', 'robot/base_footprint', lambda before: MOVE @ before),
        ('map', 'odom', lambda before: MOVE @ before @ np.linalg.inv(MOVE)),
        ('base_link', 'laser', lambda before: before),
        ('laser', 'map', lambda before: before @ np.linalg.inv(MOVE)),
    ],
)
def test_a_transform_is_moved_by_its_frames(parent, child, expected):
    def transformed(relation):
        transform = Transform(translation=vector(), rotation=quaternion())
        header = Header(frame_id=parent)
        message = TransformStamped(header=header, child_frame_id=child, transform=transform)
        image = relation.image('tf', message).transform
        return matrix(image.translation, image.rotation)

    before = matrix(vector(), quaternion())
    assert transformed(MOTION) == pytest.approx(expected(before))
    assert transformed(Mirrored()) == pytest.approx(MIRROR @ before @ MIRROR)


def test_what_is_seen_from_the_robot_stays():
    goal = PoseStamped(header=Header(frame_id='robot/base_link'), pose=pose())
    assert MOTION.image('goal', goal).pose == pose()
    fixed, relative = MOTION.image('path', Path(poses=[PoseStamped(pose=pose()), goal])).poses
    assert of_pose(fixed.pose) == pytest.approx(MOVE @ of_pose(pose()))
    assert relative.pose == pose()


def test_what_is_not_finite_stays():
    assert MOTION.image('goal', Pose(position=Point(x=math.nan, y=1.0))).position.y == 1.0
    assert MOTION.image('goal', Pose2D(theta=math.inf)).theta == math.inf


def stamped(kind, **fields):
    return kind(header=Header(frame_id='odom'), **fields)


MESSAGES = {
    'odometry': odometry,
    'a pose with covariance': lambda: stamped(PoseWithCovarianceStamped, pose=odometry().pose),
    'a point': lambda: stamped(PointStamped, point=vector(Point)),
    'a vector': lambda: stamped(Vector3Stamped, vector=vector()),
    'a twist': lambda: stamped(TwistStamped, twist=twist()),
    'a pose in the plane': lambda: Pose2D(x=0.3, y=-0.4, theta=2.9),
    'a text': lambda: String(data='odom'),
    'poses': lambda: PoseArray(poses=[pose(1), pose(2)]),
    'a path': lambda: Path(poses=[stamped(PoseStamped, pose=pose())]),
    'goals': lambda: Goals(goals=[stamped(PoseStamped, pose=pose(seed)) for seed in (1, 2)]),
    'an empty polygon': PolygonStamped,
}


@pytest.mark.parametrize('name', MESSAGES)
def test_an_image_of_an_image_may_be_the_message(name):
    make = MESSAGES[name]
    again = Mirrored().image('topic', Mirrored().image('topic', make()))
    assert differing(again, make(), 1e-12) == []
    back = BACK.image('topic', MOTION.image('topic', make()))
    assert differing(back, make(), 1e-12) == []


@pytest.mark.parametrize('kind', [LaserScan, OccupancyGrid])
def test_what_has_no_image_is_refused(kind):
    words = rf'Mirrored\(\) has no image of \w+/{kind.__name__} on /scan'
    with pytest.raises(LockstepError, match=words):
        Mirrored().image('/scan', kind())
