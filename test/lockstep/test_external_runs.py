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

"""Drives of nodes in processes: faults, the same result each time, their start and end."""

from __future__ import annotations

import math
import signal
import sys
from collections import Counter

import pytest
from external_calls import SECOND, command, numbers, send, stamp
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import Float64, Header, String
from support.processes import PROGRAM

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.faults import Corrupt, Delay, Hang, Kill, Loss, Slow
from diffdrive_jacobian.lockstep.external import node_process
from diffdrive_jacobian.lockstep.external.discovery import Discovery
from diffdrive_jacobian.lockstep.external.graph import NodeGraph
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.testing import Lockstep, LockstepError, check_repeats

pytestmark = pytest.mark.process

VIRTUAL_ROBOT, GO_TO_GOAL = (
    [sys.executable, '-c', PROGRAM.format(name)] for name in ('virtual_robot', 'go_to_goal')
)
QUICK = ['--ros-args', '-p', 'kp:=24.0', '-p', 'kv:=12.0']


# --- Faults


def test_faults_affect_both_directions_and_all_is_recorded(lockstep, recorded_run):
    lockstep.start(command('echo'), queue_depth=2, clock_period=0.07)
    received, times = [], []
    answers = lockstep.listen(Header, 'echo/out')
    robot = Node('robot')
    robot.create_subscription(Header, 'echo/out', received.append, 10)
    lockstep.add(robot)
    lockstep.on_published('echo/out', lambda *_: times.append(round(lockstep.elapsed, 3)))
    lockstep.inject(
        Loss('echo/in', start=0.2, duration=0.2),
        Corrupt('echo/in', 'data', 'negate', start=0.5, duration=0.1),
        Loss('echo/out', start=0.7, duration=0.1),
        Delay('echo/in', 0.05, start=1.0, duration=0.1),
        Hang('echo', start=1.1, duration=0.2),
        Slow('echo', 0.03, start=1.5, duration=0.2),
    )
    for number in range(18):
        send(lockstep, 'echo', number)
        lockstep.run_for(0.1)
    answered = [0, 1, 4, -5, *range(6, 18)]
    assert numbers(answers) == answered
    assert numbers(received) == [number for number in answered if number != 7]
    before = [number / 10 for number in range(10) if number not in (2, 3)]
    assert times == [*before, 1.05, 1.3, 1.3, 1.3, 1.4, 1.53, 1.63, 1.7]
    recorded_run.finish()
    with open_bag(recorded_run.bag) as bag:
        counts = Counter(connection.topic for connection, _, _ in bag.messages())
    assert (counts['/echo/in'], counts['/echo/out']) == (18, 16)


def test_a_process_is_killed_and_started_again(lockstep):
    process = lockstep.start(command('ticker'))
    received = lockstep.listen(Header, 'ticker/out')
    publisher = lockstep.node.create_publisher(Float64, 'ticker/in', 10)
    lockstep.node.create_timer(0.05, lambda: publisher.publish(Float64()))
    before = process.pid
    lockstep.inject(Kill('ticker', start=0.22, duration=0.2), Kill('ticker', start=0.6, duration=0.1))
    lockstep.run_for(0.3)
    assert process.returncode == -signal.SIGKILL
    with pytest.raises(LockstepError, match='there is no node /ticker'):
        lockstep.find('ticker')
    lockstep.run_for(0.25)
    assert process.pid != before
    assert lockstep.find('ticker') is process.nodes[0]
    # Without its memory.
    ticks = [(round((stamp(one) - SECOND) / SECOND, 3), float(one.frame_id)) for one in received]
    assert [time for time, _ in ticks[:4]] == [0.05, 0.1, 0.15, 0.2]
    assert ticks[4][0] >= 0.42
    assert ticks[4][1] == 0.0
    # Not again if the test stops it meanwhile.
    lockstep.run_for(0.08)
    process.stop()
    lockstep.run_for(0.2)
    assert 'ticker' not in [node.get_name() for node in lockstep.nodes]


# --- As in the same process, and the same each time


