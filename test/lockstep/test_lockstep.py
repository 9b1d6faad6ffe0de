"""The lockstep world, with nodes that know nothing of it: its time and what it serves."""

from __future__ import annotations

import time

import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from users_nodes import Blinker

from diffdrive_jacobian.testing import Lockstep, LockstepError

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_the_type_description_service_exists_only_if_it_is_asked_for():
    name, asked = 'start_type_description_service', ['--ros-args', '-p']
    for args, provided in (([], False), ([*asked, f'{name}:=true'], True)):
        with Lockstep(args) as world:
            node = world.add(Node('described', start_parameter_services=False))
            names = [service.service_name for service in node.services]
            assert names == provided * ['/described/get_type_description']


# --- Time


@pytest.mark.parametrize('rate', [100.0, 50.0, 7.0, 30.0, 1.0])
def test_timer_ticks_as_often_as_its_period_fits_whatever_else_runs(lockstep, rate):
    lockstep.add(Blinker('other', 33.0))
    blinker = lockstep.add(Blinker(rate=rate))
    blinks = lockstep.listen(Time, 'blink')
    blinker.ticks.clear()
    blinks.clear()
    lockstep.run_for(2.0)
    assert len(blinker.ticks) == 2 * rate
    assert all(tick <= lockstep.now for tick in blinker.ticks)
    assert len(blinks) == 2 * rate + 66


def test_step_goes_to_the_next_due_timer_and_no_further(lockstep):
    slow, quick = lockstep.add(Blinker('slow', 4.0)), lockstep.add(Blinker('quick', 10.0))
    for instant in (0.1, 0.2, 0.25, 0.3):
        lockstep.step()
        assert lockstep.elapsed == instant
    assert [len(slow.ticks), len(quick.ticks)] == [2, 4]
    lockstep.step(at_most=0.03)
    assert lockstep.elapsed == 0.33
    lockstep.step(at_most=1.0)
    assert lockstep.elapsed == 0.4


def test_run_for_ends_exactly_there_and_without_timers_too(lockstep):
    lockstep.run_for(1e-9)
    lockstep.run_for(12.345)
    assert lockstep.elapsed == 12.345000001
    with pytest.raises(LockstepError, match='no timer is running'):
        lockstep.step()


def test_a_timer_made_or_reset_in_a_callback_counts_from_there(lockstep):
    ticks = []

    def later():
        ticks.append(lockstep.elapsed)
        if len(ticks) == 1:
            lockstep.node.create_timer(0.25, lambda: ticks.append(('new', lockstep.elapsed)))
            timer.cancel()

    timer = lockstep.node.create_timer(0.1, later)
    lockstep.run_for(1.0)
    assert ticks == [0.1, ('new', 0.35), ('new', 0.6), ('new', 0.85)]


def test_a_timer_destroyed_by_another_at_the_same_instant_does_not_tick(lockstep):
    ticks = []
    first = lockstep.node.create_timer(
        0.1, lambda: (ticks.append(1), lockstep.node.destroy_timer(second), first.cancel())
    )
    second = lockstep.node.create_timer(0.1, lambda: ticks.append(2))
    lockstep.run_for(0.5)
    assert ticks == [1]


def test_timers_due_at_one_instant_come_one_by_one_with_what_follows_from_each(lockstep):
    order = []
    for name in 'ab':
        publisher = lockstep.node.create_publisher(Vector3, name, 10)
        lockstep.node.create_subscription(
            Vector3, name, lambda m, name=name: order.append(f'/{name}'), 10
        )
        lockstep.node.create_timer(
            0.1, lambda p=publisher, name=name: (order.append(name), p.publish(Vector3()))
        )
    lockstep.run_for(0.2)
    assert order == ['a', '/a', 'b', '/b'] * 2


def test_run_until_looks_once_at_each_instant(lockstep):
    blinker = lockstep.add(Blinker(rate=10.0))
    looks = []
    lockstep.run_until(lambda: looks.append(lockstep.elapsed) or len(blinker.ticks) == 4, timeout=9.0)
    assert looks == [0.0, 0.1, 0.2, 0.3]
    lockstep.run_until(lambda: True, timeout=1.0)
    assert lockstep.elapsed == 0.3


