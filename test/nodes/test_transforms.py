"""The pose of the robot as a transform, and on /tf where tf2_ros is installed."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import pytest
from support.lockstep_nodes import Topics, change
from support.ros_messages import odometry, stamp, twist

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot, transform_of

with_tf2_ros = pytest.mark.skipif(find_spec('tf2_ros') is None, reason='tf2_ros is not installed')
without_tf2_ros = pytest.mark.skipif(find_spec('tf2_ros') is not None, reason='tf2_ros is installed')


def matrix(transform):
    """The homogeneous transform (3, 3) of the plane that a message holds."""
    translation, q = transform.translation, transform.rotation
    assert (translation.z, q.x, q.y) == (0.0, 0.0, 0.0)
    return se2.homogeneous([translation.x, translation.y, 2.0 * math.atan2(q.z, q.w)])


def assert_same(message, odometry):
    """Compare a TransformStamped with the Odometry that it must repeat."""
    assert message.header == odometry.header
    assert message.child_frame_id == odometry.child_frame_id
    translation, position = message.transform.translation, odometry.pose.pose.position
    assert (translation.x, translation.y, translation.z) == (position.x, position.y, position.z)
    assert message.transform.rotation == odometry.pose.pose.orientation


@pytest.mark.parametrize(
    'pose', [(0.0, 0.0, 0.0), (1.0, -2.0, 0.5), (-3.5, 1e5, -3.1), (0.0, 2.0, math.pi)]
)
def test_transform_takes_the_axle_centre_to_the_pose(pose):
    message = odometry(*pose, frame='world')
    message.child_frame_id, message.header.stamp = 'axle', stamp(12_345_678_901)
    written = transform_of(message)
    assert (written.header.frame_id, written.child_frame_id) == ('world', 'axle')
    assert written.header.stamp == stamp(12_345_678_901)
    assert_same(written, message)
    np.testing.assert_allclose(matrix(written.transform), se2.homogeneous(pose), rtol=1e-15, atol=1e-15)


def transforms(world):
    from tf2_msgs.msg import TFMessage

    return world.listen(TFMessage, '/tf')


@with_tf2_ros
def test_each_odometry_has_its_transform(lockstep, robot_at):
    topics, received = Topics(lockstep), transforms(lockstep)
    robot = robot_at()
    lockstep.publish('cmd_vel', twist(1.0, 2.0))
    lockstep.run_for(0.3)
    assert change(robot, odom_frame_id='world', base_frame_id='axle').successful
    lockstep.run_for(0.3)
    assert len(topics.odom) > 20
    assert len(received) == len(topics.odom)
    for message, odom in zip(received, topics.odom, strict=True):
        (transform,) = message.transforms
        assert_same(transform, odom)
    frames = [(one.transforms[0].header.frame_id, one.transforms[0].child_frame_id) for one in received]
    assert (frames[0], frames[-1]) == (('odom', 'base_link'), ('world', 'axle'))


@with_tf2_ros
def test_transforms_are_switched_off_by_a_parameter(lockstep, robot_at):
    topics, received = Topics(lockstep), transforms(lockstep)
    robot_at(enable_odom_tf=False)
    lockstep.run_for(0.3)
    assert topics.odom
    assert received == []


@without_tf2_ros
def test_without_tf2_ros_that_is_logged_once_and_the_rest_works(lockstep, add, capfd):
    topics = Topics(lockstep)
    add(VirtualRobot)
    lockstep.run_for(0.3)
    assert topics.odom
    words = 'tf2_ros is not installed: no transform is published'
    assert capfd.readouterr().err.count(words) == 1
    assert '/tf' not in dict(lockstep.node.get_topic_names_and_types())
