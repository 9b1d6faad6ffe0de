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

"""Misuse of a lockstep world is named."""

from __future__ import annotations

import re
import sys
import threading

import pytest
import rclpy
from geometry_msgs.msg import Twist, TwistStamped, Vector3
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Empty, Trigger
from support.lockstep_nodes import make
from users_nodes import Blinker, Echo

from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.testing import Lockstep, LockstepError

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def refused(words, error=LockstepError):
    return pytest.raises(error, match=words)


def in_a_thread(function):
    thread = threading.Thread(target=function, name='worker')
    thread.start()
    thread.join()


# --- Arguments


def test_invalid_times_are_refused(lockstep):
    for seconds in (0.0, -1.0, float('nan'), float('inf'), 1e-10, 1e10):
        words = rf'must be in \[1e-09, 2147483647\] s, got {re.escape(str(seconds))}'
        for advance in (lockstep.run_for, lockstep.step):
            with refused(words, ValueError):
                advance(seconds)
        with refused('timeout must be', ValueError):
            lockstep.run_until(bool, timeout=seconds)
    for seconds, words in (
        (0.0, 'not zero'),
        (-1.0, 'a time after 0'),
        (float('nan'), 'nan'),
        ('x', "finite and not zero, got 'x'"),
    ):
        with refused(words, ValueError):
            lockstep.jump(seconds)
    assert lockstep.elapsed == 0.0


def test_arguments_of_a_wrong_kind_are_refused(lockstep):
    lockstep.node.create_service(Trigger, 'ask', lambda _, response: response)
    for method, arguments, words in (
        (lockstep.add, (Blinker,), 'add takes a node, got the class Blinker; create one'),
        (lockstep.add, ('blinker',), "add takes a node, got 'blinker'"),
        (lockstep.listen, ('twist', Twist), "a type and a topic, got 'twist' and the class Twist"),
        (lockstep.publish, (Vector3(), 'a'), "a message, got an object of the class Vector3 and 'a'"),
        (lockstep.publish, ('a', Vector3), "a message, got 'a' and the class Vector3"),
        (lockstep.publish, ('a', b''), 'class bytes; serialized messages: node.create_publisher'),
        (lockstep.publish, ('a', bytearray()), 'class bytearray; serialized messages: '),
        (lockstep.last, (Vector3,), 'last takes a topic, got the class Vector3'),
        (lockstep.find, (None,), 'find takes the name of a node'),
        (lockstep.call, (Trigger, 'ask', Trigger), 'a request of /ask must be a std_srvs/srv/'),
    ):
        with refused(words):
            method(*arguments)
    with refused('condition must be a function, got True', ValueError):
        lockstep.run_until(True, 1.0)


def test_invalid_arguments_of_a_world_are_refused(lockstep):
    with refused('another Lockstep is open in this process'):
        Lockstep()
    lockstep.close()
    for wrong in ({'start': 0.0}, {'start': -1.0}, {'patience': 0.0}):
        with refused(r'must be in \[1e-09, 2147483647\] s', ValueError):
            Lockstep(**wrong)
    with refused('ROS arguments'):
        Lockstep(['--ros-args', '--no-such-option'])
    with refused("args must begin with '--ros-args', got '-p'"):
        Lockstep(['-p', 'side:=0.5'])
    rclpy.init()
    try:
        with refused('rclpy is already initialized'):
            Lockstep()
    finally:
        rclpy.shutdown()
    with Lockstep() as world:
        world.add(Blinker())


def test_a_world_is_of_the_main_thread(lockstep):
    failures = []

    def use(function):
        try:
            function()
        except LockstepError as error:
            failures.append(str(error))

    in_a_thread(lambda: use(lambda: lockstep.run_for(1.0)))
    lockstep.close()
    in_a_thread(lambda: use(Lockstep))
    assert failures == ['Lockstep must be created and used in the main thread'] * 2


def test_a_closed_world_cannot_be_used(lockstep):
    blinker = lockstep.add(Blinker())
    lockstep.close()
    lockstep.close()
    for use in (
        lambda: lockstep.run_for(1.0),
        lambda: lockstep.step(),
        lambda: lockstep.add(blinker),
        lambda: lockstep.publish('a', Vector3()),
        lambda: lockstep.jump(1.0),
    ):
        with refused('this Lockstep is closed'):
            use()


def test_use_within_a_callback_is_refused_but_for_publishing(lockstep):
    heard = lockstep.listen(Vector3, 'a')
    ticking = lockstep.node.create_timer(0.1, lambda: lockstep.publish('a', Vector3()))
    lockstep.run_for(0.2)
    assert len(heard) == 2
    lockstep.node.destroy_timer(ticking)
    node = lockstep.add(Node('other'))
    for call in (
        lambda: lockstep.run_for(0.5),
        lockstep.settle,
        lambda: lockstep.remove(node),
        lambda: lockstep.add(Node('new')),
    ):
        timer = lockstep.node.create_timer(0.1, call)
        with refused('a callback'):
            lockstep.run_for(0.1)
        lockstep.node.destroy_timer(timer)


# --- rclpy


