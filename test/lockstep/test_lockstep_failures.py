"""What goes wrong in a lockstep world is named."""

from __future__ import annotations

import threading
import time

import pytest
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from std_srvs.srv import Trigger
from users_nodes import Blinker, Echo

from diffdrive_jacobian.testing import Lockstep, LockstepError


@pytest.fixture
def impatient():
    with Lockstep(patience=0.5) as world:
        yield world


def test_condition_that_is_never_true_is_named_with_the_last_messages(lockstep):
    lockstep.add(Echo('parrot', 'a', 'b'))
    lockstep.publish('a', Vector3(x=0.5))
    with pytest.raises(LockstepError) as caught:
        lockstep.run_until(lambda: False, timeout=3.0, what='pigs fly')
    first, *rest = str(caught.value).splitlines()
    assert first == 'not within 3 s of simulated time: pigs fly'
    assert rest[0] == 'last messages, at 4 s of the clock, 3 s after the start:'
    assert '  /b: 1 from /parrot, last at 1 s: Vector3(x=0.5)' in rest
    with pytest.raises(LockstepError, match=r'condition .*never \(.*test_lockstep_failures.py:\d+\)'):
        lockstep.run_until(never, timeout=0.1)


def never():
    return False


def test_report_contains_topics_without_messages(lockstep):
    lockstep.add(Echo('parrot', 'a', 'b'))
    assert '  /a: no message; subscribed by /parrot' in lockstep.report().splitlines()


def test_report_shortens_messages(lockstep):
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
    with pytest.raises(ZeroDivisionError, match='in a tick') as caught:
        lockstep.run_for(1.0)
    assert caught.traceback[-1].name == 'on_tick'
    with pytest.raises(KeyError, match='in a message') as caught:
        lockstep.publish('a', Vector3())
    assert caught.traceback[-1].name == 'on_message'
    with pytest.raises(ValueError, match='in a coroutine') as caught:
        lockstep.publish('b', Vector3())
    assert caught.traceback[-1].name == 'on_question'


class Blocking(Node):
    def __init__(self, wait):
        super().__init__('blocking')
        self.wait = wait
        self.create_subscription(Vector3, 'a', self.on_message, 10)
        self.create_timer(0.1, self.on_tick)

    def on_message(self, message):
        pass

    def on_tick(self):
        self.wait()


def forever():
    while True:
        pass


@pytest.mark.parametrize('wait', [lambda: time.sleep(1000), threading.Event().wait, forever])
def test_callback_that_blocks_is_named(impatient, wait):
    impatient.add(Echo('innocent', 'a', 'b'))
    begun = time.monotonic()
    with pytest.raises(LockstepError) as caught:
        impatient.add(Blocking(wait))
    assert time.monotonic() - begun < 60.0
    first = str(caught.value).splitlines()[0]
    assert first.startswith('at 1 s: Blocking.on_tick (timer of 0.1 s, node /blocking, ')
    assert 'has not returned for 0.5 s of wall time; it is at ' in first
    assert 'innocent' not in first


def test_service_that_calls_another_and_waits_is_named(impatient):
    node = Node('deadlocked')
    client = node.create_client(Trigger, 'other')
    impatient.node.create_service(Trigger, 'other', lambda _, response: response)
    node.create_service(Trigger, 'ask', lambda request, _: client.call(request))
    impatient.add(node)
    with pytest.raises(LockstepError, match=r'service /ask, node /deadlocked.* in wait'):
        impatient.call(Trigger, 'ask')


def test_endless_callbacks_are_named(impatient):
    impatient.add(Echo('ping', 'a', 'b'))
    impatient.add(Echo('pong', 'b', 'a'))
    with pytest.raises(LockstepError, match='callbacks without end: for') as caught:
        impatient.publish('a', Vector3())
    first, *rest = str(caught.value).splitlines()
    assert 'Echo.on_message (subscribed to /a, node /ping' in first
    assert 'Echo.on_message (subscribed to /b, node /pong' in first
    assert any('/a: ' in line and 'from /pong' in line for line in rest)


def test_timer_without_a_period_is_named(impatient):
    impatient.node.create_timer(0.0, lambda: None)
    with pytest.raises(LockstepError, match=r'callbacks without end: .*timer of 0 s, node /lockstep'):
        impatient.run_for(1.0)


def test_lockstep_continues_after_a_failure(impatient):
    blocking = impatient.node.create_timer(0.1, lambda: time.sleep(1000))
    with pytest.raises(LockstepError):
        impatient.run_for(1.0)
    impatient.node.destroy_timer(blocking)
    blinker = impatient.add(Blinker())
    impatient.run_for(1.0)
    assert len(blinker.ticks) >= 100


def test_tasks_outlive_the_failure_of_another(impatient):
    gate, passed = Future(), []

    async def stuck():
        forever()

    async def waiting():
        passed.append(await gate)

    impatient.node.executor.create_task(stuck)
    impatient.node.executor.create_task(waiting)
    with pytest.raises(LockstepError, match='stuck'):
        impatient.settle()
    gate.set_result(1)
    impatient.settle()
    assert passed == [1]


def test_callback_that_sleeps_on_its_clock_is_named(lockstep):
    node = lockstep.add(Node('sleeper'))
    node.create_timer(0.1, lambda: node.get_clock().sleep_for(Duration(seconds=1.0)))
    with pytest.raises(LockstepError, match='node /sleeper sleeps on its clock within a callback'):
        lockstep.run_for(0.3)


class Early(Node):
    """It speaks before anybody can hear it."""

    def __init__(self):
        super().__init__('early')
        self.publisher = self.create_publisher(Vector3, 'map', 10)
        self.publisher.publish(msg=Vector3(x=1.0))


def test_report_tells_what_was_said_before_the_node_was_added(lockstep):
    lockstep.add(Early())
    assert '  /map: 1 from /early, last at 1 s: Vector3(x=1)' in lockstep.report().splitlines()


def test_report_tells_only_what_was_sent(lockstep):
    node = lockstep.add(LifecycleNode('sleepy'))
    publisher = node.create_lifecycle_publisher(Vector3, 'a', 10)
    publisher.publish(Vector3())
    lockstep.settle()
    assert '/a' not in lockstep.report()


def test_publishing_is_counted_only_while_a_world_is_open(lockstep):
    lockstep.close()
    assert Publisher.publish.__module__ == 'rclpy.publisher'
