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

"""The lockstep world, with nodes that know nothing of it: its time and what it serves."""

from __future__ import annotations

import time

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger
from users_nodes import Blinker

from diffdrive_jacobian.testing import Lockstep, LockstepError

# --- Timers


def test_timers_tick_as_often_as_their_periods_fit(lockstep):
    blinkers = {rate: lockstep.add(Blinker(f'at_{rate:g}', rate)) for rate in (100.0, 7.0, 30.0)}
    blinks = lockstep.listen(Time, 'blink')
    lockstep.run_for(2.0)
    # And once as they received the time first.
    assert [len(blinker.ticks) for blinker in blinkers.values()] == [201, 15, 61]
    assert all(blinker.ticks[-1] <= lockstep.now for blinker in blinkers.values())
    assert len(blinks) == 274


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


def test_a_timer_destroyed_by_another_at_the_same_time_does_not_tick(lockstep):
    ticks = []
    first = lockstep.node.create_timer(
        0.1, lambda: (ticks.append(1), lockstep.node.destroy_timer(second), first.cancel())
    )
    second = lockstep.node.create_timer(0.1, lambda: ticks.append(2))
    lockstep.run_for(0.5)
    assert ticks == [1]


def test_timers_due_together_come_one_by_one_with_what_follows_from_each(lockstep):
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


def test_timers_on_a_wall_clock_run_on_wall_time(lockstep):
    ticks = []
    lockstep.node.create_timer(
        0.02, lambda: ticks.append(1), clock=Clock(clock_type=ClockType.STEADY_TIME)
    )
    with pytest.warns(UserWarning, match=r'a timer of node /lockstep .* 0.02 s is not on the clock'):
        lockstep.run_for(100.0)
    before = len(ticks)
    assert before < 50
    deadline = time.monotonic() + 10.0
    while len(ticks) == before and time.monotonic() < deadline:
        lockstep.step(at_most=0.001)
    assert len(ticks) > before


def test_limits_of_a_quality_of_service_run_on_wall_time(lockstep):
    limits = QoSProfile(depth=1, deadline=Duration(seconds=0.1), lifespan=Duration(seconds=2.0))
    lockstep.node.create_publisher(Vector3, 'stale', limits)
    lockstep.node.create_publisher(Vector3, 'plain', 10)
    with pytest.warns(UserWarning, match='which DDS measures on wall time') as warned:
        lockstep.run_for(1.0)
    assert [str(one.message).partition(', ')[0] for one in warned] == [
        'the publisher of /stale of node /lockstep has a deadline of 0.1 s',
        'the publisher of /stale of node /lockstep has a lifespan of 2 s',
    ]


def test_a_node_that_was_created_but_not_added_is_named_once(lockstep):
    forgotten = Blinker('forgotten')
    with pytest.warns(UserWarning, match='node /forgotten was created, but not added') as warned:
        lockstep.run_for(1.0)
    lockstep.run_for(1.0)
    assert len(warned) == 1
    forgotten.destroy_node()


# --- Advancing


def test_step_goes_to_the_next_due_timer_and_no_further(lockstep):
    slow, quick = lockstep.add(Blinker('slow', 4.0)), lockstep.add(Blinker('quick', 10.0))
    for seconds in (0.1, 0.2, 0.25, 0.3):
        lockstep.step()
        assert lockstep.elapsed == seconds
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


def test_run_until_evaluates_its_condition_once_at_each_time(lockstep):
    blinker = lockstep.add(Blinker(rate=10.0))
    looks = []
    lockstep.run_until(lambda: looks.append(lockstep.elapsed) or len(blinker.ticks) == 4, timeout=9.0)
    assert looks == [0.0, 0.1, 0.2, 0.3]
    lockstep.run_until(lambda: True, timeout=1.0)
    assert lockstep.elapsed == 0.3


# --- Clocks


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


