"""What goes wrong in a lockstep world is named, with the last messages."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import lru_cache, wraps

import pytest
import rclpy.wait_for_message
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
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


@pytest.fixture
def impatient():
    # The first message to a log looks for the files of all modules, which may take longer.
    get_logger('test').debug('')
    with Lockstep(patience=0.5) as world:
        yield world


def never():
    return False


def forever():
    while True:
        pass


# --- Conditions and callbacks


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
    with pytest.raises(LockstepError, match=r'condition .*never \(.*test_lockstep_failures.py:\d+\)'):
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


class Blocking(Node):
    def __init__(self, wait):
        super().__init__('blocking')
        self.wait = wait
        self.create_subscription(Vector3, 'a', lambda message: None, 10)
        self.create_timer(0.1, self.on_tick)

    def on_tick(self):
        self.wait()


@pytest.mark.parametrize('wait', [lambda: time.sleep(1000), threading.Event().wait, forever])
def test_a_callback_that_blocks_is_named(impatient, wait):
    impatient.add(Echo('innocent', 'a', 'b'))
    with pytest.raises(LockstepError) as caught:
        impatient.add(Blocking(wait))
    first = str(caught.value).splitlines()[0]
    assert first.startswith('at 1 s: Blocking.on_tick (timer of 0.1 s, node /blocking, ')
    assert 'has not returned for 0.5 s of wall time; it is at ' in first
    assert 'innocent' not in first


def decorated(method):
    @wraps(method)
    def inner(*arguments):
        return method(*arguments)

    return inner


class Called:
    def __call__(self):
        forever()


class Decorated(Node):
    @decorated
    def on_tick(self):
        forever()


def test_callbacks_that_are_no_plain_functions_are_named(impatient):
    node = Decorated('decorated')
    for callback, name in (
        (node.on_tick, 'Decorated.on_tick'),
        (Called(), 'Called.__call__'),
        (lru_cache(forever), 'forever'),
    ):
        timer = node.create_timer(0.1, callback)
        with pytest.raises(LockstepError, match=rf'at \S+ s: {name} \(timer of 0.1 s, node /decorated'):
            impatient.add(node) if node not in impatient.nodes else impatient.run_for(0.3)
        node.destroy_timer(timer)


def test_a_law_that_loops_is_named_with_its_node(impatient):
    """All subscriptions of our nodes share the code of one decoder."""
    impatient.add(make(VirtualRobot))
    law = Controller(name='loops', summary='never returns', law=lambda *_: forever())
    impatient.add(GoToGoal(controller=law))

    def run():
        impatient.publish('goal_pose', goal(1.0, 0.0))
        impatient.run_for(1.0)

    named = r'GoToGoal._on_odometry \(subscribed to /odom, node /go_to_goal'
    with pytest.raises(LockstepError, match=named):
        run()


def call(client):
    client.call(Trigger.Request())


def call_for_a_while(client):
    with suppress(Exception):
        client.call(Trigger.Request(), timeout_sec=0.2)


def poll(client):
    future, end = client.call_async(Trigger.Request()), time.monotonic() + 0.3
    while not future.done() and time.monotonic() < end:
        time.sleep(0.01)


def poll_result(client):
    future, end = client.call_async(Trigger.Request()), time.monotonic() + 0.3
    while future.result() is None and time.monotonic() < end:
        time.sleep(0.01)


def poll_by_a_function(client):
    future, end = client.call_async(Trigger.Request()), time.monotonic() + 0.3

    def ready():
        return future.done()

    while not ready() and time.monotonic() < end:
        time.sleep(0.01)


def wait_for_an_event(client):
    event = threading.Event()
    client.call_async(Trigger.Request()).add_done_callback(lambda _: event.set())
    event.wait(0.1)


def spin(client):
    executor = SingleThreadedExecutor()
    executor.spin_until_future_complete(client.call_async(Trigger.Request()), timeout_sec=0.1)


def call_and_catch_everything(client):
    with suppress(BaseException):
        client.call(Trigger.Request())


@pytest.mark.parametrize(
    ('wait', 'how'),
    [
        (call, r'\(client.call\)'),
        (call_for_a_while, r'\(client.call\)'),
        (call_and_catch_everything, r'\(client.call\)'),
        (poll, r'\(future.done\)'),
        (poll_by_a_function, r'\(future.done\)'),
        (poll_result, r'\(future.result\)'),
        (spin, r'\(future.done\)'),
        (wait_for_an_event, 'until a timeout'),
    ],
)
def test_a_callback_that_waits_for_a_response_is_named_also_with_a_timeout(lockstep, wait, how):
    node = Node('waiting')
    client = node.create_client(Trigger, 'other')
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)
    node.create_timer(0.1, lambda: wait(client))

    def run():
        lockstep.add(node)
        lockstep.run_for(0.3)

    with pytest.raises(
        LockstepError,
        match=rf'at 1 s: node /waiting waits for a response of /other {how}, in ({wait.__name__}|ready) '
        r'\(.*test_lockstep_failures.py:\d+\): it cannot arrive',
    ):
        run()


def test_a_node_beside_the_world_that_is_spun_in_a_callback_is_named(lockstep):
    """The usual way to call a service from a callback: it would get no answer, in silence."""
    helper = Node('helper')
    client = helper.create_client(Trigger, 'other')
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)

    def ask():
        rclpy.spin_until_future_complete(helper, client.call_async(Trigger.Request()), timeout_sec=0.2)

    lockstep.node.create_timer(0.1, ask)
    with pytest.raises(LockstepError, match='node /helper waits for a response of /other'):
        lockstep.run_for(0.3)


def test_a_callback_that_sleeps_by_a_rate_is_named(lockstep):
    node = lockstep.add(Node('sleeping'))
    node.create_timer(0.1, lambda: node.create_rate(10.0).sleep())
    with pytest.raises(LockstepError, match='a callback sleeps by a rate, in <lambda>'):
        lockstep.run_for(0.3)


def test_a_callback_may_look_whether_a_response_has_come(lockstep):
    node, seen = Node('looking'), []
    client = node.create_client(Trigger, 'other')
    lockstep.node.create_service(Trigger, 'other', lambda _, response: response)
    future = None

    def tick():
        nonlocal future
        future = future or client.call_async(Trigger.Request())
        seen.append(any(future.done() for _ in range(3)))

    node.create_timer(0.1, tick)
    lockstep.add(node)
    lockstep.run_for(0.25)
    assert seen[:2] == [False, True]
    again = client.call_async(Trigger.Request())
    lockstep.run_until(again.done, 1.0)


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
    with pytest.raises(LockstepError, match='of /never_there would never return: time passes'):
        client.call(Trigger.Request())
    waited = threading.Event().wait(0.001)
    assert not waited


def test_a_callback_that_waits_for_a_message_is_named(lockstep):
    node = lockstep.add(Node('waiting'))
    node.create_timer(0.1, lambda: wait_for_message(Float64, node, 'value', time_to_wait=0.2))
    with pytest.raises(LockstepError, match='wait_for_message waits for a message, in <lambda>'):
        lockstep.run_for(0.3)


def test_wait_for_message_is_as_before_when_the_world_has_ended():
    before = rclpy.wait_for_message.SignalHandlerGuardCondition
    with Lockstep():
        assert rclpy.wait_for_message.SignalHandlerGuardCondition is not before
    assert rclpy.wait_for_message.SignalHandlerGuardCondition is before


def test_a_jump_callback_that_blocks_is_named(impatient):
    threshold = JumpThreshold(
        min_forward=Duration(seconds=1.0), min_backward=None, on_clock_change=False
    )
    clock = impatient.add(Node('jumping')).get_clock()
    handle = clock.create_jump_callback(threshold, pre_callback=forever)
    with pytest.raises(LockstepError, match=r'forever \(.*test_lockstep_failures.py.*has not returned'):
        impatient.jump(5.0)
    handle.unregister()


def test_endless_callbacks_are_named(impatient):
    impatient.add(Echo('ping', 'a', 'b'))
    impatient.add(Echo('pong', 'b', 'a'))
    with pytest.raises(LockstepError, match='callbacks without end: for') as caught:
        impatient.publish('a', Vector3())
    first, *rest = str(caught.value).splitlines()
    assert 'Echo.on_message (subscribed to /a, node /ping' in first
    assert 'Echo.on_message (subscribed to /b, node /pong' in first
    assert any('/a: ' in line and 'from /pong' in line for line in rest)


@pytest.mark.parametrize('period', [0.0, 1e-9, 9e-7])
def test_a_timer_that_would_stop_the_time_is_refused(lockstep, period):
    lockstep.node.create_timer(period, lambda: None)
    with pytest.raises(
        LockstepError, match=rf'/lockstep has a period of {period * 1e9:.0f} ns; .* 1000'
    ):
        lockstep.run_for(1.0)


def test_a_callback_that_sleeps_on_its_clock_is_named(lockstep):
    node = lockstep.add(Node('sleeper'))
    node.create_timer(0.1, lambda: node.get_clock().sleep_for(Duration(seconds=1.0)))
    with pytest.raises(LockstepError, match='node /sleeper sleeps on its clock within a callback'):
        lockstep.run_for(0.3)


def test_a_world_and_its_tasks_continue_after_a_failure(impatient):
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
    blinker = impatient.add(Blinker())
    impatient.run_for(1.0)
    assert passed == [1]
    assert len(blinker.ticks) >= 100


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
    with pytest.raises(TypeError):
        publisher.publish('b')
    lockstep.settle()
    assert '/a' not in lockstep.report()
    assert '/b: 1' not in lockstep.report()
    publisher.publish(Vector3(x=2.0))
    with pytest.raises(TypeError):
        publisher.publish('b')
    assert lockstep.last('b') == Vector3(x=2.0)
    assert '/b: 1 from' in lockstep.report()


def test_the_report_has_what_was_received(lockstep):
    """Also of bytes, and of what would be refused."""
    heard = lockstep.listen(Vector3, 'a')
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    message = Vector3()
    # As `message.x = 1` without the checks of rclpy, which are on in these tests.
    message._x = 1
    publisher.publish(message)
    lockstep.settle()
    # Which one depends on the version of Python.
    assert 0.0 < heard[0].x < 1e-300
    assert lockstep.last('a').x == heard[0].x
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
    with pytest.raises(LockstepError, match='no message was published on /b\n'):
        lockstep.last('b')


def test_publishing_is_counted_only_while_a_world_is_open(lockstep):
    lockstep.close()
    assert Publisher.publish.__module__ == 'rclpy.publisher'
