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

"""The follower of goals agrees with what the controller did, for every short sequence of events."""

from __future__ import annotations

from itertools import product

import pytest
from action_msgs.msg import GoalStatus

from diffdrive_jacobian.messages.goal_status import (
    ACTIVE,
    ENDED,
    FOLLOWING,
    MAX_KNOWN,
    UNSTAMPED,
    Fate,
    GoalFollower,
    GoalState,
)

ACCEPTED, EXECUTING = GoalState.ACCEPTED, GoalState.EXECUTING
SUCCEEDED, CANCELED, ABORTED = ENDED
A, B = (1, 0), (2, 0)
ENDS = {
    'arrival': (SUCCEEDED, Fate.SUCCEEDED),
    'cancel': (CANCELED, Fate.CANCELED),
    'overflow': (ABORTED, Fate.ABORTED),
}
EVENTS = ('goal', 'bad goal', 'odometry', *ENDS)


class Controller:
    """What a controller does with its goals, 0, 1, 2, ..., and which statuses it publishes."""

    def __init__(self):
        self.fates = []
        self.active = None
        self.executing = False

    def take(self, event):
        """Let something happen; return the statuses that are published, `(goal, state)`."""
        self.published = []
        if event == 'goal':
            if self.active is not None:
                self._end(CANCELED, Fate.REPLACED)
            self.active, self.executing = len(self.fates), False
            self.fates.append(Fate.ACTIVE)
            self.published.append((self.active, ACCEPTED))
        elif event == 'bad goal':
            self.published.append((len(self.fates), ABORTED))
            self.fates.append(Fate.REFUSED)
            if self.active is not None:
                self.published.append((self.active, EXECUTING if self.executing else ACCEPTED))
        elif self.active is not None:
            if event == 'odometry' and not self.executing:
                self.executing = True
                self.published.append((self.active, EXECUTING))
            elif event in ENDS:
                self._end(*ENDS[event])
        return self.published

    def _end(self, state, fate):
        self.published.append((self.active, state))
        self.fates[self.active], self.active = fate, None


@pytest.mark.parametrize(
    ('stamped', 'early'),
    [(True, False), (True, True), (False, False)],
    ids=['', 'early', 'unstamped'],
)
def test_every_goal_has_the_fate_that_the_controller_gave_it(stamped, early):
    """Goals have stamps, all different, or none; their statuses may be received before them."""
    for events in product(EVENTS, repeat=4):
        controller, follower, goals = Controller(), GoalFollower(), []
        for event in events:
            number = len(goals)
            stamps = [(goal + 1, 0) if stamped else UNSTAMPED for goal in range(number + 1)]
            statuses, sent = controller.take(event), 'goal' in event
            if sent and not early:
                goals.append(follower.sent(number, stamps[number]))
            for goal, state in statuses:
                follower.reported(state, stamps[goal])
            if sent and early:
                goals.append(follower.sent(number, stamps[number]))
            driving = None if follower.driving is None else follower.driving.goal
            assert driving == controller.active, events
            fates = controller.fates
            if early:
                # When the older goal ended, nothing was known of the later one.
                fates = [Fate.CANCELED if one is Fate.REPLACED else one for one in fates]
            assert [one.fate for one in goals] == fates, events


