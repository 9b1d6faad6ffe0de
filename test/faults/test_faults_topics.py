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

"""Faults of topics, on nodes that know nothing of them: which messages arrive, and when."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
from faults_nodes import LATCHED, Sink, Source, in_time, play
from rclpy.node import Node
from std_msgs.msg import Int64, String
from support.lockstep_nodes import LEAN

from diffdrive_jacobian import faults
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.testing import Lockstep, LockstepError

DELAY = faults.Delay('count', 0.3)
LOSS = faults.Loss('count', duration=0.55)
PLAYED = {
    'lost from the start until just before the end': (
        [faults.Loss('count', start=0.3, duration=0.3)],
        [*in_time(1, 2), *in_time(6, 10)],
    ),
    'delayed': ([faults.Delay('count', 0.25)], in_time(1, 7, 250.0)),
    'delayed more and more': (
        [faults.Delay('count', 0.0, growth=0.5, start=0.2)],
        [*in_time(1, 2), *((n, 200.0 + 150.0 * (n - 2)) for n in range(3, 8))],
    ),
    'duplicated at once or later': (
        [
            faults.Duplicate('count', copies=2, duration=0.15),
            faults.Duplicate('count', seconds=0.03, start=0.25, duration=0.1),
        ],
        [(1, 100.0)] * 3 + [(2, 200.0), (3, 300.0), (3, 330.0), *in_time(4, 10)],
    ),
    'at a limited rate': ([faults.RateLimit('count', 4.0)], [(n, 100.0 * n) for n in (1, 4, 7, 10)]),
    'replaced by the message before': (
        [faults.Stale('count', start=0.35, duration=0.3)],
        [*in_time(1, 3), (3, 400.0), (3, 500.0), (3, 600.0), *in_time(7, 10)],
    ),
    'replaced by the first message': ([faults.Stale('count')], [(1, 100.0 * n) for n in range(1, 11)]),
    # Faults follow each other in the order of injection.
    'delayed before some are lost': ([DELAY, LOSS], in_time(3, 7, 300.0)),
    'lost before they are delayed': ([LOSS, DELAY], in_time(6, 7, 300.0)),
}


@pytest.mark.parametrize('how', PLAYED)
def test_messages_arrive(lockstep, how):
    injected, expected = PLAYED[how]
    assert play(lockstep, *injected) == expected


def test_a_copy_comes_before_what_was_published_later(lockstep):
    source, got = lockstep.create(lambda: Node('source', **LEAN)), []
    sink = lockstep.create(lambda: Node('sink', **LEAN))
    publishers = [source.create_publisher(Int64, topic, 10) for topic in 'ab']
    for topic in 'ab':
        sink.create_subscription(Int64, topic, lambda _, topic=topic: got.append(topic), 10)
    lockstep.inject(faults.Duplicate('a'))

    def publish():
        for publisher in publishers:
            publisher.publish(Int64())

    source.create_timer(0.1, publish)
    lockstep.run_for(0.25)
    assert ''.join(got) == 'aab' * 2


# --- Random numbers


def test_a_burst_loses_messages_in_a_row(lockstep):
    got = play(lockstep, faults.Loss('count', probability=0.1, burst=4), seconds=10.0)
    gaps = [after - before - 1 for (before, _), (after, _) in pairwise(got) if after - before > 1]
    assert len(gaps) > 2
    assert all(gap % 4 == 0 for gap in gaps)


def test_a_random_delay_keeps_the_order_and_reordering_does_not(lockstep):
    got = play(lockstep, faults.Delay('count', 0.0, spread=0.5, duration=0.75), seconds=2.0, seed=4)
    assert [number for number, _ in got] == list(range(1, 21))
    late = [time - 100.0 * number for number, time in got]
    assert all(0.0 <= one <= 500.0 for one in late)
    assert late[7] > 0.0, 'the first message after the fault does not overtake'
    assert late[-8:] == [0.0] * 8
    del got[:]
    lockstep.inject(faults.Reorder('count', 0.3, 0.15), seed=1)
    lockstep.run_for(2.0)
    assert {time - 100.0 * number for number, time in got} == {0.0, 150.0}
    assert {number for number, _ in got} >= set(range(21, 39))


def test_each_subscription_and_fault_has_random_numbers_of_its_own(lockstep):
    loss = faults.Loss('count', probability=0.5)
    one, two = (lockstep.add(Sink(name)) for name in ('one', 'two'))
    lockstep.inject(loss, seed=7)
    lockstep.add(Source())
    lockstep.run_for(5.0)
    alone = one.numbers
    assert alone != two.numbers
    lockstep.close()
    with Lockstep() as world:
        later = world.add(Sink('three')), world.add(Sink('one'))
        world.inject(faults.Loss('another', node='one'), loss, seed=7)
        world.add(Source())
        world.run_for(5.0)
        assert later[1].numbers == alone
    with Lockstep() as world:
        # An equal fault loses others.
        assert 2 < len(play(world, loss, loss, seconds=5.0, seed=7)) < 20


# --- Several subscriptions


def test_who_is_affected(lockstep):
    """All nodes, or the one that is named; not the test itself and its observers, unless named."""
    heard = lockstep.listen(Int64, 'count')
    observer, named = (lockstep.add(Sink(name), observer=True) for name in ('observer', 'named'))
    sink = lockstep.add(Sink())
    two, three = (lockstep.add(Sink(name, topic='other')) for name in ('two', 'three'))
    lockstep.inject(
        faults.Loss('count'), faults.Loss('count', node='named'), faults.Loss('other', node='two')
    )
    lockstep.add(Source())
    lockstep.add(Source('another', topic='other'))
    lockstep.run_for(0.3)
    assert [message.data for message in heard] == observer.numbers == three.numbers == [0, 1, 2, 3]
    assert named.numbers == sink.numbers == two.numbers == []


def test_raw_subscriptions_and_those_with_info_are_affected(lockstep):
    raw, infos = [], []
    node = lockstep.add(Sink())
    node.create_subscription(Int64, 'count', raw.append, 10, raw=True)
    node.create_subscription(Int64, 'count', lambda message, info: infos.append((message, info)), 10)
    lockstep.inject(faults.Duplicate('count'))
    lockstep.publish('count', Int64(data=5))
    assert [type(one) for one in raw] == [bytes, bytes]
    assert [message.data for message, _ in infos] == [5, 5]
    assert 'source_timestamp' in infos[0][1]


def test_latched_messages_pass_the_faults_of_a_later_subscription(lockstep):
    lockstep.add(Source(profile=LATCHED))
    lockstep.inject(faults.Loss('count', duration=0.35), faults.Delay('count', 0.1))
    lockstep.run_for(0.3)
    lost = lockstep.add(Sink('lost', profile=LATCHED))
    lockstep.run_for(0.3)
    assert lost.received == [(4, 500.0), (5, 600.0)]
    late = lockstep.add(Sink('late', profile=LATCHED))
    lockstep.run_for(0.1)
    assert late.received == [(4, 700.0), (5, 700.0), (6, 700.0)]


@pytest.mark.lockstep(args=['--ros-args', '-r', '__ns:=/robot1'])
def test_names_are_in_the_namespace_of_the_test(lockstep):
    sink = lockstep.create(Sink)
    lockstep.create(Source)
    sink.received.clear()
    lockstep.inject(faults.Loss('count', node='sink', duration=0.35), faults.Kill('source', start=0.75))
    lockstep.run_for(1.0)
    assert sink.numbers == [4, 5, 6, 7]
    assert lockstep.find('sink') is lockstep.find('/robot1/sink') is sink


# --- Events and errors


def events(world):
    return [(event.time_ns / 1e9, event.what) for event in world.fault_events]


def test_events_name_the_affected_messages_and_are_recorded(lockstep, recorded_run):
    play(lockstep, faults.Loss('count', start=0.3, duration=0.3), faults.Stale('count', start=0.65))
    assert events(lockstep) == [
        (0.3, 'begins'),
        (0.6, 'messages 3 to 5 of /count to /sink lost, from 0.3 s to 0.5 s'),
        (0.6, 'ends: 3 of 3 messages of /count to /sink'),
        (0.65, 'begins'),
        (1.0, 'messages 4 to 7 of /count to /sink changed, from 0.7 s to 1 s'),
    ]
    recorded_run.finish()
    with open_bag(recorded_run.bag) as bag:
        times = {}
        for connection, time, _ in bag.messages():
            times.setdefault(connection.topic, []).append(time)
    # What was published, not what arrived.
    assert len(times['/count']) == 11
    assert times['/fault_events'][:3] == [1_300_000_000, 1_600_000_000, 1_600_000_000]


def test_a_delay_ends_when_its_last_message_has_arrived(lockstep):
    delay = faults.Delay('count', 1.0, start=0.25, duration=0.2)
    got = play(lockstep, delay, seconds=0.6)
    report = lockstep.report()
    assert f'{delay!r}: over, its last message arrives at 1.4 s, 2 of 2 messages' in report
    lockstep.run_for(1.4)
    # The two that were delayed, and those that wait behind them.
    assert got[:6] == [*in_time(1, 2), (3, 1300.0), (4, 1400.0), (5, 1400.0), (6, 1400.0)]
    assert [time for time, _ in events(lockstep)] == [0.25, 0.45, 0.45, 1.4, 1.4]
    assert events(lockstep)[1][1].endswith('delayed by 1 s, from 0.3 s to 0.4 s')
    assert events(lockstep)[3][1].endswith('delayed by 0.1 s to 0.9 s, from 0.5 s to 1.3 s')
    assert events(lockstep)[4][1] == 'ends: 2 of 2 messages of /count to /sink and 9 behind them'


def test_events_are_published_reported_and_bounded(lockstep):
    loss = faults.Loss('count', probability=0.5, duration=99.0)
    published = lockstep.listen(String, 'fault_events')
    play(lockstep, loss, faults.Loss('count', start=500.0), seconds=100.0)
    texts = [json.loads(message.data) for message in published]
    assert [(text['time'], text['what']) for text in texts] == events(lockstep)
    assert texts[0]['fault'] == repr(loss)
    assert len(texts) == 201
    assert texts[199]['what'].endswith('(further events of this fault are omitted)')
    assert texts[200]['what'].startswith('ends: ')
    report = lockstep.report()
    assert 'events of faults, without the first 181:' in report
    assert "Loss('count', start=500.0): has not begun, starts at 500 s" in report
    lockstep.finish()


def test_a_fault_that_met_nothing_is_an_error(lockstep):
    lockstep.add(Sink())
    lockstep.inject(faults.Loss('cuont'), faults.Loss('count', node='snik'), faults.Loss('count'))
    expected = (
        r"^faults without effect: Loss\('cuont'\): no subscription of /cuont was seen; "
        r"Loss\('count', node='snik'\): no subscription of /snik of /count was seen$"
    )
    with pytest.raises(LockstepError, match=expected):
        lockstep.check_faults()
    # The node and the topic, but not of that node.
    lockstep.add(Sink('snik', topic='cuont'))
    with pytest.raises(LockstepError, match=r"effect: Loss\('count', node='snik'\): no subscription"):
        lockstep.finish()
    nodes = [faults.Kill('a'), faults.Hang('b'), faults.Slow('/c/d', 1.0), faults.TimerJitter('e', 1.0)]
    lockstep.inject(*nodes, faults.LateService('aks', 1.0))
    with pytest.raises(LockstepError) as caught:
        lockstep.check_faults()
    for name in ('node /a', 'node /b', 'node /c/d', 'node /e', 'service /aks'):
        assert f'no {name} was seen' in str(caught.value)
    lockstep.close()


def test_wrong_arguments_of_inject_are_named(lockstep):
    lockstep.run_for(2.0)
    for fault, seed, words in (
        (faults.Loss, 0, 'inject takes faults, got <class'),
        (faults.Loss('count'), '0', "seed must be an integer, got '0'"),
        (faults.Loss('count', duration=1.5), 0, 'is over: 2 s have passed since the start'),
        (faults.Loss('/clock'), 0, 'sets the clocks itself; use TimeJump or ClockPause'),
        (faults.Kill('lockstep'), 0, 'names the node of the test itself'),
    ):
        with pytest.raises(LockstepError, match=words):
            lockstep.inject(fault, seed=seed)
    lockstep.run_for(0.1)
    assert lockstep.fault_events == []
