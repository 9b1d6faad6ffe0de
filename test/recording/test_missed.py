"""Missing messages, counted from the numbers of the received ones, and those that are received twice."""

from __future__ import annotations

from unittest import mock

from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.recording import reception as missed
from diffdrive_jacobian.recording.reception import MissedMessages
from diffdrive_jacobian.ros.rclpy_internals import ReceivedMessage


def message(number, publisher=0, sent=0):
    return ReceivedMessage(b'', bytes([publisher]), number, sent, 0)


def count(*numbers):
    """Return how many are missing of one publisher."""
    counter = MissedMessages()
    assert all(counter.received(message(number)) for number in numbers)
    return counter.count


def test_gaps_are_counted():
    assert count() == 0
    assert count(1, 2, 3) == 0
    assert count(7, 8, 12, 13, 20) == 3 + 6


def test_what_came_before_the_first_message_is_not_counted():
    assert count(1_000, 1_001) == 0


def test_a_publisher_that_is_restarted_loses_nothing():
    counter = MissedMessages()
    for publisher, number in ((0, 500), (0, 501), (1, 1), (1, 2), (1, 5)):
        counter.received(message(number, publisher))
    assert counter.count == 2


def test_a_message_that_comes_after_the_end_shows_what_was_missed_before():
    counter = MissedMessages()
    counter.received(message(5))
    for number, publisher in ((9, 0), (20, 0), (7, 1), (9, 1)):
        counter.received_late(message(number, publisher))
    assert counter.count == 3
    # From another subscription.
    assert counter.received(message(7))
    assert counter.count == 2


def test_messages_without_numbers_are_told_apart_by_their_times():
    counter = MissedMessages()
    new = [counter.received(message(None, sent=time)) for time in (5, 9, 5, 3, 9)]
    assert new == [True, True, False, True, False]
    assert counter.count == 0


MANY = 100


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 40))), st.sampled_from([2, 3, MANY]))
def test_each_message_is_new_once_and_all_gaps_add_up(received, runs):
    """With few runs that are kept, a message in an old gap may count as known."""
    counter, seen = MissedMessages(), [set(), set(), set()]
    with mock.patch.object(missed, 'MAX_RUNS', runs):
        for publisher, number in received:
            new = counter.received(message(number, publisher))
            before = number in seen[publisher]
            assert not (new and before)
            if new:
                seen[publisher].add(number)
            elif runs == MANY:
                assert before
    assert counter.count == sum(max(one) - min(one) + 1 - len(one) for one in seen if one)