def drive(world):
    """Drive to a goal, with a robot and a controller that are there. Return the odometry."""
    received = world.listen(Odometry, 'odom')
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = 0.3, 0.2, 1.0
    world.publish('goal_pose', goal)
    world.run_for(1.2)
    return received


def test_a_robot_and_a_controller_in_processes_drive_as_in_the_same_one(lockstep):
    lockstep.start(VIRTUAL_ROBOT)
    controller = lockstep.start([*GO_TO_GOAL, *QUICK])
    received = drive(lockstep)
    position = received[-1].pose.pose.position
    assert math.dist((position.x, position.y), (0.3, 0.2)) < 0.05
    controller.kill()
    with pytest.raises(LockstepError, match='no node'):
        lockstep.find('go_to_goal')
    lockstep.close()
    with Lockstep(QUICK) as isolated:
        isolated.add(VirtualRobot())
        isolated.add(GoToGoal())
        assert received == drive(isolated)


def test_several_threads_and_executors_do_the_same_each_time():
    names = ('ticker', 'waiting', 'echo')

    def run(world):
        world.start(command(*names, 'threads'))
        publishers = []
        for name in names:
            publishers.append(world.node.create_publisher(Float64, f'{name}/in', 10))
            world.listen(Header, f'{name}/out')

        def tick():
            for publisher in publishers:
                publisher.publish(Float64(data=1.0 + len(names) * world.elapsed))

        world.node.create_timer(0.02, tick)
        world.run_for(0.2)
        assert 'echo/out: 10 from /echo' in world.report()

    check_repeats(run)


# --- Start and end


def test_rules_of_the_user_stay_and_a_last_message_is_received(lockstep):
    rules = ['--ros-args', '-r', 'echo/in:=pose', '-r', '__ns:=/left', '-r', '/clock:=/sim/clock']
    process = lockstep.start([*command('echo', 'polite'), *rules])
    assert process.nodes[0].get_fully_qualified_name() == '/left/echo'
    received = lockstep.listen(Header, '/left/echo/out')
    lockstep.run_for(0.1)
    lockstep.publish('/left/pose', Float64(data=3.0))
    assert stamp(received[0]) == lockstep.now
    assert process.stop() == 0
    lockstep.settle()
    assert numbers(received) == [3.0, -9.0]
    assert process.nodes == []


INTERRUPTED = """
import time

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node('interrupted')
publisher = node.create_publisher(String, 'last', 10)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    publisher.publish(String(data='last'))
    # If it ended at once, its end might be discovered before the message is received.
    time.sleep(0.5)
"""


def test_a_program_that_waits_is_woken_up_to_be_interrupted(lockstep):
    process = lockstep.start([sys.executable, '-c', INTERRUPTED])
    last = lockstep.listen(String, 'last')
    assert process.stop() == 0
    lockstep.settle()
    assert [one.data for one in last] == ['last']


def test_a_process_whose_endpoints_are_not_matched_is_started_again(lockstep, monkeypatch):
    """One that ends without an error leaves the world."""
    matched = Discovery.is_matched
    started = []

    def match_at_the_second_start(discovery):
        pid = discovery.domain.child.pid
        if pid not in started:
            started.append(pid)
        return len(started) > 1 and matched(discovery)

    monkeypatch.setattr(Discovery, 'is_matched', match_at_the_second_start)
    monkeypatch.setattr(node_process, 'MATCHING', 0.1)
    process = lockstep.start(command('mortal'))
    assert process.pid == started[1]
    send(lockstep, 'mortal', 0.0)
    assert process.returncode == 0
    lockstep.run_for(0.1)
    assert process.nodes == []


def test_only_what_was_remapped_has_another_name_in_the_world():
    node = NodeGraph('node', '/', {}, {}, {}, {})
    for topic, name in (
        ('/node/lockstep/clock', '/clock'),
        ('/node/lockstep_state', '/node/lockstep_state'),
        ('/node/lockstep', '/node/lockstep'),
        ('/other/lockstep/clock', '/other/lockstep/clock'),
    ):
        assert node.name_in_world(topic) == name