def test_a_second_initialization_and_a_shutdown_are_errors(lockstep):
    """Also for those who expect that of rclpy."""
    for error in (LockstepError, RuntimeError):
        with refused(r'leave out rclpy.init\(\)', error):
            rclpy.init()
    with Context() as other:
        assert other.ok()
    lockstep.node.create_timer(0.1, rclpy.try_shutdown)
    with refused('rclpy was shut down'):
        lockstep.run_for(1.0)
    lockstep.close()
    rclpy.init()
    rclpy.shutdown()


def test_a_node_that_another_executor_spins_is_named(lockstep):
    with refused('node /blinker is in lockstep and cannot be spun'):
        rclpy.spin_once(lockstep.add(Blinker()), timeout_sec=0.0)
    waiting = lockstep.add(Blinker('waiting'))
    waiting.create_timer(0.1, lambda: rclpy.spin_until_future_complete(waiting, Future()))
    with refused(
        r'/waiting is in lockstep and cannot be spun .*awaits the future of call_async.*lockstep\.call'
    ):
        lockstep.run_for(1.0)
    executor = waiting.executor
    # What lockstep does not offer is no attribute, for those who ask whether it is there.
    assert not hasattr(executor, 'spin_once')
    assert getattr(executor, 'context', 'none') == 'none'
    assert hasattr(executor, 'create_task')
    with refused(r'cannot call executor\.spin_once: lockstep executes its callbacks'):
        executor.spin_once()


# --- Nodes


def test_nodes_that_cannot_be_added_are_refused(lockstep):
    blinker = lockstep.add(Blinker())
    wall = Node('wall', parameter_overrides=[Parameter('use_sim_time', value=False)])
    taken, guarded, rival = Node('taken'), Node('guarded'), Node('rival')
    executor = SingleThreadedExecutor()
    executor.add_node(taken)
    guarded.create_guard_condition(print)
    rival.create_publisher(ClockMessage, '/clock', 10)
    with Context() as context:
        stranger = Node('stranger', context=context)
        for node, words in (
            (blinker, 'node /blinker was already added'),
            (stranger, 'node /stranger is in another context'),
            (wall, 'node /wall runs on wall time: its parameter use_sim_time'),
            (taken, 'node /taken is in another executor'),
            (guarded, '/guarded has a guard condition, .* use a timer'),
            (rival, 'node /rival publishes /clock, which only lockstep may do'),
        ):
            with refused(words):
                lockstep.add(node)
            if node is not blinker:
                node.destroy_node()
    executor.shutdown()
    with refused('another node has the name /blinker: give one'):
        lockstep.add(Blinker())
    lockstep.add(Blinker(namespace='other'))


def test_a_node_that_changes_to_wall_time_is_named(lockstep):
    """Between two runs, or within one."""
    node = lockstep.add(Node('changing'))
    node.set_parameters([Parameter('use_sim_time', value=False)])
    with refused('node /changing runs on wall time'):
        lockstep.run_for(1.0)
    node.set_parameters([Parameter('use_sim_time', value=True)])
    lockstep.run_for(1.0)
    node.create_timer(0.1, lambda: node.set_parameters([Parameter('use_sim_time', value=False)]))
    with refused('node /changing runs on wall time'):
        lockstep.run_for(1.0)


def test_a_node_that_was_not_added_is_reported_and_no_reader(lockstep):
    forgotten = Echo('forgotten', 'a', 'b')
    forgotten.create_publisher(Vector3, 'words', 10).publish(Vector3())
    report = lockstep.report().splitlines()
    assert '  created, but not added to lockstep: /forgotten' in report
    assert '  /words: 1 from /forgotten, last at 1 s: Vector3()' in report
    lockstep.listen(Vector3, 'a')
    with refused('/a is subscribed to by /forgotten: created, but not added to lockstep$'):
        lockstep.publish('a', Vector3())
    heard = lockstep.listen(Vector3, 'b')
    lockstep.add(forgotten)
    lockstep.publish('a', Vector3())
    assert len(heard) == 1
    assert 'forgotten' not in lockstep.report().replace('from /forgotten', '')


def test_a_second_node_of_the_same_name_is_named(lockstep):
    forgotten = Echo('twin', 'a', 'b')
    lockstep.add(Echo('twin', 'a', 'b'))
    with refused(r'subscribed to by /twin \(a second node of this name\): created, but not added'):
        lockstep.publish('a', Vector3())
    # The graph loses the name of both.
    forgotten.destroy_node()
    lockstep.publish('a', Vector3())


# --- Topics and services


def test_missing_topics_and_services_and_wrong_types_are_named(lockstep):
    lockstep.listen(Twist, 'cmd_vel')
    with refused('/cmd_vell has no subscription of type geometry_msgs/msg/Twist'):
        lockstep.publish('cmd_vell', Twist())
    wrong = r'/cmd_vel is of type geometry_msgs/msg/Twist, not geometry_msgs/msg/V'
    with refused(wrong):
        lockstep.publish('cmd_vel', Vector3())
    with refused(wrong):
        lockstep.listen(Vector3, 'cmd_vel')
    lockstep.add(Blinker())
    with refused(r'no service /nowhere of type std_srvs/srv/Trigger; services: /blinker/forget$'):
        lockstep.call(Trigger, 'nowhere')
    with refused(r'/forget is of type std_srvs/srv/Trigger, not std_srvs/srv/Empty'):
        lockstep.call(Empty, 'blinker/forget')


