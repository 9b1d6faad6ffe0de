"""Missing messages, counted from the sequence numbers of the received ones."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.recording.missed import MissedMessages


def missed(numbers, publishers=1):
    counter = MissedMessages(lambda: publishers)
    for number in numbers:
        counter.received(number)
    return counter.count


def test_gaps_of_one_publisher_are_counted():
    assert missed([]) == 0
    assert missed([1, 2, 3]) == 0
    assert missed([7, 8, 12, 13, 20]) == 3 + 6


def test_what_came_before_the_first_message_is_not_counted():
    assert missed([1_000, 1_001]) == 0


def test_a_publisher_that_is_restarted_loses_nothing():
    assert missed([500, 501, 1, 2, 3, 5]) == 1
    # Also when its numbers reach those of the one before.
    assert missed([3, 4, *range(1, 5), 6, 7]) == 1


def test_a_second_publisher_is_not_taken_for_a_gap():
    assert missed([1, 2, 9_000, 3, 9_001, 4, 9_002], publishers=2) == 0


def test_a_silent_publisher_hides_one_gap_at_most():
    assert missed([1, 2, 5, 6, 9], publishers=2) == 2


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 50), min_size=1, max_size=4),
    st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=60),
)
def test_what_several_publishers_lost_adds_up(starts, events):
    """Each event is a message of one of them that arrives or not.

    In the end one message of each arrives, the largest number first. One that continues the numbers of
    another publisher would hide a gap, as a silent publisher does.
    """
    last = [start + 1 for start in starts]
    # The first messages must not continue each other's numbers.
    numbers, lost = sorted(last, reverse=True), 0
    for event, arrives in events:
        publisher = event % len(starts)
        last[publisher] += 1
        if arrives:
            numbers.append(last[publisher])
        else:
            lost += 1
    numbers += sorted((one + 1 for one in last), reverse=True)
    assert missed(numbers, len(starts)) == lost
