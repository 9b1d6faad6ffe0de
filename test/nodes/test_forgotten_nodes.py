"""What is silent in ROS is said: forgotten nodes, several publishers, driving by hand, integers."""

from __future__ import annotations

import struct
import sys

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from support.lockstep_nodes import ACCEPTED, CANCELED, EXECUTING, SUCCEEDED, Controller, Topics, make
from support.ros_messages import goal, goals, odometry, twist, twists

from diffdrive_jacobian.messages.cdr import integer_warning
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros.graph_faults import Interleaving, LastingFault
from diffdrive_jacobian.ros.node import FAULT_PATIENCE

INTEGER = 5e-324


def check(node, times=FAULT_PATIENCE):
    """Let a node check the graph, as its timer does once a second."""
    for _ in range(times):
        node._check_graph()


def said(capfd):
    return capfd.readouterr().err


@pytest.fixture
def node(lockstep):
    """Another node, and a way to create publishers and subscriptions of it."""
    return lockstep.node


# --- Faults


def test_a_fault_is_reported_once_after_it_has_lasted_and_again_after_it_was_gone():
    fault = LastingFault(3)
    present = ['a'] * 5 + [None] + ['a'] * 4 + ['b'] * 2 + ['a'] * 2 + ['b'] * 3
    reports = [fault.check(one) for one in present]
    assert [(index, one) for index, one in enumerate(reports) if one] == [(2, 'a'), (8, 'a'), (16, 'b')]


def test_alternating_publishers_are_told_by_their_sequence_numbers():
    def falls(*numbers):
        commands = Interleaving()
        for commands.number in numbers:
            commands.count()
        found = commands.falls()
        assert commands.falls() == 0
        return found

    assert falls() == falls(1, 2, 3, 5, 90) == 0
    # A publisher that was restarted.
    assert falls(7, 8, 1, 2, 3) == 1
    assert falls(1, 1, 2, 2, 3, 3) == 3
    assert falls(1000, 4, 1001, 5, 1002, 6) == 3
    # Middleware without sequence numbers.
    assert falls(None, None) == 0


@pytest.mark.parametrize(
    ('value', 'integer'),
    [
        (INTEGER, True),
        (-INTEGER, True),
        (4.9e-323, True),
        (0.0, False),
        (1.0, False),
        (1e-300, False),
        (float('nan'), False),
    ],
)
def test_integers_in_fields_of_floats_are_told(value, integer):
    assert (integer_warning('it', 0.0, value) is not None) == integer


# --- Forgotten nodes


def test_a_controller_whose_commands_nobody_reads_says_so_once(lockstep, add, capfd):
    controller = add(GoToGoal)
    check(controller, FAULT_PATIENCE - 1)
    assert 'no node is subscribed' not in said(capfd)
    check(controller, 3 * FAULT_PATIENCE)
    text = said(capfd)
    assert text.count('no node is subscribed to /cmd_vel: start virtual_robot') == 1
    assert 'in the same namespace, or remap the topic (cmd_vel:=NAME)' in text
    commands = lockstep.listen(Twist, 'cmd_vel')
    check(controller)
    assert commands == []
    assert said(capfd) == ''


def test_a_bridge_whose_wheels_nobody_drives_says_so(add, capfd):
    check(add(WheelBridge))
    assert 'no node is subscribed to /joint_command: start virtual_robot with' in said(capfd)


def test_a_robot_without_its_bridge_says_so(add, capfd):
    check(add(VirtualRobot, command_interface='wheels'))
    assert 'no node publishes /joint_command: start wheel_bridge' in said(capfd)


def test_two_robots_on_one_odom_are_named(add, node, capfd):
    robot, controller = add(VirtualRobot), add(GoToGoal)
    check(robot)
    check(controller)
    assert 'publish /odom' not in said(capfd)
    node.create_publisher(Odometry, 'odom', 10)
    names = f'{node.get_fully_qualified_name()} and /virtual_robot'
    for one in (robot, controller):
        check(one, 2 * FAULT_PATIENCE)
        text = said(capfd)
        assert text.count(f'{names} publish /odom: their poses alternate') == 1
        assert 'killed' not in text


