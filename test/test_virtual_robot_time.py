"""The node virtual_robot when time does what it likes, and when its parameters change."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from ros_messages import at_rest, pose_of, twist
from std_srvs.srv import Trigger

from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.ros import node as ros_node
from diffdrive_jacobian.ros.messages import from_time

SECOND = 1_000_000_000


@pytest.fixture
def driving(ros, sim_time):
    """A robot in simulated time that was told to drive at 1 m/s at t = 100 s, and its topics."""

    class Driving:
        odom = ros.listen(Odometry, 'odom')
        applied = ros.listen(TwistStamped, 'cmd_vel_out')
        starts = ros.listen(PoseWithCovarianceStamped, 'start_pose', latched=True)
        robot = ros.add(VirtualRobot, parameters={'use_sim_time': True})
        commands = ros.talk(Twist, 'cmd_vel')

        def seen(self, nanoseconds):
            ros.until(
                lambda: self.odom and from_time(self.odom[-1].header.stamp) == nanoseconds,
                f'odometry of {nanoseconds} ns',
            )
            return self.odom[-1]

        def set(self, **parameters):
            changes = [Parameter(n.replace('__', '.'), value=v) for n, v in parameters.items()]
            return self.robot.set_parameters_atomically(changes)

    it = Driving()
    sim_time.set(100 * SECOND)
    it.commands.publish(twist(1.0, 0.0))
    ros.until(lambda: it.applied, 'the command is applied')
    return it


def test_without_clock_nothing_moves_and_that_is_said(ros, capfd, monkeypatch):
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.05)
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'use_sim_time': True})
    ros.talk(Twist, 'cmd_vel').publish(twist(1.0, 0.0))
    ros.until_said(capfd, 'nothing came on /clock for', 'command dropped: simulated time')
    assert not ros.call(Trigger, 'reset_odometry').success
    assert not odom
    assert not applied


def test_jump_forward_drives_on_to_the_timeout_only(ros, driving, sim_time):
    sim_time.set(3700 * SECOND)
    odometry = driving.seen(3700 * SECOND)
    assert pose_of(odometry) == pytest.approx([0.5, 0.0, 0.0], abs=1e-12)
    assert at_rest(odometry)
    ros.until(lambda: len(driving.applied) == 2, 'the stop is told')
    assert [from_time(one.header.stamp) for one in driving.applied] == [
        100 * SECOND,
        100 * SECOND + SECOND // 2,
    ]


def test_time_that_goes_back_leaves_the_robot_where_it_is(ros, driving, sim_time, capfd):
    sim_time.set(100 * SECOND + SECOND // 4)
    driving.seen(100 * SECOND + SECOND // 4)
    sim_time.set(50 * SECOND)
    ros.until(lambda: len(driving.starts) == 2, 'a new start')
    assert from_time(driving.starts[1].header.stamp) == 50 * SECOND
    assert driving.starts[1].pose.pose.position.x == pytest.approx(0.25, abs=1e-12)
    ros.until(lambda: driving.applied[-1].twist == Twist(), 'the stop is told')
    sim_time.advance(1.0)
    odometry = driving.seen(51 * SECOND)
    assert pose_of(odometry) == pytest.approx([0.25, 0.0, 0.0], abs=1e-12)
    driving.commands.publish(twist(-1.0, 0.0))
    ros.until(lambda: driving.applied[-1].twist.linear.x == -1.0, 'it can be driven again')
    sim_time.advance(0.8)
    sim_time.set(52 * SECOND)
    assert pose_of(driving.seen(52 * SECOND)) == pytest.approx([-0.25, 0.0, 0.0], abs=1e-12)
    assert 'time went back by 50.250 s' in capfd.readouterr().err


def test_limits_hold_for_the_running_command(ros, driving, sim_time):
    sim_time.set(100 * SECOND + SECOND // 5)
    assert driving.set(linear__x__max_velocity=0.25).successful
    sim_time.set(100 * SECOND + 2 * SECOND // 5)
    odometry = driving.seen(100 * SECOND + 2 * SECOND // 5)
    assert pose_of(odometry)[0] == pytest.approx(0.2 + 0.05, abs=1e-12)
    assert driving.applied[-1].twist.linear.x == 0.25
    sim_time.set(200 * SECOND)
    # The timeout still counts from the command.
    assert pose_of(driving.seen(200 * SECOND))[0] == pytest.approx(0.2 + 0.075, abs=1e-12)


def test_timeout_and_rate_change_live(ros, driving, sim_time):
    assert driving.set(cmd_vel_timeout=0.1, publish_rate=10.0).successful
    sim_time.advance(1.0, step=0.1)
    odometry = driving.seen(101 * SECOND)
    assert pose_of(odometry)[0] == pytest.approx(0.1, abs=1e-12)
    before = len(driving.odom)
    sim_time.advance(1.0, step=0.01)
    ros.until(lambda: len(driving.odom) - before >= 10, 'odometry at the new rate')
    stamps = [from_time(one.header.stamp) for one in driving.odom[before:]]
    assert np.diff(stamps) == pytest.approx(SECOND // 10)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'wheel_radius': 0.0}, 'wheel_radius'),
        ({'wheel_radius': math.nan}, 'wheel_radius'),
        ({'wheel_radius': 'big'}, 'expected'),
        ({'linear__x__max_velocity': -1.0}, "'linear.x.max_velocity' must be in [0, 1000]"),
        ({'linear__x__min_velocity': 0.5}, 'got 0.5'),
        ({'max_wheel_velocity': math.inf}, 'or .nan for none'),
        ({'base_frame_id': ''}, "'base_frame_id' must be not empty"),
        ({'base_frame_id': 'odom'}, 'must differ'),
        ({'command_interface': 'wheels'}, 'read-only'),
        ({'publish_rate': 2000.0}, 'publish_rate'),
    ],
)
def test_bad_changes_are_refused_with_the_reason(driving, change, words):
    before = driving.robot.parameters
    result = driving.set(**change)
    assert not result.successful
    assert words in result.reason
    assert driving.robot.parameters is before


def test_integers_are_taken_for_doubles_and_strangers_are_left_alone(driving):
    assert driving.robot.set_parameters([Parameter('wheel_separation', value=1)])[0].successful
    assert driving.robot.parameters.wheel_separation == 1.0
    assert driving.robot.get_parameter('wheel_separation').value == 1.0
    driving.robot.declare_parameter('foreign', 3)
    assert driving.robot.set_parameters([Parameter('foreign', value=4)])[0].successful


def test_rate_that_keeps_changing_starves_nobody(ros):
    odom = ros.listen(Odometry, 'odom')
    robot = ros.add(VirtualRobot, parameters={'publish_rate': 20.0})
    rates = itertools.cycle([21.0, 20.0])
    changed = []

    def change():
        changed.append(robot.set_parameters([Parameter('publish_rate', value=next(rates))]))

    ros.peer.create_timer(0.01, change)
    ros.until(lambda: len(odom) >= 10, 'odometry')
    assert len(changed) > 2 * len(odom)


def test_the_shortest_timeout_is_not_for_ever(ros):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'cmd_vel_timeout': 1e-10})
    ros.talk(Twist, 'cmd_vel').publish(twist(1.0, 0.0))
    ros.until(lambda: len(applied) == 2 and odom, 'the stop')
    assert applied[1].twist == Twist()


def test_heading_and_pose_stay_sound_over_many_commands(ros, sim_time):
    odom, applied = ros.listen(Odometry, 'odom'), ros.listen(TwistStamped, 'cmd_vel_out')
    ros.add(VirtualRobot, parameters={'use_sim_time': True, 'publish_rate': 1.0})
    commands = ros.talk(Twist, 'cmd_vel')
    sim_time.set(SECOND)
    random = np.random.default_rng(4)
    for index in range(500):
        commands.publish(twist(*random.uniform(-1000, 1000, 2)))
        ros.until(lambda index=index: len(applied) > index)
        sim_time.set(sim_time.now + SECOND // 10)
    ros.until(lambda: len(odom) > 40, 'odometry')
    poses = np.array([pose_of(one) for one in odom])
    assert np.all(np.isfinite(poses))
    assert np.all(np.abs(poses[:, 2]) <= math.pi)