def test_what_a_condition_does_is_handled_before_time_passes(lockstep):
    heard = []
    publisher = lockstep.node.create_publisher(Vector3, 'a', 10)
    lockstep.node.create_subscription(Vector3, 'a', lambda _: heard.append(lockstep.elapsed), 10)
    lockstep.node.create_timer(0.1, lambda: None)
    lockstep.run_until(lambda: publisher.publish(Vector3()) or lockstep.elapsed > 0.25, timeout=1.0)
    lockstep.settle()
    assert heard == [0.0, 0.1, 0.2, 0.3]


def test_jump_is_seen_as_one_and_time_may_go_back(lockstep):
    blinker = lockstep.add(Blinker(rate=10.0))
    blinker.ticks.clear()
    lockstep.jump(100.0)
    assert len(blinker.ticks) == 1
    lockstep.jump(-100.5)
    assert lockstep.now == 500_000_000
    blinker.ticks.clear()
    lockstep.run_for(1.0)
    assert len(blinker.ticks) == 10


def test_timers_on_a_wall_clock_run_on_wall_time(lockstep):
    ticks = []
    lockstep.node.create_timer(
        0.02, lambda: ticks.append(1), clock=Clock(clock_type=ClockType.STEADY_TIME)
    )
    lockstep.run_for(100.0)
    before = len(ticks)
    assert before < 50
    deadline = time.monotonic() + 10.0
    while len(ticks) == before and time.monotonic() < deadline:
        lockstep.step(at_most=0.001)
    assert len(ticks) > before


# --- Nodes


def test_a_users_node_unchanged_with_timer_service_and_parameter(lockstep):
    blinker = lockstep.add(Blinker())
    assert lockstep.call(Trigger, 'blinker/forget').success
    assert blinker.ticks == []
    blinker.set_parameters([Parameter('rate', value=5.0)])
    lockstep.run_for(0.05)
    assert len(blinker.ticks) == 5


@pytest.mark.lockstep(args=['--ros-args', '-p', 'rate:=20.0', '-r', '__ns:=/house'], start=5.0)
def test_ros_arguments_reach_the_nodes(lockstep):
    blinker = lockstep.add(Blinker())
    assert blinker.get_fully_qualified_name() == '/house/blinker'
    assert blinker.rate == 20.0
    assert lockstep.now == 5_000_000_000


class Asking(Node):
    """A node whose callbacks are coroutines that wait for a service."""

    def __init__(self):
        super().__init__('asking')
        self.client = self.create_client(Trigger, 'slow')
        self.create_subscription(Vector3, 'question', self.on_question, 10)
        self.create_service(Trigger, 'relay', self.on_relay)
        self.answers = []

    async def on_question(self, message):
        response = await self.client.call_async(Trigger.Request())
        self.answers.append((message.x, response.message))

    async def on_relay(self, request, response):
        return await self.client.call_async(request)


class Slow(Node):
    """A service that takes a second of simulated time."""

    def __init__(self):
        super().__init__('slow')
        self.create_service(Trigger, 'slow', self.on_call)

    async def on_call(self, request, response):
        woken = rclpy.task.Future()
        timer = self.create_timer(1.0, lambda: woken.set_result(None))
        await woken
        self.destroy_timer(timer)
        response.message = f'at {self.get_clock().now().nanoseconds}'
        return response


def test_coroutines_are_awaited(lockstep):
    asking = lockstep.add(Asking())
    lockstep.add(Slow())
    lockstep.publish('question', Vector3(x=7.0))
    lockstep.run_for(0.9)
    assert asking.answers == []
    lockstep.run_for(0.2)
    assert asking.answers == [(7.0, 'at 2000000000')]
    assert lockstep.call(Trigger, 'relay').message == 'at 3100000000'