def test_a_users_subscription_to_clock_receives_each_time_after_all_clocks_are_set(lockstep):
    differences = []
    early, late = Node('early'), Node('late')
    early.create_subscription(
        ClockMessage,
        '/clock',
        lambda _: differences.append(late.get_clock().now().nanoseconds - lockstep.now),
        10,
    )
    lockstep.add(early)
    lockstep.add(late)
    lockstep.add(Blinker(rate=4.0))
    differences.clear()
    clocks = lockstep.listen(ClockMessage, '/clock')
    lockstep.run_for(1.0)
    lockstep.jump(10.0)
    times = [message.clock.sec + message.clock.nanosec * 1e-9 for message in clocks]
    assert times == [1.25, 1.5, 1.75, 2.0, 12.0]
    assert differences == [0] * 5


def test_jump_callbacks_of_a_users_clock_are_called(lockstep):
    jumps = []
    node = lockstep.add(Node('jumping'))
    publisher = node.create_publisher(Vector3, 'a', 10)

    def on_jump(jump):
        jumps.append(jump.delta.nanoseconds)
        publisher.publish(Vector3(x=1.0))

    threshold = JumpThreshold(
        min_forward=Duration(seconds=1.0), min_backward=Duration(seconds=-1.0), on_clock_change=False
    )
    handle = node.get_clock().create_jump_callback(threshold, post_callback=on_jump)
    heard = lockstep.listen(Vector3, 'a')
    lockstep.node.create_timer(0.1, lambda: None)
    lockstep.run_for(1.0)
    assert jumps == []
    lockstep.jump(5.0)
    lockstep.jump(-3.0)
    assert jumps == [5_000_000_000, -3_000_000_000]
    assert len(heard) == 2
    handle.unregister()


# --- Nodes


def test_a_users_node_unchanged_with_timer_service_and_parameter(lockstep):
    blinker = lockstep.add(Blinker())
    assert lockstep.call(Trigger, 'blinker/forget').success
    assert blinker.ticks == []
    blinker.set_parameters([Parameter('rate', value=5.0)])
    lockstep.run_for(0.05)
    assert len(blinker.ticks) == 5
    blinks = lockstep.listen(Time, 'blink')
    lockstep.remove(blinker)
    lockstep.run_for(0.1)
    assert blinks == []


@pytest.mark.lockstep(args=['--ros-args', '-p', 'rate:=20.0', '-r', '__ns:=/house'], start=5.0)
def test_ros_arguments_reach_the_nodes(lockstep):
    blinker = lockstep.add(Blinker())
    assert blinker.get_fully_qualified_name() == '/house/blinker'
    assert blinker.rate == 20.0
    assert lockstep.now == 5_000_000_000


def test_the_type_description_service_exists_only_if_it_is_asked_for():
    for args in ([], ['--ros-args', '-p', 'start_type_description_service:=true']):
        with Lockstep(args) as world:
            node = world.add(Node('described', start_parameter_services=False))
            names = [service.service_name for service in node.services]
            assert names == bool(args) * ['/described/get_type_description']


# --- Coroutines


def test_coroutines_are_awaited(lockstep):
    """A callback that waits for a service, which takes a second of simulated time."""
    asking, slow, answers = lockstep.add(Node('asking')), lockstep.add(Node('slow')), []
    client = asking.create_client(Trigger, 'slow')

    async def on_question(message):
        response = await client.call_async(Trigger.Request())
        answers.append((message.x, response.message))

    async def on_relay(request, _):
        return await client.call_async(request)

    async def on_call(_, response):
        woken = Future()
        timer = slow.create_timer(1.0, lambda: woken.set_result(None))
        await woken
        slow.destroy_timer(timer)
        response.message = f'at {slow.get_clock().now().nanoseconds}'
        return response

    asking.create_subscription(Vector3, 'question', on_question, 10)
    asking.create_service(Trigger, 'relay', on_relay)
    slow.create_service(Trigger, 'slow', on_call)
    lockstep.publish('question', Vector3(x=7.0))
    lockstep.run_for(0.9)
    assert answers == []
    lockstep.run_for(0.2)
    assert answers == [(7.0, 'at 2000000000')]
    assert lockstep.call(Trigger, 'relay').message == 'at 3100000000'


def test_what_follows_from_a_coroutine_or_task_follows_at_once(lockstep):
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
    task = lockstep.node.executor.create_task(heard.append, 1)
    lockstep.settle()
    assert heard[2:] == [1]
    assert task.done()