def test_a_robot_that_was_killed_and_started_again_is_told(add, node, capfd):
    controller = add(GoToGoal)
    for _ in range(2):
        node.create_publisher(Odometry, 'odom', 10)
    check(controller)
    assert '(2 times) publish /odom' in (text := said(capfd))
    assert 'one that was killed disappears within 20 s' in text


def test_two_controllers_of_one_robot_are_named(add, node, capfd):
    controller = add(GoToGoal)
    node.create_publisher(GoalStatus, 'goal_status', 10)
    check(controller)
    names = f'/go_to_goal and {node.get_fully_qualified_name()}'
    assert f'{names} publish /goal_status: two controllers' in said(capfd)


REMAPPED = [
    argument
    for name in ('odom', 'cmd_vel', 'joint_command', 'goal_pose', 'goals', 'goal_status')
    for argument in ('-r', f'{name}:=my_{name}')
]


@pytest.mark.lockstep(args=['--ros-args', *REMAPPED])
@pytest.mark.parametrize(
    ('node_class', 'parameters', 'topic', 'expected'),
    [
        (GoToGoal, {}, None, 'no node is subscribed to /my_cmd_vel: start virtual_robot'),
        (GoToGoal, {}, None, 'or remap the topic (cmd_vel:=NAME)'),
        (GoToGoal, {}, (Odometry, 'odom', 2), 'publish /my_odom: their poses alternate'),
        (GoToGoal, {}, (GoalStatus, 'goal_status', 1), 'publish /my_goal_status: two controllers'),
        (WheelBridge, {}, None, 'no node is subscribed to /my_joint_command: start virtual_robot'),
        (
            VirtualRobot,
            {'command_interface': 'wheels'},
            None,
            'no node publishes /my_joint_command: start wheel_bridge',
        ),
        (VirtualRobot, {}, (PoseStamped, 'goal_pose', 1), 'goals are lost: start go_to_goal'),
        (VirtualRobot, {}, (Odometry, 'odom', 1), 'publish /my_odom: their poses alternate'),
    ],
)
def test_nodes_with_remapped_topics_report_the_same(
    add, node, capfd, node_class, parameters, topic, expected
):
    one = add(node_class, **parameters)
    if topic is not None:
        kind, name, count = topic
        for _ in range(count):
            node.create_publisher(kind, name, 10)
    check(one)
    assert expected in said(capfd)


def test_goals_without_a_controller_are_reported_by_the_robot(lockstep, add, node, capfd):
    robot = add(VirtualRobot)
    publisher = node.create_publisher(PoseStamped, 'goal_pose', 10)
    check(robot)
    text = said(capfd)
    assert f'{node.get_fully_qualified_name()} publishes /goal_pose, but no controller is' in text
    assert 'start go_to_goal' in text
    add(GoToGoal)
    check(robot, 2 * FAULT_PATIENCE)
    assert 'no controller' not in said(capfd)
    node.destroy_publisher(publisher)


def test_remapped_topics_are_checked_under_their_names(lockstep, node, capfd):
    remaps = ['--ros-args', '-r', 'odom:=pose', '-r', 'cmd_vel:=speed']
    robot = lockstep.add(VirtualRobot(cli_args=[*remaps, '-r', 'goal_pose:=target']))
    controller = lockstep.add(GoToGoal(cli_args=remaps))
    node.create_publisher(PoseStamped, 'target', 1)
    node.create_publisher(Odometry, 'pose', 1)
    for one in (robot, controller):
        check(one)
    log = said(capfd)
    assert log.count('/lockstep and /virtual_robot publish /pose') == 2
    assert '/lockstep publishes /target, but no controller is subscribed to it' in log


def test_nothing_is_reported_of_a_complete_team(lockstep, team, capfd):
    lockstep.publish('goals', goals(goal(0.2, 0.0)))
    lockstep.run_until(lambda: team.statuses[-1:] == [SUCCEEDED], 30.0, 'arrival')
    for one in (team.robot, team.bridge, team.controller):
        check(one, 2 * FAULT_PATIENCE)
    assert '[WARN]' not in said(capfd)


# --- Several drivers


