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

"""Nodes in processes of their own that take part in a lockstep world, unchanged and undeclared."""

from __future__ import annotations

import itertools
from contextlib import contextmanager

import pytest
from external_calls import SECOND, command, numbers, send, stamp
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from rclpy.task import Future
from std_msgs.msg import Float64, Header, String
from std_srvs.srv import Trigger

from diffdrive_jacobian.faults import ClockPause, Loss, TimeJump
from diffdrive_jacobian.testing import Lockstep

pytestmark = pytest.mark.process


@contextmanager
def answering(world, name, answer=None):
    """Offer a service. By default it answers, not at once, with the number of the request."""
    count = itertools.count(1)

    async def answer_with_numbers(_, response):
        await world.node.executor.create_task(lambda: None)
        response.message = str(next(count))
        return response

    service = world.node.create_service(Trigger, name, answer or answer_with_numbers)
    yield
    world.node.destroy_service(service)


# --- Messages and services


@pytest.fixture(scope='class')
def talking():
    names = ('echo', 'bare', 'kept', 'late', 'hearing', 'waiting', 'repeater', 'best_effort')
    with Lockstep() as world:
        world.start(
            [*command(*names, 'caller', 'asking'), '--ros-args', '-p', 'times:=3'],
            clock_period=1.0,
            without=['/kept/out'],
        )
        yield world


class TestMessages:
    """One process with many nodes."""

    @pytest.mark.parametrize('name', ['echo', 'bare'])
    def test_each_message_is_answered_before_the_next_callback(self, talking, name):
        """`bare` has no services for parameters."""
        received = talking.listen(Header, f'{name}/out')
        for number in range(4):
            send(talking, name, number)
            assert numbers(received) == list(range(number + 1))
            assert stamp(received[-1]) == talking.now
            talking.run_for(0.001)
        assert talking.find(name).get_fully_qualified_name() == f'/{name}'
        assert talking.last(f'{name}/out').frame_id == '3'

    def test_a_topic_may_stay_in_the_process(self, talking):
        received = talking.listen(Header, 'kept/out')
        send(talking, 'kept', 1.0)
        assert received == []
        node = talking.find('kept')
        assert '/kept/in' in {one.topic_name for one in node.subscriptions}
        assert '/kept/out' not in {one.topic_name for one in node.publishers}

    def test_a_topic_that_is_created_later_passes(self, talking):
        send(talking, 'late', 0.0)
        received = talking.listen(Header, 'late/late')
        send(talking, 'late', 1.0, 2.0)
        assert numbers(received) == [1.0, 2.0]

    def test_a_process_that_hears_itself_does_not_hear_it_twice(self, talking):
        sums = talking.listen(Float64, 'hearing/sum')
        received = talking.listen(Header, 'hearing/out')
        send(talking, 'hearing', 1.0, 2.0)
        talking.publish('hearing/out', Header(frame_id='10'))
        send(talking, 'hearing', 4.0)
        assert [one.data for one in sums] == [1.0, 3.0, 13.0, 17.0]
        assert len(received) == 4

    def test_a_callback_that_sleeps_or_waits_is_waited_for(self, talking):
        received = talking.listen(Header, 'waiting/out')
        for number in range(3):
            send(talking, 'waiting', number)
            assert numbers(received) == list(range(number + 1))

    @pytest.mark.parametrize('name', ['repeater', 'best_effort'])
    def test_large_messages_and_many_at_once_arrive_complete(self, talking, name):
        received = talking.listen(String, f'{name}/out')
        texts = [str(digit) * 400_000 for digit in range(2)]
        for text in texts:
            talking.publish(f'{name}/in', String(data=text))
        assert [one.data for one in received] == [text for text in texts for _ in range(3)]

    def test_a_process_calls_services_of_the_world(self, talking):
        received = talking.listen(Header, 'caller/out')
        with answering(talking, 'caller/ask'):
            send(talking, 'caller', 0.0, 0.0, 0.0)
        assert numbers(received) == [1.0, 2.0, 3.0]

    def test_a_callback_waits_for_a_service_of_the_world(self, talking):
        """What else is sent to it meanwhile comes after the response, as do later times."""
        received = talking.listen(Header, 'asking/out')
        publisher = talking.node.create_publisher(Float64, 'asking/in', 10)
        with answering(talking, 'asking/ask'):
            for _ in range(2):
                publisher.publish(Float64())
                publisher.publish(Float64())
                talking.run_for(0.03)
        assert numbers(received) == [1.0, 2.0, 3.0, 4.0]

    def test_a_response_that_comes_later_in_simulated_time_is_not_waited_for(self, talking):
        """The timeout of the callback is wall time. So no simulated time passes, whatever that is."""
        slow = Future()

        async def answer(_, response):
            await slow
            return response

        received = talking.listen(Header, 'asking/out')
        publisher = talking.node.create_publisher(Float64, 'asking/in', 10)
        begin = talking.now
        with answering(talking, 'asking/ask', answer):
            for _ in range(2):
                publisher.publish(Float64())
            talking.run_for(0.1)
            slow.set_result(None)
            talking.run_for(0.1)
        assert numbers(received) == [-1.0, -1.0]
        assert [stamp(one) for one in received] == [begin, begin]


