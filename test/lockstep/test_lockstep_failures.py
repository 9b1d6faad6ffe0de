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

"""What goes wrong in a lockstep world is named, with the last messages."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import lru_cache

import pytest
import rclpy.wait_for_message
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rclpy.task import Future
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger
from support.lockstep_nodes import make
from support.ros_messages import goal
from users_nodes import Blinker, Echo

from diffdrive_jacobian.control import Controller
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.testing import Lockstep, LockstepError

pytestmark = pytest.mark.slow


@pytest.fixture
def impatient():
    # The first message to a log looks for the files of all modules, which may take longer.
    get_logger('test').debug('')
    with Lockstep(patience=0.5) as world:
        yield world


def fails(words):
    return pytest.raises(LockstepError, match=words)


def never():
    return False


def forever():
    while True:
        pass


# --- Conditions and errors


def test_a_condition_that_is_never_true_is_named_with_the_last_messages(lockstep):
    lockstep.add(Echo('parrot', 'a', 'b'))
    assert '  /a: no message; subscribed by /parrot' in lockstep.report().splitlines()
    lockstep.publish('a', Vector3(x=0.5))
    with pytest.raises(LockstepError) as caught:
        lockstep.run_until(lambda: False, timeout=3.0, what='pigs fly')
    first, *rest = str(caught.value).splitlines()
    assert first == 'not within 3 s of simulated time: pigs fly'
    assert rest[0] == 'last messages, at 4 s of the clock, 3 s after the start:'
    assert '  /b: 1 from /parrot, last at 1 s: Vector3(x=0.5)' in rest
    with fails(r'condition .*never \(.*test_lockstep_failures.py:\d+\)'):
        lockstep.run_until(never, timeout=0.1)


def test_what_a_callback_raises_fails_the_test_with_its_traceback(lockstep):
    def on_tick():
        raise ZeroDivisionError('in a tick')

    def on_message(_):
        raise KeyError('in a message')

    async def on_question(_):
        raise ValueError('in a coroutine')

    lockstep.node.create_timer(0.1, on_tick)
    lockstep.node.create_subscription(Vector3, 'a', on_message, 10)
    lockstep.node.create_subscription(Vector3, 'b', on_question, 10)
    for error, use in (
        (ZeroDivisionError, lambda: lockstep.run_for(1.0)),
        (KeyError, lambda: lockstep.publish('a', Vector3())),
        (ValueError, lambda: lockstep.publish('b', Vector3())),
    ):
        with pytest.raises(error, match='in a ') as caught:
            use()
        assert caught.traceback[-1].name.startswith('on_')


# --- Callbacks that do not return


class Called:
    def __call__(self):
        forever()


@pytest.mark.parametrize(
    ('callback', 'name'),
    [
        (lambda: time.sleep(1000), '<lambda>'),
        (threading.Event().wait, 'Event.wait'),
        (Called(), 'Called.__call__'),
        (lru_cache(forever), 'forever'),
    ],
)
def test_a_callback_that_blocks_is_named(impatient, callback, name):
    impatient.add(Echo('innocent', 'a', 'b'))
    impatient.add(Node('blocking')).create_timer(0.1, callback)
    with pytest.raises(LockstepError) as caught:
        impatient.run_for(0.3)
    first = str(caught.value).splitlines()[0]
    assert first.startswith('at 1.1 s: ')
    assert f'{name} (timer of 0.1 s, node /blocking' in first
    assert 'has not returned for 0.5 s of wall time; it is at ' in first
    assert 'innocent' not in first


def test_a_law_that_loops_is_named_with_its_node(impatient):
    """All subscriptions of our nodes share the code of one decoder."""
    impatient.add(make(VirtualRobot))
    law = Controller(name='loops', summary='never returns', law=lambda *_: forever())
    impatient.add(GoToGoal(controller=law))
    impatient.publish('goal_pose', goal(1.0, 0.0))
    with fails(r'GoToGoal._on_odometry \(subscribed to /odom, node /go_to_goal'):
        impatient.run_for(1.0)


def test_a_jump_callback_that_blocks_is_named(impatient):
    threshold = JumpThreshold(
        min_forward=Duration(seconds=1.0), min_backward=None, on_clock_change=False
    )
    clock = impatient.add(Node('jumping')).get_clock()
    handle = clock.create_jump_callback(threshold, pre_callback=forever)
    with fails(r'forever \(.*test_lockstep_failures.py.*has not returned'):
        impatient.jump(5.0)
    handle.unregister()


def test_endless_callbacks_are_named(impatient):
    impatient.add(Echo('ping', 'a', 'b'))
    impatient.add(Echo('pong', 'b', 'a'))
    with fails('callbacks without end: for') as caught:
        impatient.publish('a', Vector3())
    first, *rest = str(caught.value).splitlines()
    assert 'Echo.on_message (subscribed to /a, node /ping' in first
    assert 'Echo.on_message (subscribed to /b, node /pong' in first
    assert any('/a: ' in line and 'from /pong' in line for line in rest)


def test_a_world_and_its_tasks_continue_after_a_failure(impatient):
    gate, passed = Future(), []

    async def stuck():
        forever()

    async def waiting():
        passed.append(await gate)

    impatient.node.executor.create_task(stuck)
    impatient.node.executor.create_task(waiting)
    with fails('stuck'):
        impatient.settle()
    gate.set_result(1)
    blinker = impatient.add(Blinker())
    impatient.run_for(1.0)
    assert passed == [1]
    assert len(blinker.ticks) >= 100


@pytest.mark.parametrize('period', [0.0, 9e-7])
def test_a_timer_that_would_stop_the_time_is_refused(lockstep, period):
    lockstep.node.create_timer(period, lambda: None)
    with fails(rf'/lockstep has a period of {period * 1e9:.0f} ns; .* 1000'):
        lockstep.run_for(1.0)


# --- Callbacks that wait for what cannot come


def call_and_catch_everything(client):
    with suppress(BaseException):
        client.call(Trigger.Request())


def poll_by_a_function(client):
    future, end = client.call_async(Trigger.Request()), time.monotonic() + 0.3

    def ready():
        return future.done()

    while not ready() and time.monotonic() < end:
        time.sleep(0.01)


def poll_result(client):
    future, end = client.call_async(Trigger.Request()), time.monotonic() + 0.3
    while future.result() is None and time.monotonic() < end:
        time.sleep(0.01)


def wait_for_an_event(client):
    event = threading.Event()
    client.call_async(Trigger.Request()).add_done_callback(lambda _: event.set())
    event.wait(0.1)


@pytest.mark.parametrize(
    ('wait', 'how'),
    [
        (call_and_catch_everything, r'\(client.call\)'),
        (poll_by_a_function, r'\(future.done\)'),
        (poll_result, r'\(future.result\)'),
        (wait_for_an_event, 'until a timeout'),
    ],
)
def test_a_callback_that_waits_for_a_response_is_named_also_with_a_timeout(lockstep, wait, how):
    node = lockstep.add(Node('waiting'))
    client = node.create_client(Trigger, 'other')
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)
    node.create_timer(0.1, lambda: wait(client))
    with fails(
        rf'at 1.1 s: node /waiting waits for a response of /other {how}, in ({wait.__name__}|ready) '
        r'\(.*test_lockstep_failures.py:\d+\): it cannot arrive'
    ):
        lockstep.run_for(0.3)


def test_other_waits_in_callbacks_are_named(lockstep):
    """Each would end in silence, or never."""
    node, helper = lockstep.add(Node('waiting')), Node('helper')
    client = helper.create_client(Trigger, 'other')
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)

    def spin():
        rclpy.spin_until_future_complete(helper, client.call_async(Trigger.Request()), timeout_sec=0.2)

    for wait, words in (
        (spin, 'node /helper waits for a response of /other'),
        (lambda: node.create_rate(10.0).sleep(), 'a callback sleeps by a rate, in <lambda>'),
        (
            lambda: wait_for_message(Float64, node, 'value', time_to_wait=0.2),
            'wait_for_message waits for a message, in <lambda>',
        ),
        (
            lambda: node.get_clock().sleep_for(Duration(seconds=1.0)),
            'node /waiting sleeps on its clock within a callback',
        ),
    ):
        timer = node.create_timer(0.1, wait)
        with fails(words):
            lockstep.run_for(0.3)
        node.destroy_timer(timer)


def test_callbacks_and_the_test_may_look_whether_a_response_has_come(lockstep):
    node, seen = lockstep.add(Node('looking')), []
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)
    client, futures = node.create_client(Trigger, 'other'), []

    def tick():
        futures.append(client.call_async(Trigger.Request()))
        seen.append(any(futures[0].done() for _ in range(3)))

    node.create_timer(0.1, tick)
    lockstep.run_for(0.25)
    assert seen == [False, True]


def test_each_callback_and_the_test_may_look_on_their_own(lockstep):
    """Not one of them waits, however many look at one time."""
    node, seen = lockstep.add(Node('looking')), []
    client = node.create_client(Trigger, 'never_there')
    future = client.call_async(Trigger.Request())
    node.create_subscription(Vector3, 'a', lambda _: seen.append(future.done()), 10)
    for _ in range(10):
        lockstep.publish('a', Vector3())
        assert not future.done()
        assert future.result() is None
    assert seen == 10 * [False]
    with fails('of /never_there would never return: time passes'):
        client.call(Trigger.Request())
    waited = threading.Event().wait(0.001)
    assert not waited


def test_rclpy_is_as_before_when_the_world_has_ended():
    before = rclpy.wait_for_message.SignalHandlerGuardCondition
    with Lockstep():
        assert rclpy.wait_for_message.SignalHandlerGuardCondition is not before
        assert Publisher.publish.__module__ != 'rclpy.publisher'
    assert rclpy.wait_for_message.SignalHandlerGuardCondition is before
    assert Publisher.publish.__module__ == 'rclpy.publisher'


# --- The report


def test_the_report_shortens_messages(lockstep):
    lockstep.listen(Odometry, 'odom')
    message = Odometry()
    message.header.stamp.sec, message.header.frame_id = 3, 'odom'
    message.pose.covariance[7] = 1.0
    message.twist.twist.linear.x = 1.0 / 3.0
    lockstep.publish('odom', message)
    assert (
        "Odometry(header.stamp=3 s, header.frame_id='odom', pose.pose.orientation.w=1, "
        'pose.covariance=[0, 0, 0, 0, ... 36 in all], twist.twist.linear.x=0.333333)'
    ) in lockstep.report()


def test_the_report_has_what_was_published_before_a_node_was_added_but_not_what_was_not_sent(lockstep):
    early = Node('early')
    early.create_publisher(Vector3, 'map', 10).publish(msg=Vector3(x=1.0))
    lockstep.add(early)
    assert '  /map: 1 from /early, last at 1 s: Vector3(x=1)' in lockstep.report().splitlines()
    inactive = lockstep.add(LifecycleNode('sleepy')).create_lifecycle_publisher(Vector3, 'a', 10)
    inactive.publish(Vector3())
    publisher = lockstep.node.create_publisher(Vector3, 'b', 10)
    publisher.publish(Vector3(x=2.0))
    with pytest.raises(TypeError):
        publisher.publish('b')
    assert '/a' not in lockstep.report()
    assert '/b: 1 from /lockstep, last at 1 s: Vector3(x=2)' in lockstep.report()


def test_the_report_has_bytes_and_values_that_messages_do_not_allow(lockstep):
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    heard = lockstep.listen(Vector3, 'a')
    message = Vector3()
    # As `message.x = 1` without the checks of rclpy, which are on in these tests.
    message._x = 1
    publisher.publish(message)
    lockstep.settle()
    # What was received depends on the version of Python.
    assert f'Vector3(x={heard[0].x})' in lockstep.report()
    publisher.publish(serialize_message(Vector3(x=0.5)))
    assert 'last at 1 s: Vector3(x=0.5)' in lockstep.report()
    publisher.publish(b'\0\1')
    assert 'last at 1 s: 2 serialized bytes' in lockstep.report()
    publisher, message = lockstep.node.create_publisher(Header, 'b', 10), Header(frame_id='odom')
    publisher.publish(message)
    message._stamp = None
    assert "frame_id='odom'" in lockstep.report()


def test_last_is_the_last_message_of_all_publishers(lockstep):
    one, two = (lockstep.node.create_publisher(Vector3, 'a', 10) for _ in range(2))
    for publisher, x in ((one, 1.0), (two, 2.0), (one, 3.0)):
        publisher.publish(Vector3(x=x))
        assert lockstep.last('a').x == x
    two.publish(serialize_message(Vector3(x=4.0)))
    assert lockstep.last('/a') == Vector3(x=4.0)
    with fails('no message was published on /b\n'):
        lockstep.last('b')
