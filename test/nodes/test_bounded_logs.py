"""What messages can make the nodes log, and how much of a message they quote or convert."""

from __future__ import annotations

import struct

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Goals
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.lockstep_nodes import ABORTED, ACCEPTED, CANCELED, EXECUTING, Controller, change
from support.ros_messages import (
    goal,
    goals,
    odometry,
    placement,
    twist,
    twist_stamped,
)

from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.nodes import GoToGoalParameters
from diffdrive_jacobian.ros import node

MEGABYTE = 1_000_000 * 'f'
FLOOD = 40
MOST_LINES = 30
"""More than EVENT_BURST lines, and what EVENT_PERIOD adds on a slow machine."""


@pytest.fixture
def controller(lockstep):
    return Controller(lockstep)


def assert_a_few(capfd, *words):
    written = capfd.readouterr().err
    for one in words:
        assert node.EVENT_BURST <= written.count(one) <= MOST_LINES, one


def test_flood_of_goals_has_a_status_each_and_a_few_log_lines(controller, capfd):
    for number in range(1, FLOOD):
        controller.send(goal(1, 0, stamp=number))
        controller.send(goal(9e9, 0, stamp=1000 + number))
    assert_a_few(capfd, 'goal accepted: ', 'goal refused: ')
    for number in range(1, FLOOD - 1):
        statuses = [status for stamp, status in controller.statuses if stamp in (number, 1000 + number)]
        assert statuses == [ACCEPTED, ABORTED, ACCEPTED, CANCELED]


def test_events_of_the_controller_are_logged_a_few_times(lockstep, controller, capfd):
    change(controller.node, odom_timeout=0.001)
    for _ in range(FLOOD):
        controller.send(goal(1, 0))
        lockstep.run_for(0.002)
        assert lockstep.call(Trigger, 'cancel_goal').success
    assert_a_few(capfd, 'goal accepted', 'the goal waits for odometry', 'goal canceled')
    controller.send(goal(1, 0))
    for _ in range(FLOOD):
        controller.sees(odometry(0, 0, 0))
        lockstep.run_for(0.002)
    assert_a_few(capfd, 'no valid odometry', 'odometry is received again')
    for number in range(FLOOD):
        change(controller.node, kp=0.1 + 0.001 * number, linear__x__max_velocity=0.0)
    assert_a_few(capfd, 'is not larger than kv', 'linear.x.max_velocity is 0')


def test_events_of_the_robot_and_the_bridge_are_logged_a_few_times(lockstep, add, capfd):
    add(VirtualRobot)
    add(WheelBridge, cmd_vel_timeout=0.001)
    for number in range(FLOOD):
        lockstep.publish('initialpose', placement(number))
        lockstep.publish('cmd_vel', twist(1, 0))
        lockstep.run_for(0.002)
        lockstep.jump(-0.003)
    assert_a_few(capfd, 'pose set to', 'the wheels are stopped', 'time went back')


# --- Quoted text


@pytest.mark.parametrize('text', [MEGABYTE, 5_000 * '\x1b[31m\n\u202e'])
def test_long_frames_are_quoted_in_short(lockstep, controller, capfd, text):
    lockstep.add(VirtualRobot())
    controller.sees(odometry(0, 0, 0, frame=text))
    controller.send(goal(1, 0, frame=text[1:]))
    controller.send(goals(goal(1, 0, frame=text), goal(1, 0, frame='b'), frame=text[1:]))
    controller.send(goals(*(goal(1, 0, frame=f'{number}{text}') for number in range(9))))
    controller.send(goal(1, 0))
    controller.sees(odometry(0, 0, 0, frame=text))
    controller.sees(odometry(0, 0, 0, frame='other'))
    lockstep.publish('initialpose', placement(0, frame=text))
    written = capfd.readouterr().err
    for words in ('in the frame of the', 'in one frame, got', 'it must stay in frame', 'frame must be'):
        assert words in written
    assert max(map(len, written.splitlines())) < 600
    assert '\x1b' not in written
    assert '\u202e' not in written