def test_a_process_calls_a_service_while_it_starts(lockstep):
    with answering(lockstep, 'askingfirst/ask'):
        lockstep.start(command('askingfirst'))
    first = lockstep.listen(String, 'askingfirst/first', latched=True)
    assert [one.data for one in first] == ['1']


def test_an_action_of_a_process(lockstep):
    actions = pytest.importorskip('test_msgs.action', reason='test_msgs is not installed')
    lockstep.start(command('counting'))
    client = ActionClient(lockstep.node, actions.Fibonacci, 'counting/count')
    feedback = []
    goal = client.send_goal_async(
        actions.Fibonacci.Goal(order=5), lambda one: feedback.append(list(one.feedback.sequence))
    )
    lockstep.run_until(goal.done, timeout=5.0)
    result = goal.result().get_result_async()
    lockstep.run_until(result.done, timeout=5.0)
    assert list(result.result().result.sequence) == [0, 1, 1, 2, 3]
    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    client.destroy()


def test_nodes_of_one_process_that_share_topics_receive_one_after_the_other(lockstep):
    process = lockstep.start(command('other', 'shared', 'sharing'))
    assert [node.get_name() for node in process.nodes] == ['other', 'shared', 'sharing']
    heard = lockstep.listen(String, 'heard')
    words = lockstep.listen(String, 'words')
    send(lockstep, 'sharing', *range(3))
    assert [one.data for one in words] == ['0', '1', '2']
    assert [one.data for one in heard] == [
        f'{name} {number + 1} {number}' for number in range(3) for name in ('sharing', 'other', 'shared')
    ]
    # Each sends for itself, and what they send to one another may be lost.
    report = lockstep.report()
    assert all(f'/heard: 3 from /{name}' in report for name in ('other', 'shared', 'sharing'))
    lockstep.inject(Loss('words'))
    send(lockstep, 'sharing', 5.0)
    lockstep.check_faults()
    assert [one.data for one in heard[9:]] == ['sharing 4 5']


# --- Time


@pytest.fixture(scope='class')
def ticking():
    with Lockstep() as world:
        world.publish('ticker/map', String(data='abc'), latched=True)
        world.start(command('ticker', 'growing'))
        yield world


class TestTime:
    """A process with nodes that have timers."""

    def test_a_timer_expires_on_time_also_when_the_clock_jumps(self, ticking):
        received = ticking.listen(Header, 'ticker/out')
        begin = ticking.now
        ticking.run_for(0.2)
        times = [stamp(one) - begin for one in received]
        assert times == [number * SECOND // 20 for number in (1, 2, 3, 4)]
        # A jump forward gives one tick, and one back none until the end of a period.
        ticking.jump(10.02)
        assert [stamp(one) for one in received[4:]] == [ticking.now]
        ticking.run_for(0.03)
        assert [stamp(one) for one in received[5:]] == [ticking.now]
        ticking.jump(-5.0)
        ticking.run_for(0.2)
        assert len(received) >= 9

    def test_parameters_services_and_latched_topics_pass(self, ticking):
        assert ticking.last('ticker/description').data == 'first'
        late = ticking.listen(String, 'ticker/description', latched=True)
        assert [one.data for one in late] == ['first']
        received = ticking.listen(Header, 'ticker/out')
        ticking.run_for(0.05)
        # It has received the map.
        assert numbers(received) == [1.0]
        assert ticking.call(Trigger, 'ticker/reset').success
        request = GetParameters.Request(names=['gain'])
        (value,) = ticking.call(GetParameters, 'ticker/get_parameters', request).values
        assert (value.type, value.double_value) == (ParameterType.PARAMETER_DOUBLE, 2.0)
        ticking.run_for(0.05)
        assert numbers(received[1:]) == [0.0]

    def test_a_node_that_is_created_later_takes_part(self, ticking):
        send(ticking, 'growing', 0.0)
        ticking.run_for(0.2)
        received = ticking.listen(Header, 'child/out')
        assert ticking.find('child') is not None
        ticking.run_for(0.1)
        assert len(received) == 2

    def test_faults_of_the_clock_affect_timers(self, ticking):
        """None expires while it stands still, and one when it jumps forward."""
        received, begin = ticking.listen(Header, 'ticker/out'), ticking.world_seconds
        ticking.inject(ClockPause(start=begin + 0.1, duration=0.5), TimeJump(5.0, start=begin + 0.8))
        ticking.run_for(0.15)
        before = len(received)
        ticking.run_for(0.4)
        assert len(received) == before
        ticking.run_for(0.2)
        assert len(received) > before
        now = ticking.now
        ticking.run_for(0.06)
        assert stamp(received[-1]) > now + 5 * SECOND
