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
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
)
from nav_msgs.msg import Goals, OccupancyGrid, Odometry, Path
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header, String

from diffdrive_jacobian.messages.structure import structure, walk
from diffdrive_jacobian.relations import Mirrored, Moved
from diffdrive_jacobian.relations.differences import differing
from diffdrive_jacobian.testing import LockstepError

MOTION = Moved(1.5, -0.7, 2.4)
BACK = Moved(
    -(math.cos(2.4) * 1.5 + math.sin(2.4) * -0.7), -(-math.sin(2.4) * 1.5 + math.cos(2.4) * -0.7), -2.4
)
"""Undoes it."""


def filled(kind, seed=1):
    """Return a message with random numbers, unit quaternions, and frames of a fixed world."""
    rng = np.random.default_rng(seed)
    message = kind() if isinstance(kind, type) else kind
    for path, field, _ in walk(structure(type(message)), message):
        *way, name = path.split('.')
        target = message
        for step in way:
            if '[' in step or step.startswith('len'):
                break
            target = getattr(target, step)
        else:
            value = getattr(target, name, None)
            if hasattr(value, 'tolist'):
                setattr(target, name, rng.normal(size=len(value)))
            elif isinstance(value, float) and getattr(field, 'is_float', False):
                setattr(target, name, float(rng.normal()))
            if isinstance(target, Quaternion) and name == 'w':
                values = np.array([target.x, target.y, target.z, target.w])
                values *= np.sign(values[3]) / np.linalg.norm(values)
                target.x, target.y, target.z, target.w = map(float, values)
    return message


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


def of_transform(transform):
    return matrix(transform.translation, transform.rotation)


MOVE = matrix(Point(x=1.5, y=-0.7), Quaternion(z=math.sin(1.2), w=math.cos(1.2)))
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize('seed', range(5))
def test_a_pose_is_moved_and_mirrored_as_by_matrices(seed):
    before = of_pose(filled(Pose, seed))
    moved = MOTION.image('pose', filled(Pose, seed))
    assert of_pose(moved) == pytest.approx(MOVE @ before)
    assert moved.orientation.w >= 0.0
    mirrored = Mirrored().image('pose', filled(Pose, seed))
    assert of_pose(mirrored) == pytest.approx(MIRROR @ before @ MIRROR)