@pytest.mark.parametrize(
    ('events', 'expected'),
    [
        # A latched status of a goal that nobody here has sent.
        ([(SUCCEEDED, A)], {}),
        ([(EXECUTING, A)], {}),
        # The latched status of another goal without a stamp is not that of a new one.
        ([(SUCCEEDED, UNSTAMPED), ('x', UNSTAMPED)], {'x': Fate.WAITING}),
        ([('x', UNSTAMPED), (EXECUTING, UNSTAMPED), (SUCCEEDED, UNSTAMPED), ('y', UNSTAMPED)],
         {'x': Fate.SUCCEEDED, 'y': Fate.WAITING}),
        # Its status is received before the next goal without a stamp.
        ([('x', UNSTAMPED), (SUCCEEDED, UNSTAMPED), (ACCEPTED, UNSTAMPED), ('y', UNSTAMPED)],
         {'x': Fate.SUCCEEDED, 'y': Fate.ACTIVE}),
        # A status was lost.
        ([('x', A), (EXECUTING, A), ('y', B), (EXECUTING, B)], {'x': Fate.REPLACED, 'y': Fate.ACTIVE}),
        # Statuses that are no news, late, or of nobody.
        ([('x', A), (0, A), (77, A), (-1, A)], {'x': Fate.WAITING}),
        ([('x', A), (EXECUTING, A), (EXECUTING, B)], {'x': Fate.REPLACED}),
        ([('x', A), (ACCEPTED, A), (CANCELED, A), (ACCEPTED, A)], {'x': Fate.ACTIVE}),
        # The controller drives to the first goal until it answers the second one.
        ([('x', A), (ACCEPTED, A), ('y', B), (ABORTED, A)], {'x': Fate.REPLACED, 'y': Fate.WAITING}),
        ([('x', A), (ACCEPTED, A), ('y', B), (ABORTED, B), (ABORTED, A)],
         {'x': Fate.ABORTED, 'y': Fate.REFUSED}),
        # Equal stamps: a goal that is replaced may be reported as ABORTED, too.
        ([('x', A), (EXECUTING, A), ('y', A), (ABORTED, A), (ACCEPTED, A)],
         {'x': Fate.REPLACED, 'y': Fate.ACTIVE}),
        ([('x', A), (EXECUTING, A), ('y', A), (ABORTED, A), (EXECUTING, A)],
         {'x': Fate.ACTIVE, 'y': Fate.REFUSED}),
    ],
)  # fmt: skip
def test_fates(events, expected):
    follower, goals = GoalFollower(), {}
    for one, stamp in events:
        if isinstance(one, str):
            goals[one] = follower.sent(one, stamp)
        else:
            follower.reported(one, stamp)
    assert {name: goal.fate for name, goal in goals.items()} == expected


def test_each_change_of_a_fate_is_returned_once():
    follower = GoalFollower()
    goal = follower.sent('goal', A)
    states = [ACCEPTED, ACCEPTED, EXECUTING, SUCCEEDED, SUCCEEDED]
    changes = [follower.reported(state, A, time) for time, state in enumerate(states)]
    assert changes == [goal, None, None, goal, None]
    assert (goal.state, goal.since) == (SUCCEEDED, 4)


def test_only_the_last_stamps_are_remembered():
    follower = GoalFollower()
    for second in range(3 * MAX_KNOWN):
        follower.sent(second, (second, 1))
        follower.reported(EXECUTING, (second, 1))
    newest, oldest = 3 * MAX_KNOWN - 1, 2 * MAX_KNOWN
    for second, goal in ((oldest, oldest), (newest, newest), (oldest - 1, None)):
        assert follower.reported(SUCCEEDED, (second, 1)).goal == goal
    # One that is used again is the newest one.
    follower.sent('again', (oldest + 1, 1))
    for second in range(1, MAX_KNOWN):
        follower.sent(second, (newest + second, 1))
    assert follower.reported(ACCEPTED, (oldest + 1, 1)).goal == 'again'


def test_states_are_those_of_action_msgs_and_either_active_or_ended():
    for state in GoalState:
        assert getattr(GoalStatus, f'STATUS_{state.name}') == state
    assert len(GoalState) == sum(name.startswith('STATUS_') for name in dir(GoalStatus))
    assert {*ACTIVE, *ENDED, GoalState.UNKNOWN} == set(GoalState) == set(FOLLOWING)
    assert all(state.active != state.ended for state in GoalState if state)
    assert not any(FOLLOWING[state] for state in ENDED)
    assert [state.word for state in ENDED] == ['arrived', 'canceled', 'aborted']
