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

"""Faults of nodes: what of them is executed, and when."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import pytest
from faults_nodes import LATCHED, Relay, Sink, Source, in_time, whats
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from diffdrive_jacobian import faults
from diffdrive_jacobian.testing import LockstepError


@pytest.fixture
def relay(lockstep):
    """A relay between source and sink, which have not sent and received anything yet."""
    source = lockstep.create(Source)
    relay = lockstep.create(Relay)
    relay.sink = lockstep.create(lambda: Sink(topic='relayed'))
    relay.source = source
    relay.ticks.clear()
    return relay


# --- Killed


def test_a_killed_node_stops_at_once_and_is_made_again(lockstep, relay):
    lockstep.inject(faults.Kill('relay', start=0.35, duration=0.3))
    lockstep.run_for(1.0)
    again = lockstep.find('relay')
    assert again is not relay
    assert relay.numbers == [1, 2, 3]
    assert relay.ticks == [100.0, 200.0, 300.0]
    assert again.numbers == [7, 8, 9, 10]
    # Timers that are created before the first /clock tick at multiples of their period.
    assert again.ticks == [650.0, 700.0, 800.0, 900.0, 1000.0]
    assert relay.sink.numbers == [1, 2, 3, 7, 8, 9, 10]
    assert whats(lockstep) == ['begins', '/relay is killed', '/relay is started again', 'ends']


def test_a_node_that_is_not_there_is_neither_killed_nor_made(lockstep, relay):
    lockstep.remove(relay)
    lockstep.inject(faults.Kill('relay', duration=0.1), faults.Kill('late', duration=0.2))
    late = lockstep.create(lambda: Sink('late'))
    lockstep.run_for(0.5)
    assert relay not in lockstep.nodes
    assert lockstep.find('late') is late
    assert sorted(whats(lockstep)) == sorted(2 * ['begins', 'the node is not there', 'ends'])
    lockstep.close()


def test_a_killed_node_is_gone_with_its_latched_messages(lockstep):
    source = lockstep.create(lambda: Source(profile=LATCHED))
    lockstep.create(lambda: Sink(profile=LATCHED))
    lockstep.inject(faults.Kill('/sink', start=0.2), faults.Kill('source', start=0.35))
    seen = []
    lockstep.node.create_timer(0.1, lambda: seen.append(source.publisher.get_subscription_count()))
    lockstep.run_for(0.34)
    assert seen == [1, 0, 0]
    with pytest.raises(LockstepError, match='there is no node /sink; nodes: /lockstep, /source'):
        lockstep.find('sink')
    lockstep.run_for(0.05)
    assert lockstep.add(Sink(profile=LATCHED)).received == []


def test_a_node_that_is_made_again_receives_latched_messages(lockstep):
    lockstep.create(lambda: Source(profile=LATCHED))
    lockstep.create(lambda: Sink(profile=LATCHED))
    lockstep.inject(faults.Kill('sink', start=0.15, duration=0.3))
    lockstep.run_for(0.5)
    assert lockstep.find('sink').received == [(2, 450.0), (3, 450.0), (4, 450.0), (5, 500.0)]


def test_a_node_that_is_killed_twice_rises_after_both_faults(lockstep, relay):
    lockstep.inject(
        faults.Kill('relay', start=0.15, duration=0.4), faults.Kill('relay', start=0.35, duration=0.4)
    )
    lockstep.run_for(1.0)
    assert lockstep.find('relay').numbers == [8, 9, 10]
    assert whats(lockstep).count('the node is not there') == 1


def test_a_node_without_a_factory_cannot_be_made_again(lockstep):
    lockstep.add(Relay())
    lockstep.inject(faults.Kill('relay', start=0.1, duration=0.1))
    with pytest.raises(LockstepError, match='cannot start /relay again: create it with'):
        lockstep.run_for(1.0)


@pytest.mark.parametrize('killed', [True, False])
def test_tasks_of_a_killed_or_removed_node_end(lockstep, killed):
    done, gate = [], Future()

    class Waiter(Node):
        async def wait(self):
            done.append('waiting')
            await gate
            done.append('never')

    waiter = lockstep.create(lambda: Waiter('waiter'))
    waiter.executor.create_task(waiter.wait)
    if killed:
        lockstep.inject(faults.Kill('waiter', start=0.1))
    lockstep.inject(faults.Hang('waiter', duration=0.1))
    lockstep.run_for(0.2)
    if not killed:
        lockstep.remove(waiter)
    gate.set_result(None)
    lockstep.run_for(0.2)
    assert done == ['waiting']


# --- Frozen or slow


def at(time, *numbers):
    return [(number, time) for number in numbers]


HELD = {
    'frozen': (
        [faults.Hang('relay', start=0.25, duration=0.3)],
        [*in_time(1, 2), *at(550.0, 3, 4, 5), *in_time(6, 9)],
        [*in_time(1, 2), *at(550.0, 3, 4, 5), *in_time(6, 9)],
        [100.0, 200.0, 550.0, 600.0, 700.0, 800.0, 900.0],
    ),
    'frozen twice': (
        [
            faults.Hang('relay', start=0.15, duration=0.3),
            faults.Hang('relay', start=0.3, duration=0.45),
        ],
        [*in_time(1, 1), *at(750.0, 2, 3, 4, 5, 6, 7), *in_time(8, 9)],
        [*in_time(1, 1), *at(750.0, 2, 3, 4, 5, 6, 7), *in_time(8, 9)],
        [100.0, 750.0, 800.0, 900.0],
    ),
    # What it publishes leaves at the end of a callback.
    'slower than its timer': (
        [faults.Slow('relay', 0.25, duration=0.45)],
        [(1, 100.0), *at(600.0, 2, 3, 4, 5, 6), *in_time(7, 9)],
        [(1, 350.0), *at(600.0, 2, 3, 4, 5, 6), *in_time(7, 9)],
        [350.0, 600.0, 700.0, 800.0, 900.0],
    ),
    # Messages and ticks are due together. The message comes first, the tick is older than the next.
    'slow': (
        [faults.Slow('relay', 0.06, duration=0.45)],
        [(1, 100.0), (2, 220.0), (3, 340.0), (4, 460.0), *in_time(5, 9)],
        [(1, 160.0), (2, 280.0), (3, 400.0), (4, 460.0), *in_time(5, 9)],
        [160.0, 280.0, 400.0, 500.0, 600.0, 700.0, 800.0, 900.0],
    ),
}
"""Faults, what the relay receives, what arrives behind it, and its ticks."""


@pytest.mark.parametrize('how', HELD)
def test_a_node_that_is_held_continues_with_what_waits(lockstep, relay, how):
    injected, received, relayed, ticks = HELD[how]
    lockstep.inject(*injected)
    lockstep.run_for(0.9)
    assert relay.received == received
    assert relay.sink.received == relayed
    assert relay.ticks == ticks


def test_a_frozen_node_loses_the_oldest_messages_and_responds_late(lockstep):
    relay = lockstep.create(lambda: Relay(profile=2))
    lockstep.create(Source)
    relay.received.clear()
    lockstep.inject(faults.Hang('relay', start=0.05, duration=0.5))
    lockstep.run_for(0.1)
    assert lockstep.call(Trigger, 'ask').success
    lockstep.run_for(0.15)
    assert relay.received == [(4, 550.0), (5, 550.0), (6, 600.0), (7, 700.0)]
    assert relay.calls == [550.0]
    assert '3 messages and requests wait, lost from full queues: 3 of /count' in whats(lockstep)


def test_a_frozen_node_continues_its_tasks_late(lockstep):
    order = []
    asking = lockstep.create(lambda: Node('asking'))
    client = asking.create_client(Trigger, 'ask')

    async def ask(_):
        future = client.call_async(Trigger.Request())
        future.add_done_callback(lambda _: order.append(('done', lockstep.elapsed)))
        await future
        order.append(('answered', lockstep.elapsed))

    asking.create_subscription(Int64, 'count', ask, 10)
    relay = lockstep.create(Relay)
    lockstep.inject(faults.LateService('ask', 0.2), faults.Hang('asking', start=0.1, duration=0.4))
    lockstep.publish('count', Int64())
    lockstep.run_for(1.0)
    assert relay.calls == [0.0]
    assert order == [('done', 0.5), ('answered', 0.5)]


def test_what_waits_behind_an_exception_is_processed_later(lockstep):
    relay = lockstep.create(Relay)
    lockstep.create(Source)
    relay.received.clear()
    publish = relay.publisher.publish

    def failing(message):
        publish(message)
        if message.data == 2:
            raise ValueError('two')

    relay.publisher = SimpleNamespace(publish=failing)
    lockstep.inject(faults.Hang('relay', start=0.05, duration=0.4))
    with pytest.raises(ValueError, match='two'):
        lockstep.run_for(0.7)
    lockstep.run_for(0.25)
    assert relay.numbers == [1, 2, 3, 4, 5, 6, 7]


def test_a_slow_node_loses_messages_from_a_full_queue(lockstep):
    relay = lockstep.create(lambda: Relay(profile=1, period=99.0))
    lockstep.create(Source)
    relay.received.clear()
    lockstep.inject(faults.Slow('relay', 0.25, start=0.05, duration=0.95))
    lockstep.run_for(1.0)
    assert relay.received == [(1, 100.0), (3, 350.0), (5, 600.0), (8, 850.0)]
    assert 'lost from full queues: ' in whats(lockstep)[-2]


def test_a_slow_service_serves_one_request_after_the_other(lockstep):
    relay = lockstep.create(lambda: Relay(period=99.0))
    client, answers = lockstep.node.create_client(Trigger, 'ask'), []
    lockstep.inject(faults.Slow('relay', 0.2))
    for _ in range(2):
        client.call_async(Trigger.Request()).add_done_callback(
            lambda _: answers.append(lockstep.elapsed)
        )
    lockstep.run_for(1.0)
    assert relay.calls == [0.0, 200.0]
    assert answers == [0.2, 0.4]


# --- Timers and parameters


@pytest.mark.parametrize(('most', 'ticks'), [(30.0, range(11, 12)), (500.0, range(2, 9))])
def test_ticks_are_late_or_replace_those_between(lockstep, relay, most, ticks):
    lockstep.inject(faults.TimerJitter('relay', most / 1000.0, start=0.15, duration=0.7), seed=3)
    lockstep.run_for(1.1)
    late = [tick % 100.0 for tick in relay.ticks]
    assert len(late) in ticks
    assert late[0] == 0.0
    assert late[-2:] == pytest.approx([0.0] * 2)
    assert max(after - before for before, after in pairwise(relay.ticks)) < 200.0 + most
    if most < 100.0:
        assert all(0.0 < one <= most for one in late[1:8])
        assert len(set(late[1:8])) == 7


def test_a_parameter_is_changed_and_changed_back(lockstep, relay):
    gains = []
    lockstep.node.create_timer(0.1, lambda: gains.append(relay.get_parameter('gain').value))
    for value, start, duration in (
        (3.0, 0.05, 0.2),
        (5.0, 0.15, 0.2),
        (7.0, 0.45, 0.3),
        (9.0, 0.55, 0.1),
    ):
        lockstep.inject(faults.ParameterChange('relay', 'gain', value, start=start, duration=duration))
    lockstep.run_for(0.8)
    assert gains == [3.0, 5.0, 5.0, 1.0, 7.0, 9.0, 7.0, 1.0]
    assert whats(lockstep)[:2] == ['begins', 'gain is 3.0, was 1.0']
    assert whats(lockstep)[-2:] == ['gain is 1.0, was 7.0', 'ends']


def test_a_refused_value_is_an_event_and_an_unknown_name_an_error(lockstep, relay):
    lockstep.inject(faults.ParameterChange('relay', 'gain', 'high'))
    assert whats(lockstep)[1].startswith("gain = 'high' is refused: ")
    assert relay.get_parameter('gain').value == 1.0
    lockstep.inject(faults.ParameterChange('other', 'gain', 3.0))
    assert whats(lockstep)[2:] == ['begins', 'the node is not there']
    with pytest.raises(LockstepError, match="/relay has no parameter 'kp'; it has gain"):
        lockstep.inject(faults.ParameterChange('relay', 'kp', 1.0))
    lockstep.close()
