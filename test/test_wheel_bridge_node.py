"""The node wheel_bridge: twists in, wheel speeds out, in the order and the shape that motors take."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.parameter import Parameter
from ros_messages import stamp, twist, twist_stamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.ros import node as ros_node

R, L = 0.033, 0.16


def test_golden_wheel_speeds_of_document_a(ros, executor_kind):
    out = ros.listen(JointState, 'joint_command')
    ros.add(WheelBridge)
    ros.talk(Twist, 'cmd_vel').publish(twist(0.5, 3.0 * math.pi / 4.0))
    ros.until(lambda: out, 'wheel speeds')
    assert list(out[0].name) == ['left_wheel_joint', 'right_wheel_joint']
    assert [round(speed, 3) for speed in out[0].velocity] == [9.440, 20.864]
    assert out[0].header.stamp.sec > 0


def test_multi_array_holds_left_and_right(ros):
    out = ros.listen(Float64MultiArray, 'joint_command')
    ros.add(WheelBridge, parameters={'joint_command_type': 'Float64MultiArray'})
    ros.talk(Twist, 'cmd_vel').publish(twist(0.5, 3.0 * math.pi / 4.0))
    ros.until(lambda: out, 'wheel speeds')
    assert [round(speed, 3) for speed in out[0].data] == [9.440, 20.864]


def test_calibration_acts_on_each_wheel(ros):
    out = ros.listen(JointState, 'joint_command')
    ros.add(
        WheelBridge,
        parameters={
            'wheel_separation_multiplier': 1.5,
            'left_wheel_radius_multiplier': 1.1,
            'right_wheel_radius_multiplier': 0.9,
            'left_wheel_name': 'l',
            'right_wheel_name': 'r',
        },
    )
    ros.talk(Twist, 'cmd_vel').publish(twist(0.2, 1.0))
    ros.until(lambda: out, 'wheel speeds')
    rim = 1.0 * 1.5 * L / 2.0
    speeds = dict(zip(out[0].name, out[0].velocity, strict=True))
    assert speeds == pytest.approx({'l': (0.2 - rim) / (1.1 * R), 'r': (0.2 + rim) / (0.9 * R)})


def test_limit_slows_both_wheels_alike(ros):
    out = ros.listen(JointState, 'joint_command')
    node = ros.add(WheelBridge, parameters={'max_wheel_velocity': 6.0})
    commands = ros.talk(Twist, 'cmd_vel')
    commands.publish(twist(0.5, -2.0))
    ros.until(lambda: out, 'wheel speeds')
    left, right = out[0].velocity
    assert left == pytest.approx(6.0, rel=1e-12)
    assert right / left == pytest.approx((0.5 - L) / (0.5 + L), rel=1e-12)
    assert node.set_parameters([Parameter('max_wheel_velocity', value=math.nan)])[0].successful
    commands.publish(twist(0.5, -2.0))
    ros.until(lambda: len(out) == 2, 'wheel speeds without a limit')
    assert out[1].velocity[0] == pytest.approx((0.5 + L) / R)


def test_silence_stops_the_wheels_once(ros, sim_time, capfd):
    out = ros.listen(JointState, 'joint_command')
    ros.add(WheelBridge, parameters={'use_sim_time': True, 'enable_stamped_cmd_vel': True})
    commands = ros.talk(TwistStamped, 'cmd_vel')
    sim_time.set(10_000_000_000)
    commands.publish(twist_stamped(0.2, 0.0, sim_time.now))
    ros.until(lambda: len(out) == 1, 'wheel speeds')
    assert out[0].header.stamp == stamp(sim_time.now)
    sim_time.advance(0.4)
    commands.publish(twist_stamped(0.1, 0.0, sim_time.now))
    ros.until(lambda: len(out) == 2, 'wheel speeds')
    sim_time.advance(0.48)
    assert len(out) == 2
    sim_time.advance(3.0)
    ros.until(lambda: len(out) == 3, 'the stop')
    assert list(out[2].velocity) == [0.0, 0.0]
    commands.publish(twist_stamped(0.3, 0.0, sim_time.now))
    ros.until(lambda: len(out) == 4, 'it goes on')
    assert out[3].velocity[0] == pytest.approx(0.3 / R)
    assert 'no command on /cmd_vel for 0.5 s' in capfd.readouterr().err


def test_rubbish_and_old_commands_are_dropped(ros, sim_time, capfd):
    out = ros.listen(JointState, 'joint_command')
    ros.add(WheelBridge, parameters={'use_sim_time': True, 'enable_stamped_cmd_vel': True})
    commands = ros.talk(TwistStamped, 'cmd_vel')
    now = 10_000_000_000
    sim_time.set(now)
    for v, at in [(math.nan, now), (1e4, now), (0.1, now + 1), (0.2, now - 500_000_001)]:
        commands.publish(twist_stamped(v, 0.0, at))
    commands.publish(twist_stamped(0.3, 0.0, now - 5))
    commands.publish(twist_stamped(0.4, 0.0, now - 6))
    commands.publish(twist_stamped(0.5, 0.0, 0))
    ros.until(lambda: out and out[-1].velocity[0] == pytest.approx(0.5 / R), 'the last one')
    assert [one.velocity[0] * R for one in out] == pytest.approx([0.3, 0.5])
    assert 'command dropped: twist must be finite' in capfd.readouterr().err
    # Time that goes back makes the old instants mean nothing.
    sim_time.set(now // 2)
    commands.publish(twist_stamped(0.6, 0.0, now // 2))
    ros.until(lambda: len(out) == 3, 'a command on the new time line')


def test_stop_leaves_the_wheels_standing(ros):
    out = ros.listen(JointState, 'joint_command')
    node = ros.add(WheelBridge)
    node.stop('the test says so')
    ros.talk(Twist, 'cmd_vel').publish(twist(0.2, 0.0))
    ros.until(lambda: len(out) == 1, 'wheel speeds')
    node.stop('the test says so')
    ros.until(lambda: len(out) == 2, 'the stop')
    assert list(out[1].velocity) == [0.0, 0.0]


def test_without_a_clock_nothing_moves(ros, capfd, monkeypatch):
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.05)
    out = ros.listen(JointState, 'joint_command')
    node = ros.add(WheelBridge)
    commands = ros.talk(Twist, 'cmd_vel')
    commands.publish(twist(0.2, 0.0))
    ros.until(lambda: len(out) == 1, 'wheel speeds')
    # Switched to simulated time while the wheels turn: no timeout would ever strike.
    assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    ros.until(lambda: len(out) == 2, 'the stop')
    assert list(out[1].velocity) == [0.0, 0.0]
    commands.publish(twist(0.2, 0.0))
    ros.until_said(capfd, 'command dropped: simulated time has not begun')
    assert len(out) == 2