@pytest.mark.parametrize('node_class', [VirtualRobot, WheelBridge])
@pytest.mark.parametrize('stamped', [False, True])
def test_alternating_commands_are_reported_and_zeros_are_not(
    lockstep, add, node, capfd, node_class, stamped
):
    driven = add(node_class, enable_stamped_cmd_vel=stamped)
    lockstep.listen(JointState, 'joint_command')
    kind = TwistStamped if stamped else Twist
    drivers = [node.create_publisher(kind, 'cmd_vel', 10) for _ in range(2)]

    def drive(*speeds):
        for _ in range(4):
            for publisher, speed in zip(drivers, speeds, strict=True):
                publisher.publish(
                    TwistStamped(twist=twist(speed, 0.0)) if stamped else twist(speed, 0.0)
                )
        lockstep.run_for(0.1)
        check(driven, 1)

    for _ in range(5):
        drive(0.5, 0.0)
    assert 'alternate' not in said(capfd)
    for _ in range(5):
        drive(0.5, 0.3)
    text = said(capfd)
    assert text.count('publish /cmd_vel, and their commands alternate: stop one of them') == 1
    assert f'{node.get_fully_qualified_name()} (2 times)' in text


def test_driving_by_hand_cancels_the_goal(lockstep, add, node, capfd):
    team = Topics(lockstep)
    add(VirtualRobot)
    add(GoToGoal, linear__x__max_velocity=0.5)
    lockstep.publish('goals', goals(goal(50.0, 0.0)))
    lockstep.run_for(0.5)
    assert team.statuses[-1] == EXECUTING
    # As of a joystick that nobody touches.
    joystick = node.create_publisher(Twist, 'cmd_vel', 10)
    joystick.publish(Twist())
    lockstep.run_for(1.5)
    joystick.publish(Twist())
    lockstep.run_for(0.1)
    assert team.statuses[-1] == EXECUTING
    joystick.publish(twist(0.25, 0.0))
    lockstep.run_for(0.1)
    assert team.statuses[-1] == CANCELED
    text = said(capfd)
    assert f'{node.get_fully_qualified_name()} drives the robot by /cmd_vel, so the goal' in text
    # Which of both commands came last is unknown, so the robot is stopped, once.
    assert twists(team.commands)[-1] == (0.0, 0.0)
    before = len(team.commands)
    lockstep.run_for(0.2)
    assert len(team.commands) == before
    # Without a goal the hand drives.
    joystick.publish(twist(0.1, 0.0))
    lockstep.run_for(0.1)
    assert team.odom[-1].twist.twist.linear.x == 0.1
    assert 'drives the robot' not in said(capfd)


@pytest.mark.parametrize('command', [Twist, TwistStamped])
def test_a_controller_beside_an_idle_driver_knows_its_own_commands(lockstep, node, command):
    node.create_publisher(command, 'cmd_vel', 10)
    stamped = command is TwistStamped
    controller = Controller(lockstep, command, enable_stamped_cmd_vel=stamped)
    controller.send(goals(goal(1.0, 0.3)))
    for step in range(100):
        controller.at(0.001 * step, 0.0)
        lockstep.run_for(0.02)
    assert [status for _, status in controller.statuses] == [ACCEPTED, EXECUTING]
    assert controller.node._others.subscriptions == 1


def test_a_controller_alone_does_not_receive_commands(lockstep, team):
    lockstep.publish('goals', goals(goal(0.3, 0.0)))
    lockstep.run_for(2.0)
    topics = [one.topic_name for one in team.controller.subscriptions]
    assert '/cmd_vel' not in topics


def test_its_own_subscription_is_no_reader_of_a_controller(lockstep, node, add, capfd):
    node.create_publisher(Twist, 'cmd_vel', 10)
    controller = add(GoToGoal)
    node.create_publisher(Odometry, 'odom', 10)
    lockstep.publish('goals', goals(goal(1.0, 0.0)))
    assert controller._others.subscriptions == 1
    check(controller)
    assert 'no node is subscribed to /cmd_vel' in said(capfd)


BEST_EFFORT = 'qos_overrides./cmd_vel.publisher.reliability:=best_effort'


@pytest.mark.lockstep(args=['--ros-args', '-p', BEST_EFFORT])
def test_a_controller_that_publishes_best_effort_knows_its_own_commands(lockstep, add, node, capfd):
    profile = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    joystick = node.create_publisher(Twist, 'cmd_vel', profile)
    controller = Controller(lockstep)
    controller.send(goals(goal(1.0, 0.3)))
    controller.at(0.0, 0.0)
    check(controller.node)
    text = said(capfd)
    assert 'no node is subscribed' not in text
    assert 'incompatible QoS' not in text
    joystick.publish(twist(0.25, 0.0))
    lockstep.settle()
    assert [status for _, status in controller.statuses][-1] == CANCELED