def test_a_message_that_does_not_reach_a_latched_subscription_is_an_error(lockstep):
    """Alone, and beside one that it reaches."""
    planner, heard = lockstep.add(Node('planner')), []
    planner.create_subscription(Vector3, 'map', heard.append, LATCHED)
    words = (
        r'/map is subscribed to by /planner with .* reliable, transient local, .*'
        r'reliable, volatile, .* reach it: publish\(..., latched=True\)'
    )
    for _ in range(2):
        with refused(words):
            lockstep.publish('map', Vector3())
    beside = lockstep.listen(Vector3, 'map')
    with refused(words):
        lockstep.publish('map', Vector3())
    lockstep.publish('map', Vector3(x=1.0), latched=True)
    assert heard == beside == [Vector3(x=1.0)]


@pytest.mark.filterwarnings('ignore:the subscription of')
def test_a_quality_of_service_without_a_remedy_is_named(lockstep):
    planner = lockstep.add(Node('planner'))
    short, manual = Duration(seconds=0.1), LivelinessPolicy.MANUAL_BY_TOPIC
    for topic, words, policies in (
        ('often', 'deadline 0.1 s', {'deadline': short}),
        ('alive', 'liveliness manual by topic', {'liveliness': manual}),
        ('leased', 'lease 0.1 s', {'liveliness_lease_duration': short}),
    ):
        profile = QoSProfile(depth=1, **policies)
        planner.create_subscription(Vector3, topic, lambda message: None, profile)
        for latched in (False, True):
            with refused(rf'/{topic} is subscribed to by /planner .*, {words}, and .* not reach it\n'):
                lockstep.publish(topic, Vector3(), latched=latched)


# --- Threads of nodes


class Threaded(Node):
    """Publishes in threads of its own, also while its callback waits for one."""

    def __init__(self, name='threaded', **kwargs):
        super().__init__(name, start_parameter_services=False, **kwargs)
        self.publisher = self.create_publisher(Vector3, 'spectrum', 10)
        self.client = self.create_client(Empty, 'erase')
        self.create_subscription(Twist, 'twist', lambda _: in_a_thread(self.publish), 10)

    def publish(self):
        self.publisher.publish(Vector3())

    def call(self):
        self.client.call_async(Empty.Request())


PUBLISHES = r"node /threaded publishes /spectrum from a thread of its own \('worker'\)"


def test_what_a_node_sends_from_a_thread_of_its_own_is_an_error(lockstep):
    node = lockstep.add(Threaded())
    for use in (
        lambda: lockstep.last('spectrum'),
        lambda: lockstep.run_for(0.1),
        lambda: lockstep.step(0.1),
        lambda: lockstep.finish(),
    ):
        in_a_thread(node.publish)
        with refused(PUBLISHES):
            use()
    in_a_thread(node.call)
    with refused('node /threaded calls or answers /erase from a thread of'):
        lockstep.run_for(0.1)
    # While its callback waits for the thread.
    with refused(PUBLISHES):
        lockstep.publish('twist', Twist())
    node.publish()
    lockstep.run_for(0.1)
    assert lockstep.last('spectrum') == Vector3()


@pytest.mark.filterwarnings('ignore:node /helper was created, but not added')
def test_what_a_node_that_was_not_added_sends_from_a_thread_is_an_error_if_it_is_received(lockstep):
    """A node may be created in a thread, and publish there."""
    created = []

    def create():
        created.append(Threaded('helper'))
        created[0].publish()

    in_a_thread(create)
    lockstep.listen(Vector3, 'spectrum')
    words = r"/helper publishes /spectrum from a thread .*\('worker'\): .* add it with lockstep\.add"
    in_a_thread(created[0].publish)
    with refused(words):
        lockstep.run_for(0.1)
    lockstep.add(created[0])
    lockstep.run_for(0.1)
    in_a_thread(created[0].publish)
    with refused('/helper publishes /spectrum from a thread of its own'):
        lockstep.run_for(0.1)


STAMPED = """
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node

rclpy.init()
node = Node('of_TwistStamped')
node.create_publisher(TwistStamped, 'cmd_vel', 10)
rclpy.spin(node)
"""


@pytest.mark.process
def test_a_controller_of_stamped_twists_beside_a_robot_of_others_is_explained(lockstep):
    lockstep.add(make(VirtualRobot))

    class Stamped(Node):
        def __init__(self):
            super().__init__('stamped')
            self.create_publisher(TwistStamped, 'cmd_vel', 10)

    match = '/cmd_vel cannot have the type geometry_msgs/msg/TwistStamped: .* enable_stamped_cmd_vel'
    for create in (Stamped, lambda: lockstep.create(Stamped)):
        with refused(match):
            create()
    with refused(match):
        lockstep.start([sys.executable, '-c', STAMPED])
