"""The pose of the robot as a transform, and on /tf where tf2_ros is installed."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
from support.lockstep_nodes import Topics, change
from support.ros_messages import odometry, stamp, twist

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot, transform_of


def assert_same(message, odometry):
    """Compare a TransformStamped with the Odometry that it must repeat."""
    assert message.header == odometry.header
    assert message.child_frame_id == odometry.child_frame_id
    translation, position = message.transform.translation, odometry.pose.pose.position
    assert (translation.x, translation.y, translation.z) == (position.x, position.y, position.z)
    assert message.transform.rotation == odometry.pose.pose.orientation


def test_transform_takes_the_axle_centre_to_the_pose():
    for pose in [(0.0, 0.0, 0.0), (1.0, -2.0, 0.5), (-3.5, 1e5, -3.1), (0.0, 2.0, math.pi)]:
        message = odometry(*pose, frame='world')
        message.child_frame_id, message.header.stamp = 'axle', stamp(12_345_678_901)
        written = transform_of(message)
        assert_same(written, message)
        translation, q = written.transform.translation, written.transform.rotation
        assert (translation.z, q.x, q.y) == (0.0, 0.0, 0.0)
        planar = se2.homogeneous([translation.x, translation.y, 2.0 * math.atan2(q.z, q.w)])
        np.testing.assert_allclose(planar, se2.homogeneous(pose), rtol=1e-15, atol=1e-15)


def test_each_odometry_has_its_transform_where_tf2_ros_is_installed(lockstep, add, capfd):
    """Elsewhere that is logged once, and the rest works."""
    topics, received = Topics(lockstep), []
    if find_spec('tf2_ros'):
        from tf2_msgs.msg import TFMessage

        received = lockstep.listen(TFMessage, '/tf')
    robot = add(VirtualRobot)
    lockstep.publish('cmd_vel', twist(1.0, 2.0))
    lockstep.run_for(0.2)
    assert change(robot, odom_frame_id='world', base_frame_id='axle').successful
    lockstep.run_for(0.2)
    assert len(topics.odom) > 20
    if find_spec('tf2_ros'):
        for message, odom in zip(received, topics.odom, strict=True):
            (transform,) = message.transforms
            assert_same(transform, odom)
        assert (received[0].transforms[0].child_frame_id, transform.child_frame_id) == (
            *('base_link', 'axle'),
        )
        count = len(received)
        lockstep.remove(robot)
        add(VirtualRobot, enable_odom_tf=False)
        lockstep.run_for(0.2)
        assert len(received) == count
    else:
        words = 'tf2_ros is not installed: no transform is published'
        assert capfd.readouterr().err.count(words) == 1
        assert '/tf' not in dict(lockstep.node.get_topic_names_and_types())