def test_covariances_are_transformed_as_their_poses_and_twists():
    message = filled(Odometry)
    root = np.random.default_rng(3).normal(size=(6, 6))
    message.pose.covariance = message.twist.covariance = (root @ root.T).ravel()
    twist = np.array(message.twist.covariance).reshape(6, 6)
    rotation = np.kron(np.eye(2), MOVE[:3, :3])
    signs = np.diag([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    moved = MOTION.image('odom', message)
    expected = rotation @ root @ root.T @ rotation.T
    assert np.array(moved.pose.covariance).reshape(6, 6) == pytest.approx(expected)
    assert np.array(moved.twist.covariance).reshape(6, 6) == pytest.approx(twist)
    mirrored = Mirrored().image('odom', moved)
    assert np.array(mirrored.pose.covariance).reshape(6, 6) == pytest.approx(signs @ expected @ signs)
    assert np.array(mirrored.twist.covariance).reshape(6, 6) == pytest.approx(signs @ twist @ signs)


def test_twists_are_those_of_the_robot():
    twist = filled(Twist)
    assert MOTION.image('cmd_vel', filled(Twist)) == twist
    mirrored = Mirrored().image('cmd_vel', filled(Twist))
    assert (mirrored.linear.x, mirrored.linear.y) == (twist.linear.x, -twist.linear.y)
    assert (mirrored.angular.x, mirrored.angular.y, mirrored.angular.z) == (
        *(-twist.angular.x, twist.angular.y),
        -twist.angular.z,
    )


@pytest.mark.parametrize(
    ('parent', 'child', 'expected'),
    [
        ('odom', 'base_link', lambda before: MOVE @ before),
        ('robot/odom', 'robot/base_footprint', lambda before: MOVE @ before),
        ('map', 'odom', lambda before: MOVE @ before @ np.linalg.inv(MOVE)),
        ('base_link', 'laser', lambda before: before),
        ('odom', 'chassis', lambda before: MOVE @ before),
        ('laser', 'map', lambda before: before @ np.linalg.inv(MOVE)),
    ],
)
def test_a_transform_is_moved_by_its_frames(parent, child, expected):
    def message():
        return filled(TransformStamped(header=Header(frame_id=parent), child_frame_id=child))

    before = of_transform(message().transform)
    moved = MOTION.image('tf', message()).transform
    assert of_transform(moved) == pytest.approx(expected(before))
    mirrored = Mirrored().image('tf', message()).transform
    assert of_transform(mirrored) == pytest.approx(MIRROR @ before @ MIRROR)


def test_twists_in_a_fixed_frame_are_turned():
    def wrench(frame):
        return filled(WrenchStamped(header=Header(frame_id=frame)))

    def vectors(message):
        return [[one.x, one.y, one.z] for one in (message.wrench.force, message.wrench.torque)]

    before = np.array(vectors(wrench('map')))
    assert np.array(vectors(MOTION.image('f', wrench('map')))) == pytest.approx(before @ MOVE[:3, :3].T)
    assert np.array(vectors(MOTION.image('f', wrench('base_link')))) == pytest.approx(before)
    assert MOTION.image('f', filled(Accel)) == filled(Accel)


def test_an_infinite_covariance_stays_in_its_block():
    message = Odometry()
    message.pose.covariance[35] = math.inf
    moved = MOTION.image('odom', message).pose.covariance
    assert moved[35] == math.inf
    assert [value for value in moved if value != 0.0] == [math.inf]


def test_fixed_frames_are_names():
    with pytest.raises(ValueError, match='Moved: fixed must be'):
        Moved(fixed='map')


def test_what_is_seen_from_the_robot_stays():
    goal = PoseStamped(header=Header(frame_id='robot/base_link'), pose=filled(Pose))
    assert MOTION.image('goal', goal).pose == filled(Pose)
    path = Path(poses=[PoseStamped(pose=filled(Pose)), goal])
    fixed, relative = MOTION.image('path', path).poses
    assert of_pose(fixed.pose) == pytest.approx(MOVE @ of_pose(filled(Pose)))
    assert relative.pose == filled(Pose)


KINDS = (
    *(Odometry, PoseWithCovarianceStamped, PointStamped, Vector3Stamped, TwistStamped, String),
    PoseArray(poses=[Pose(), Pose()]),
    Path(poses=[PoseStamped()]),
    Goals(goals=[PoseStamped(), PoseStamped()]),
    PolygonStamped(),
)


@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: getattr(kind, '__name__', type(kind).__name__))
def test_an_image_of_an_image_may_be_the_message(kind):
    before = filled(kind)
    again = Mirrored().image('topic', Mirrored().image('topic', filled(kind)))
    assert differing(again, before, 1e-12) == []
    if isinstance(kind, type):
        back = BACK.image('topic', MOTION.image('topic', filled(kind)))
        assert differing(back, before, 1e-12) == []


def test_what_is_not_finite_stays():
    pose = Pose(position=Point(x=math.nan, y=1.0))
    assert MOTION.image('goal', pose).position.y == 1.0
    assert MOTION.image('goal', Pose2D(theta=math.inf)).theta == math.inf


@pytest.mark.parametrize('kind', [LaserScan, OccupancyGrid])
def test_what_has_no_image_is_refused(kind):
    with pytest.raises(
        LockstepError, match=rf'Mirrored\(\) has no image of \w+/{kind.__name__} on /scan'
    ):
        Mirrored().image('/scan', kind())
