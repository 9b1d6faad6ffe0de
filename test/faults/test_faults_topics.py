"""Faults of topics, on nodes that know nothing of them: which messages arrive, and when."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
from faults_nodes import LATCHED, Sink, Source, play, whats
from rclpy.node import Node
from std_msgs.msg import Int64, String

from diffdrive_jacobian import faults
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.testing import Lockstep, LockstepError

IN_TIME = [(number, 100.0 * number) for number in range(1, 11)]


def test_lost_messages_do_not_arrive_from_start_until_just_before_the_end(lockstep):
    loss = faults.Loss('count', start=0.3, duration=0.3)
    assert play(lockstep, loss) == [*IN_TIME[:2], *IN_TIME[5:]]
    assert whats(lockstep) == [
        'begins',
        'messages 3 to 5 of /count to /sink lost, from 0.3 s to 0.5 s',
        'ends: 3 of 3 messages of /count to /sink',
    ]
    assert [event.time_ns for event in lockstep.fault_events] == [300_000_000, 600_000_000, 600_000_000]


def test_a_burst_loses_messages_in_a_row(lockstep):
    numbers = [
        number
        for number, _ in play(lockstep, faults.Loss('count', probability=0.1, burst=4), seconds=20.0)
    ]
    gaps = [after - before - 1 for before, after in pairwise(numbers) if after - before > 1]
    assert len(gaps) > 5
    assert all(gap % 4 == 0 for gap in gaps)


def test_delayed_messages_arrive_later(lockstep):
    got = play(lockstep, faults.Delay('count', 0.25))
    assert got == [(number, 100.0 * number + 250.0) for number in range(1, 8)]
    assert whats(lockstep)[-1] == (
        'messages 1 to 10 of /count to /sink delayed by 0.25 s, from 0.1 s to 1 s'
    )


def test_a_delay_grows(lockstep):
    got = play(lockstep, faults.Delay('count', 0.0, growth=0.5, start=0.2))
    assert got == [(1, 100.0), (2, 200.0), *((n, 200.0 + 150.0 * (n - 2)) for n in range(3, 8))]


def test_a_random_delay_keeps_the_order_also_after_its_end(lockstep):
    got = play(lockstep, faults.Delay('count', 0.0, spread=0.5, duration=0.75), seconds=2.0, seed=4)
    assert [number for number, _ in got] == list(range(1, 21))
    times = [time for _, time in got]
    assert times == sorted(times)
    late = [time - 100.0 * number for number, time in got]
    assert all(0.0 <= one <= 500.0 for one in late)
    assert late[7] > 0.0, 'the first message after the fault does not overtake'
    assert late[-8:] == [0.0] * 8


def test_a_delay_ends_when_its_last_message_has_arrived(lockstep):
    delay = faults.Delay('count', 1.0, start=0.25, duration=0.2)
    got = play(lockstep, delay, seconds=0.6)
    assert got == IN_TIME[:2]
    report = lockstep.report()
    assert f'{delay!r}: over, its last message arrives at 1.4 s, 2 of 2 messages' in report
    lockstep.run_for(1.4)
    # The two that were delayed, and those that wait behind them.
    assert got[2:6] == [(3, 1300.0), (4, 1400.0), (5, 1400.0), (6, 1400.0)]
    total = '2 of 2 messages of /count to /sink and 9 behind them'
    assert [(event.time_ns / 1e9, event.what) for event in lockstep.fault_events] == [
        (0.25, 'begins'),
        (0.45, 'messages 3 to 4 of /count to /sink delayed by 1 s, from 0.3 s to 0.4 s'),
        (0.45, 'is over, its last message arrives at 1.4 s'),
        (1.4, 'messages 5 to 13 of /count to /sink delayed by 0.1 s to 0.9 s, from 0.5 s to 1.3 s'),
        (1.4, f'ends: {total}'),
    ]
    assert f'{delay!r}: ended, {total}' in lockstep.report()


def test_messages_to_a_node_that_was_started_again_are_counted_together(lockstep):
    loss = faults.Loss('count', duration=0.45)
    play(lockstep, loss, faults.Kill('sink', start=0.25, duration=0.1))
    assert whats(lockstep)[-1] == 'ends: 3 of 3 messages of /count to /sink'


def test_the_report_says_which_fault_has_not_begun(lockstep):
    play(lockstep, faults.Loss('count', start=5.0))
    lockstep.finish()
    assert "Loss('count', start=5.0): has not begun, starts at 5 s" in lockstep.report()


def test_reordered_messages_are_overtaken(lockstep):
    got = play(lockstep, faults.Reorder('count', 0.3, 0.15), seconds=2.0, seed=1)
    late = {number for number, time in got if time == 100.0 * number + 150.0}
    in_time = {number for number, time in got if time == 100.0 * number}
    assert late
    assert in_time
    assert late | in_time >= set(range(1, 20))
    assert [number for number, _ in got] != sorted(number for number, _ in got)


def test_duplicates_follow_at_once_or_later(lockstep):
    got = play(
        lockstep,
        faults.Duplicate('count', copies=2, duration=0.15),
        faults.Duplicate('count', seconds=0.03, start=0.25, duration=0.1),
        seconds=0.4,
    )
    assert got == [(1, 100.0)] * 3 + [(2, 200.0), (3, 300.0), (3, 330.0), (4, 400.0)]


def test_a_copy_arrives_before_what_is_published_after_it(lockstep):
    """Both at one time."""
    order = []
    for name in 'ab':
        lockstep.node.create_subscription(Int64, name, lambda m, name=name: order.append(name), 10)
    a, b = (lockstep.node.create_publisher(Int64, name, 10) for name in 'ab')
    lockstep.inject(faults.Duplicate('a', copies=2, node='lockstep'))
    a.publish(Int64())
    b.publish(Int64())
    lockstep.settle()
    assert order == ['a', 'a', 'a', 'b']


def test_the_rate_is_limited(lockstep):
    assert play(lockstep, faults.RateLimit('count', 4.0)) == [
        (1, 100.0),
        (4, 400.0),
        (7, 700.0),
        (10, 1e3),
    ]


def test_a_stale_message_replaces_the_later_ones(lockstep):
    got = play(lockstep, faults.Stale('count', start=0.35, duration=0.3))
    assert got == [*IN_TIME[:3], (3, 400.0), (3, 500.0), (3, 600.0), *IN_TIME[6:]]
    assert whats(lockstep)[1] == 'messages 4 to 6 of /count to /sink changed, from 0.4 s to 0.6 s'


def test_stale_without_a_message_before_repeats_the_first(lockstep):
    assert [number for number, _ in play(lockstep, faults.Stale('count'))] == [1] * 10


# --- Several faults, several subscriptions


def test_faults_of_a_topic_follow_each_other_in_the_order_of_injection(lockstep):
    """The loss is over when the delayed messages reach it."""
    delay, loss = faults.Delay('count', 0.5), faults.Loss('count', duration=0.55)
    assert play(lockstep, delay, loss) == [(number, 100.0 * number + 500.0) for number in range(1, 6)]


def test_the_other_order(lockstep):
    delay, loss = faults.Delay('count', 0.5), faults.Loss('count', duration=0.55)
    assert play(lockstep, loss, delay, seconds=1.5) == [
        (number, 100.0 * number + 500.0) for number in range(6, 11)
    ]


def test_only_the_subscriptions_of_the_named_node_are_affected(lockstep):
    one, two = (lockstep.add(Sink(name)) for name in ('one', 'two'))
    lockstep.inject(faults.Loss('count', node='one'))
    lockstep.add(Source())
    lockstep.run_for(0.3)
    assert one.numbers == []
    assert two.numbers == [0, 1, 2, 3]


def test_the_test_itself_and_observers_receive_everything_unless_named(lockstep):
    heard = lockstep.listen(Int64, 'count')
    observer = lockstep.add(Sink('observer'), observer=True)
    named = lockstep.add(Sink('named'), observer=True)
    sink = lockstep.add(Sink())
    lockstep.inject(faults.Loss('count'), faults.Loss('count', node='named'))
    lockstep.add(Source())
    lockstep.run_for(0.3)
    assert [message.data for message in heard] == observer.numbers == [0, 1, 2, 3]
    assert named.numbers == sink.numbers == []


def test_each_subscription_has_its_own_random_numbers_which_depend_on_nothing_else(lockstep):
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


def test_raw_subscriptions_and_those_with_info_are_affected(lockstep):
    node = lockstep.add(Node('node'))
    raw, infos = [], []
    node.create_subscription(Int64, 'count', raw.append, 10, raw=True)
    node.create_subscription(Int64, 'count', lambda message, info: infos.append((message, info)), 10)
    lockstep.inject(faults.Duplicate('count'))
    lockstep.publish('count', Int64(data=5))
    assert len(raw) == 2
    assert isinstance(raw[0], bytes)
    assert [message.data for message, _ in infos] == [5, 5]
    assert 'source_timestamp' in infos[0][1]


def test_what_is_under_way_to_a_removed_node_is_lost(lockstep):
    sink = lockstep.add(Sink())
    lockstep.inject(faults.Delay('count', 0.5))
    lockstep.add(Source())
    lockstep.run_for(0.3)
    lockstep.remove(sink)
    lockstep.run_for(1.0)
    assert sink.received == []


# --- Events and errors


def test_events_are_published_reported_and_bounded(lockstep):
    events = lockstep.listen(String, 'fault_events')
    play(lockstep, faults.Loss('count', probability=0.5, duration=99.0), seconds=100.0)
    texts = [json.loads(message.data) for message in events]
    assert [(text['time'], text['what']) for text in texts] == [
        (event.time_ns / 1e9, event.what) for event in lockstep.fault_events
    ]
    assert texts[0]['fault'] == "Loss('count', probability=0.5, duration=99.0)"
    assert len(texts) == 201
    assert texts[199]['what'].endswith('(further events of this fault are omitted)')
    assert texts[200]['what'].startswith('ends: ')
    report = lockstep.report()
    assert f"  Loss('count', probability=0.5, duration=99.0): ended, {texts[200]['what'][6:]}" in report
    assert 'events of faults, without the first 181:' in report


def test_a_fault_that_met_nothing_is_an_error(lockstep):
    lockstep.add(Sink())
    lockstep.inject(faults.Loss('cuont'), faults.Loss('count', node='snik'), faults.Loss('count'))
    expected = (
        r"^faults without effect: Loss\('cuont'\): no subscription of /cuont was seen; "
        r"Loss\('count', node='snik'\): no subscription of /snik of /count was seen$"
    )
    with pytest.raises(LockstepError, match=expected):
        lockstep.check_faults()
    lockstep.add(Sink('snik', topic='cuont'))
    lockstep.add(Sink('other', topic='snik'))
    with pytest.raises(LockstepError, match=r"effect: Loss\('count', node='snik'\): no subscription"):
        lockstep.finish()
    lockstep.close()


def test_wrong_arguments_of_inject_are_named(lockstep):
    with pytest.raises(LockstepError, match='inject takes faults, got <class'):
        lockstep.inject(faults.Loss)
    with pytest.raises(LockstepError, match='inject takes faults, got 5'):
        lockstep.inject(5)
    with pytest.raises(LockstepError, match="seed must be an integer, got '0'"):
        lockstep.inject(faults.Loss('count'), seed='0')
    lockstep.run_for(2.0)
    with pytest.raises(LockstepError, match='is over: 2 s have passed since the start'):
        lockstep.inject(faults.Loss('count', duration=1.5))
    assert lockstep.fault_events == []


def test_a_recording_has_what_was_published_and_what_the_faults_did(lockstep, recorded_run):
    play(lockstep, faults.Loss('count', start=0.15, duration=0.2), seconds=0.5)
    recorded_run.finish()
    with open_bag(recorded_run.bag) as bag:
        times = {}
        for connection, time, _ in bag.messages():
            times.setdefault(connection.topic, []).append(time)
    assert len(times['/count']) == 6
    assert times['/fault_events'] == [1_150_000_000, 1_350_000_000, 1_350_000_000]


@pytest.mark.lockstep(args=['--ros-args', '-r', '__ns:=/robot1'])
def test_names_are_in_the_namespace_of_the_test(lockstep):
    sink = lockstep.create(Sink)
    lockstep.create(Source)
    sink.received.clear()
    lockstep.inject(faults.Loss('count', node='sink', duration=0.35), faults.Kill('source', start=0.75))
    lockstep.run_for(1.0)
    assert sink.numbers == [4, 5, 6, 7]
    assert lockstep.find('sink') is lockstep.find('/robot1/sink') is sink


def test_equal_faults_have_different_random_numbers(lockstep):
    half = faults.Loss('count', probability=0.5)
    got = play(lockstep, half, half, seconds=10.0)
    assert 10 < len(got) < 40


def test_faults_of_the_clock_topic_are_refused(lockstep):
    with pytest.raises(LockstepError, match='sets the clocks itself; use TimeJump or ClockPause'):
        lockstep.inject(faults.Loss('/clock'))
    lockstep.run_for(0.1)
    assert lockstep.fault_events == []
