"""The node go_to_goal: goals in, one command per odometry message, a status for each goal."""

from __future__ import annotations

import math

import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from rclpy.parameter import Parameter
from ros_messages import goal, goals, odometry
from std_srvs.srv import Trigger

from diffdrive_jacobian.control import go_to_goal
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal

ACCEPTED, EXECUTING = GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING
SUCCEEDED, CANCELED = GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED
ABORTED = GoalStatus.STATUS_ABORTED


class Controller:
    """A controller whose odometry is ours."""

    def __init__(self, ros, command=Twist, node_class=GoToGoal, **parameters):
        self.ros = ros
        self.commands = ros.listen(command, 'cmd_vel')
        self.status = ros.listen(GoalStatus, 'goal_status', latched=True)
        self.node = ros.add(node_class, parameters=parameters)
        self._odom = ros.talk(Odometry, 'odom')
        self._goal = ros.talk(PoseStamped, 'goal_pose')
        self._goals = ros.talk(Goals, 'goals')

    def statuses(self):
        return [(one.goal_info.stamp.sec, one.status) for one in self.status]

    def ends(self, *statuses):
        """Wait for the last status, and hold all there were against the expected `(stamp, status)`."""
        self.ros.until(lambda: self.statuses()[-1:] == [statuses[-1]], f'status {statuses[-1]}')
        assert self.statuses()[-len(statuses) :] == list(statuses)

    def send(self, message):
        """Send a goal and wait for its first status."""
        before = len(self.status)
        (self._goals if isinstance(message, Goals) else self._goal).publish(message)
        self.ros.until(lambda: len(self.status) > before, 'a status')

    def at(self, x, y, theta=0.0, frame='odom'):
        """Send odometry and give the command that answers it."""
        before = len(self.commands)
        self._odom.publish(odometry(x, y, theta, frame))
        self.ros.until(lambda: len(self.commands) > before, 'a command')
        assert len(self.commands) == before + 1
        command = self.commands[-1]
        command = command.twist if isinstance(command, TwistStamped) else command
        return command.linear.x, command.angular.z

    def publish(self, message):
        """Send a goal pose without waiting."""
        self._goal.publish(message)

    def sees(self, message):
        """Send odometry that may go unanswered."""
        self._odom.publish(message)


@pytest.fixture
def controller(ros):
    return Controller(ros)


def test_golden_command_of_document_a(controller, executor_kind):
    controller.send(goal(1.0, 1.0))
    v, omega = controller.at(0.0, 0.0)
    assert (round(v, 3), round(omega, 3)) == (0.5, 2.356)


def test_each_odometry_is_answered_by_the_law_and_arrival_by_zero(controller):
    controller.send(goal(2.0, -1.0, stamp=7))
    for pose in ([0, 0, 0], [1, 1, 2], [2, -0.9, -3], [1.9, -1, 0.1]):
        assert controller.at(*pose) == pytest.approx(go_to_goal(pose, [2, -1], 3.0, 0.5))
    assert controller.at(2.01, -1.01) == (0.0, 0.0)
    controller.ends((7, ACCEPTED), (7, EXECUTING), (7, SUCCEEDED))


class Counting(GoToGoal):
    odometry = 0

    def _on_odometry(self, message):
        self.odometry += 1
        super()._on_odometry(message)


def test_without_a_goal_it_is_silent(ros):
    controller = Controller(ros, node_class=Counting)
    for _ in range(5):
        controller.sees(odometry(0, 0, 0))
    ros.until(lambda: controller.node.odometry == 5, 'the odometry is seen')
    controller.send(goal(1, 0))
    controller.at(0, 0)
    controller.at(1, 0)
    controller.sees(odometry(1, 0, 0))
    ros.until(lambda: controller.node.odometry == 8, 'the odometry is seen')
    controller.send(goal(3, 0))
    controller.at(1, 0)
    assert [one.linear.x for one in controller.commands] == [0.5, 0.0, 1.0]


def test_goal_on_the_own_spot_succeeds_at_once(controller):
    controller.send(goal(0.0, 0.0))
    assert controller.at(0.0, 0.0, 1.0) == (0.0, 0.0)
    controller.ends((0, SUCCEEDED))