# --- Integers


def integers(message, *values):
    """Serialize a message with these values in place of 1.0, 2.0, ... in its fields."""
    data = bytes(serialize_message(message))
    for number, value in enumerate(values, 1):
        marker = struct.pack('<d', float(number))
        assert data.count(marker) == 1
        data = data.replace(marker, struct.pack('<d', value))
    return data


@pytest.mark.parametrize('node_class', [VirtualRobot, WheelBridge])
def test_an_integer_as_a_command_is_reported(lockstep, add, node, capfd, node_class):
    add(node_class)
    publisher = node.create_publisher(Twist, 'cmd_vel', 10)
    publisher.publish(twist(0.5, 0.0))
    lockstep.settle()
    assert 'was an int' not in said(capfd)
    publisher.publish(integers(twist(1.0, 0.0), INTEGER))
    publisher.publish(integers(twist(1.0, 0.0), INTEGER))
    lockstep.settle()
    text = said(capfd)
    assert text.count('has the value 4.94e-324: was an int assigned to a float field?') == 1


@pytest.mark.parametrize('value', [1, -1, 5, 2**40, True])
def test_integers_are_reported_as_this_python_sends_them(lockstep, add, node, capfd, value):
    add(VirtualRobot)
    message = Twist()
    # As `message.linear.x = value` without the checks of rclpy, which are on in these tests.
    message.linear._x = value
    node.create_publisher(Twist, 'cmd_vel', 10).publish(message)
    lockstep.settle()
    is_nan = value < 0 and sys.version_info < (3, 12)
    assert ('twist must be finite, got' if is_nan else 'was an int assigned to a float') in said(capfd)


@pytest.mark.parametrize('kind', [PoseStamped, Goals])
def test_an_integer_in_a_goal_is_reported_and_taken_as_it_is(lockstep, node, capfd, kind):
    controller = Controller(lockstep)
    topic = 'goals' if kind is Goals else 'goal_pose'
    publisher = node.create_publisher(kind, topic, 10)
    pose = goal(2.0, 0.0)
    pose.pose.orientation.z, pose.pose.orientation.w = 0.6, 0.8
    publisher.publish(integers_of(pose if kind is PoseStamped else goals(pose)))
    lockstep.settle()
    assert f'a pose on {topic} has the value 4.94e-324' in said(capfd)
    assert [status for _, status in controller.statuses] == [ACCEPTED]


def integers_of(message):
    data = bytes(serialize_message(message))
    marker = struct.pack('<d', 2.0)
    assert data.count(marker) == 1
    return data.replace(marker, struct.pack('<d', INTEGER))


def test_topics_of_a_controller_that_sees_odometry(lockstep):
    """The usual pair stays as cheap as it was: nothing is created after the start."""
    topics = Topics(lockstep)
    controller = lockstep.add(make(GoToGoal))
    before = len(list(controller.subscriptions))
    lockstep.publish('goals', goals(goal(1.0, 0.0)))
    lockstep.publish('odom', odometry(0.0, 0.0, 0.0))
    lockstep.run_for(1.5)
    assert topics.commands
    assert len(list(controller.subscriptions)) == before


def test_an_integer_in_an_initial_pose_is_reported(lockstep, add, node, capfd):
    add(VirtualRobot)
    publisher = node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)
    message = PoseWithCovarianceStamped()
    message.pose.pose.position.x = 1.0
    message.pose.pose.orientation.w = 2.0
    publisher.publish(integers(message, INTEGER, 1.0))
    lockstep.settle()
    assert 'initialpose has the value 4.94e-324: was an int assigned' in said(capfd)


def test_an_integer_as_a_wheel_speed_is_reported(lockstep, add, node, capfd):
    robot = add(VirtualRobot, command_interface='wheels')
    publisher = node.create_publisher(JointState, 'joint_command', 10)
    names = list(robot.parameters.wheel_names)
    publisher.publish(integers(JointState(name=names, velocity=[1.0, 2.0]), INTEGER, INTEGER))
    lockstep.settle()
    assert 'a command on joint_command has the value 4.94e-324: was an int' in said(capfd)