def test_what_follows_from_a_coroutine_follows_at_once(lockstep):
    heard = []
    publisher = lockstep.node.create_publisher(Vector3, 'b', 10)

    async def relay(message):
        publisher.publish(message)

    async def on_tick():
        await relay(Vector3(x=2.0))

    lockstep.node.create_subscription(Vector3, 'a', relay, 10)
    lockstep.node.create_subscription(Vector3, 'b', lambda m: heard.append((lockstep.elapsed, m.x)), 10)
    lockstep.publish('a', Vector3(x=1.0))
    lockstep.node.create_timer(0.5, on_tick)
    lockstep.run_for(0.5)
    assert heard == [(0.0, 1.0), (0.5, 2.0)]


def test_tasks_of_a_node_run_at_once(lockstep):
    done = []
    task = lockstep.node.executor.create_task(done.append, 1)
    lockstep.settle()
    assert done == [1]
    assert task.done()
    with pytest.raises(
        LockstepError, match=r'cannot call executor.spin_once: lockstep executes its callbacks'
    ):
        lockstep.node.executor.spin_once()


def test_subscriptions_with_message_info_are_served(lockstep):
    seen = []
    lockstep.node.create_subscription(
        Vector3, 'a', lambda message, info: seen.append((message, info)), 10
    )
    lockstep.publish('a', Vector3(x=1.0))
    assert seen[0][0].x == 1.0
    assert seen[0][1]['source_timestamp'] > 0


def test_latched_messages_reach_those_who_come_later_in_one_order(lockstep):
    speaker = lockstep.add(Node('speaker'))
    for topic in 'abcdefgh':
        publisher = speaker.create_publisher(Vector3, topic, LATCHED)
        for index in range(3):
            publisher.publish(Vector3(x=float(index)))
    heard = []
    late = Node('late')
    for topic in 'hgfedcba':
        late.create_subscription(
            Vector3, topic, lambda m, topic=topic: heard.append((topic, m.x)), LATCHED
        )
    lockstep.add(late)
    assert heard == [(topic, x) for topic in 'hgfedcba' for x in (0.0, 1.0, 2.0)]
    assert [message.x for message in lockstep.listen(Vector3, 'c', latched=True)] == [0.0, 1.0, 2.0]


def test_what_is_made_in_a_callback_is_served_from_then_on(lockstep):
    heard = []
    node = lockstep.add(Node('growing'))
    node.create_subscription(
        Vector3, 'a', lambda _: node.create_subscription(Vector3, 'b', heard.append, 10), 10
    )
    lockstep.publish('a', Vector3())
    lockstep.publish('b', Vector3(x=2.0))
    assert [message.x for message in heard] == [2.0]
    node.destroy_subscription(list(node.subscriptions)[-1])
    with pytest.raises(LockstepError, match='/b has no subscription'):
        lockstep.publish('b', Vector3())


def test_what_a_timer_creates_and_calls_at_once_answers_before_time_passes(lockstep):
    node, called = lockstep.add(Node('calling')), []

    def respond(_, response):
        called.append(('request', lockstep.elapsed))
        return response

    def call():
        timer.cancel()
        node.create_service(Trigger, 'new', respond)
        future = node.create_client(Trigger, 'new').call_async(Trigger.Request())
        future.add_done_callback(lambda _: called.append(('response', lockstep.elapsed)))

    timer = node.create_timer(0.5, call)
    lockstep.run_for(0.5)
    assert called == [('request', 0.5), ('response', 0.5)]


def test_removed_node_is_gone(lockstep):
    blinker = lockstep.add(Blinker())
    blinks = lockstep.listen(Time, 'blink')
    lockstep.run_for(0.1)
    lockstep.remove(blinker)
    blinks.clear()
    lockstep.run_for(0.1)
    assert blinks == []
    with pytest.raises(LockstepError, match='was not added'):
        lockstep.remove(blinker)


def test_a_burst_loses_nothing(lockstep):
    heard = []
    lockstep.node.create_subscription(Vector3, 'a', heard.append, 500)
    publisher = lockstep.node.create_publisher(Vector3, 'a', 500)
    lockstep.node.create_timer(0.1, lambda: [publisher.publish(Vector3(x=float(i))) for i in range(500)])
    lockstep.run_for(0.3)
    assert [message.x for message in heard] == [float(i) for i in range(500)] * 3