def test_waypoints_are_driven_in_order(controller):
    controller.send(goals(goal(1, 0), goal(1, 1), goal(0, 1), stamp=3))
    assert controller.at(0, 0)[0] == pytest.approx(0.5)
    v, omega = controller.at(1.0, 0.0)
    assert v == pytest.approx(0.0, abs=1e-12)
    assert omega == pytest.approx(3.0 * math.pi / 2)
    controller.at(1.0, 1.0, math.pi / 2)
    assert controller.statuses()[-1] == (3, EXECUTING)
    assert controller.at(0.0, 1.0) == (0.0, 0.0)
    controller.ends((3, ACCEPTED), (3, EXECUTING), (3, SUCCEEDED))


def test_new_goal_replaces_the_active_one(controller):
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    controller.send(goal(-1, 0, stamp=2))
    v, _ = controller.at(0, 0, math.pi)
    assert v == pytest.approx(0.5)
    controller.ends(
        (1, ACCEPTED), (1, EXECUTING), (1, CANCELED), (2, ACCEPTED), (2, EXECUTING)
    )  # fmt: skip


def test_cancel_sends_zero(ros, controller):
    assert not ros.call(Trigger, 'cancel_goal').success
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    assert ros.call(Trigger, 'cancel_goal').success
    ros.until(lambda: len(controller.commands) == 2 and len(controller.status) == 3, 'the zero')
    assert controller.commands[-1] == Twist()
    controller.ends((1, CANCELED))


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        (goal(1, 0, frame='map', stamp=2), "the odometry, 'odom' or '' for it, got 'map'"),
        (goal(math.nan, 0, stamp=2), 'position must be finite and within 1e+06 m, got x nan'),
        (goal(0, 1e308, stamp=2), 'got x 0, y 1e+308'),
        (goals(stamp=2), 'at least one pose, got none'),
        (goals(goal(0, 0), goal(0, math.inf), stamp=2), 'y inf'),
        (goals(goal(0, 0, frame='a'), goal(0, 0, frame='b'), stamp=2), "one frame, got ['a', 'b']"),
    ],
    ids=['frame', 'nan', '1e308', 'empty', 'one bad', 'two frames'],
)
def test_bad_goal_is_refused_and_the_active_one_goes_on(controller, capfd, message, words):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    controller.send(message)
    assert controller.at(0, 0) == pytest.approx((0.5, 0.0))
    # The status that a latecomer sees last is that of the goal that goes on.
    controller.ends((1, ACCEPTED), (1, EXECUTING), (2, ABORTED), (1, EXECUTING))
    assert words in capfd.readouterr().err


def test_goal_without_orientation_is_refused(controller, capfd):
    message = goal(1, 0)
    message.pose.orientation.w = 0.0
    controller.send(message)
    controller.ends((0, ABORTED))
    assert 'quaternion of length 1' in capfd.readouterr().err


def test_frame_is_judged_when_odometry_comes_first_after_the_goal(ros, controller, capfd):
    controller.send(goal(1, 0, frame='map', stamp=1))
    controller.sees(odometry(0, 0, 0))
    ros.until(lambda: controller.statuses()[-1] == (1, ABORTED), 'the refusal')
    assert "got 'map'" in capfd.readouterr().err
    assert not controller.commands


def spoiled(field, value):
    message = odometry(0, 0, 0)
    target = message.pose.pose
    *path, last = field.split('.')
    for name in path:
        target = getattr(target, name)
    setattr(target, last, value)
    return message


@pytest.mark.parametrize(
    ('message', 'words'),
    [
        (spoiled('position.x', math.nan), 'odometry dropped: position must be finite'),
        (spoiled('position.y', 1e308), 'y 1e+308'),
        (spoiled('orientation.w', 0.0), 'got x 0, y 0, z 0, w 0'),
        (spoiled('orientation.z', math.nan), 'quaternion of length 1'),
        (odometry(0, 0, 0, frame='map'), "it must stay in frame 'odom', got 'map'"),
    ],
    ids=['nan', '1e308', 'zero quaternion', 'nan quaternion', 'other frame'],
)
def test_bad_odometry_is_dropped_and_stops_the_robot_in_time(ros, capfd, message, words):
    controller = Controller(ros, odom_timeout=0.2)
    controller.send(goal(1, 0))
    controller.at(0, 0)
    asked = ros.peer.create_timer(0.02, lambda: controller.sees(message))
    ros.until(lambda: len(controller.commands) == 2, 'zero, for want of odometry')
    assert controller.commands[-1] == Twist()
    ros.peer.destroy_timer(asked)
    # The goal was kept.
    assert controller.at(0.5, 0.0) == pytest.approx((0.25, 0.0))
    said = capfd.readouterr().err
    assert words in said
    assert 'no valid odometry on /odom for 0.2 s' in said
    assert 'odometry is back' in said