def test_long_and_many_joint_names_are_quoted_in_short(lockstep, add, capfd):
    add(VirtualRobot, command_interface='wheels')
    names = [MEGABYTE, *(f'joint {number}' for number in range(10_000))]
    lockstep.publish('joint_command', JointState(name=names, velocity=[0.0] * len(names)))
    (line,) = [one for one in capfd.readouterr().err.splitlines() if 'command dropped' in one]
    assert "must name each of ['left_wheel_joint', 'right_wheel_joint'] once" in line
    assert line.endswith("'joint 2', ... (10001 in all)]")
    assert len(line) < 500


def test_long_strings_are_refused_as_parameters(lockstep, add_complete):
    robot = add_complete(VirtualRobot)
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=10 * MEGABYTE)
    request = SetParameters.Request(parameters=[ParameterMessage(name='odom_frame_id', value=value)])
    (result,) = lockstep.call(SetParameters, 'virtual_robot/set_parameters', request).results
    assert not result.successful
    assert "'odom_frame_id' must be not empty and at most 256 characters, got 'fff" in result.reason
    assert result.reason.endswith("...' (10000000 characters)")
    assert len(result.reason) < 300
    assert change(robot, odom_frame_id=256 * 'n').successful
    assert not change(robot, odom_frame_id=257 * 'n').successful
    for name in ('controller', 'kp'):
        with pytest.raises(ParameterError) as caught:
            GoToGoalParameters(**{name: MEGABYTE})
        assert len(str(caught.value)) < 300


# --- Long goals


def test_goals_with_too_many_poses_are_refused(controller, capfd):
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    message = goals(*[goal(1, 0)] * (MAX_WAYPOINTS + 1), stamp=2)
    controller.send(message)
    words = f'goals must contain 1 to {MAX_WAYPOINTS} poses, got {MAX_WAYPOINTS + 1}'
    assert words in capfd.readouterr().err
    assert controller.statuses[-2:] == [(2, ABORTED), (1, EXECUTING)]
    message.goals.pop()
    controller.send(message)
    assert controller.statuses[-2:] == [(1, CANCELED), (2, ACCEPTED)]


def big_endian_goals(count):
    """Serialize that many poses of zeros, without frames, in an encapsulation that only rclpy reads."""
    header = struct.pack('>iII', 2, 0, 1) + bytes(4)
    return b'\0\2\0\0' + header + struct.pack('>I', count) + bytes(72 * count)


def test_bytes_that_are_no_goals_or_too_many_to_convert_are_dropped(lockstep, controller, capfd):
    publisher = lockstep.node.create_publisher(Goals, 'goals', 10)
    publisher.publish(big_endian_goals(10))
    lockstep.settle()
    assert controller.statuses == [(2, ABORTED)]
    publisher.publish(big_endian_goals(MAX_WAYPOINTS + 1000))
    lockstep.settle()
    assert f'goals must contain 1 to {MAX_WAYPOINTS} poses' in capfd.readouterr().err
    publisher.publish(big_endian_goals(30_000))
    lockstep.settle()
    assert 'goals dropped: it must have at most 2097152 bytes, got 21600' in capfd.readouterr().err
    for data in (
        b'',
        b'\0\1\0\0',
        b'\xff' * 64,
        serialize_message(goals(goal(1, 0), goal(2, 0)))[:-50],
        serialize_message(goals())[:-4] + b'\x05\0\0\0',
    ):
        publisher.publish(data)
        lockstep.settle()
    # One of them has a header.
    assert set(controller.statuses[2:]) <= {(0, ABORTED)}
    controller.send(goal(1, 0, stamp=3))
    assert controller.at(0, 0) == (0.5, 0.0)
    assert controller.statuses[-1] == (3, EXECUTING)


# --- Invalid stamps


@pytest.mark.parametrize(
    ('node_class', 'kind', 'topic'),
    [(VirtualRobot, TwistStamped, 'cmd_vel_out'), (WheelBridge, JointState, 'joint_command')],
)
def test_negative_stamp_is_not_taken_for_none(lockstep, add, capfd, node_class, kind, topic):
    answered = lockstep.listen(kind, topic)
    add(node_class, enable_stamped_cmd_vel=True)
    message = twist_stamped(1.0, 0.0, 0)
    # Together they are zero, which would mean that the command has no stamp.
    message.header.stamp.sec, message.header.stamp.nanosec = -1, 1_000_000_000
    lockstep.publish('cmd_vel', message)
    assert answered == []
    assert 'command dropped: its stamp must have sec of at least 0' in capfd.readouterr().err