def test_odometry_that_dies_around_a_new_goal_stops_the_robot(ros, capfd):
    controller = Controller(ros, odom_timeout=0.2)
    controller.send(goal(1, 0, stamp=1))
    controller.at(0, 0)
    again = ros.peer.create_timer(0.05, lambda: controller.publish(goal(-1, 0, stamp=2)))
    ros.until(lambda: len(controller.commands) == 2, 'zero, whatever is sent anew')
    ros.peer.destroy_timer(again)
    assert controller.commands[-1] == Twist()
    assert 'no valid odometry on /odom for 0.2 s' in capfd.readouterr().err


def test_new_goal_is_not_judged_by_a_stray_frame(ros, controller):
    controller.send(goal(1, 0, frame='odom', stamp=1))
    controller.at(0, 0)
    controller.send(goal(-1, 0, stamp=2))
    controller.sees(odometry(5, 5, 0, frame='other'))
    assert controller.at(0, 0, math.pi)[0] == pytest.approx(0.5)
    controller.ends(
        (1, ACCEPTED), (1, EXECUTING), (1, CANCELED), (2, ACCEPTED), (2, EXECUTING)
    )  # fmt: skip


def test_final_heading_is_taken_when_asked_for(ros):
    controller = Controller(ros, use_goal_heading=True, yaw_goal_tolerance=0.1)
    controller.send(goals(goal(1, 0, 2.0), goal(1, 1, -2.0)))
    controller.at(0, 0)
    v, omega = controller.at(1.0, 0.0, math.pi / 2)
    assert (v, omega) == pytest.approx((0.5, 0.0))
    assert controller.at(1.0, 1.0, 2.0) == pytest.approx((0.0, 3.0 * (math.tau - 4.0)))
    assert controller.at(1.0, 1.1, -2.3) == pytest.approx((0.0, 3.0 * 0.3))
    assert controller.at(1.0, 1.0, -2.05) == (0.0, 0.0)
    controller.ends((0, SUCCEEDED))


def test_limits_keep_the_curvature(ros):
    limits = {'linear.x.max_velocity': 0.2, 'angular.z.max_velocity': 1.0}
    controller = Controller(ros, **limits)
    controller.send(goal(5, 2))
    v, omega = controller.at(0, 0)
    wanted_v, wanted_omega = go_to_goal([0, 0, 0], [5, 2], 3.0, 0.5)
    assert v == 0.2
    assert omega / v == pytest.approx(wanted_omega / wanted_v, rel=1e-12)


def test_far_goals_ask_for_nothing_that_a_robot_would_drop(controller):
    controller.send(goal(9e5, 9e5))
    v, omega = controller.at(0, 0)
    wanted_v, wanted_omega = go_to_goal([0, 0, 0], [9e5, 9e5], 3.0, 0.5)
    assert v == 1000.0
    assert omega / v == pytest.approx(wanted_omega / wanted_v, rel=1e-12)


def test_stamped_commands_carry_the_time(ros):
    controller = Controller(ros, TwistStamped, enable_stamped_cmd_vel=True)
    controller.send(goal(1, 0))
    assert controller.at(0, 0) == pytest.approx((0.5, 0.0))
    assert controller.commands[0].header.stamp != Time()


def test_gains_that_spiral_are_warned_about(controller, capfd):
    controller.send(goal(1, 0))
    assert controller.node.set_parameters([Parameter('kp', value=0.5)])[0].successful
    assert controller.at(0, 0, 1.0)[1] == pytest.approx(-0.5)
    assert 'kp 0.5 is not larger than kv 0.5' in capfd.readouterr().err
    for bad in (0.0, -1.0, math.nan):
        result = controller.node.set_parameters([Parameter('kp', value=bad)])[0]
        assert not result.successful
        assert 'kp' in result.reason


def test_missing_odometry_is_said(ros, capfd):
    controller = Controller(ros, odom_timeout=0.1)
    controller.send(goal(1, 0))
    ros.until_said(capfd, 'the goal waits for odometry on /odom')
    assert not controller.commands
    controller.ends((0, ACCEPTED))


def test_stop_gives_the_goal_up(ros, controller):
    controller.send(goal(1, 0))
    controller.at(0, 0)
    controller.node.stop('the test says so')
    ros.until(lambda: len(controller.commands) == 2, 'the zero')
    assert controller.commands[-1] == Twist()
    controller.ends((0, CANCELED))
