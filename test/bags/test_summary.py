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

"""A run in a few numbers, and the table of several."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from support.bags import changed, odom, status
from support.ros_messages import goal, goals, path
from support.runs import STRAIGHT, run_of

from diffdrive_jacobian.bags.summary import summary, table_of
from diffdrive_jacobian.bags.timeline import timeline

pytestmark = pytest.mark.slow
ONE = goal(0.5, 0.0)
ALONG = path((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
TOPICS = {
    'GoalStatus': '/goal_status',
    'Goals': '/goals',
    'ParameterEvent': '/parameter_events',
    'Path': '/path',
    'PoseStamped': '/goal_pose',
}


def timeline_of(tmp_path, *messages, parameters=None, truth=()):
    """Return the timeline of a run of a robot that is at x = t / 2 at time t, for 4 s."""
    tmp_path.mkdir(exist_ok=True)
    sent = [*truth, *((at, TOPICS[type(one).__name__], one) for at, one in messages)]
    return timeline(run_of(tmp_path, sent, parameters=parameters, **STRAIGHT))


def summed(*given, **options):
    """Summarise such a run."""
    return summary(timeline_of(*given, **options))


@pytest.mark.parametrize(
    ('messages', 'outcome', 'seconds', 'length'),
    [
        ([], 'no goal', 3.98, 1.99),
        # By the node, with or without what came before and after.
        ([(10.5, ONE), (10.5, status(2)), (11.0, status(4))], 'arrived', 0.5, 0.25),
        ([(10.0, ONE), (10.0, status(2)), (12.0, status(5))], 'canceled', 2.0, 1.0),
        ([(10.0, ONE), (10.0, status(2)), (12.0, status(6))], 'aborted', 2.0, 1.0),
        ([(10.0, goal(9, 0)), (10.0, status(2))], 'not arrived', 3.98, 1.99),
        ([(11.0, ONE), (11.0, status(6))], 'refused', 3.98, 1.99),
        # The last one counts, from the first on.
        (
            [
                *((10.0, ONE), (10.0, status(2)), (11.0, status(4))),
                *((12.0, goal(9, 0)), (12.0, status(2)), (13.0, status(5))),
            ],
            'canceled',
            3.0,
            1.5,
        ),
        # By the tolerance, where nobody says.
        ([(10.0, ONE)], 'arrived', 0.96, 0.48),
        ([(10.0, goal(0.5, 0.5))], 'not arrived', 3.98, 1.99),
        ([(10.0, goals(ONE, goal(1.0, 0.0)))], 'arrived', 1.96, 0.98),
        ([(10.0, ALONG)], 'arrived', 1.96, 0.98),
        ([(10.0, path((0, 0, 0), (1, 1, 0)))], 'not arrived', 3.98, 1.99),
        # After the last odometry.
        ([(20.0, ONE)], 'not arrived', 0.0, 0.0),
    ],
)
def test_the_outcome_of_the_last_goal_or_path(tmp_path, messages, outcome, seconds, length):
    found = summed(tmp_path, *messages)
    assert found.outcome == outcome
    assert (found.seconds, found.length) == pytest.approx((seconds, length), abs=1e-6)
    words = {'no goal': 'no goal, ', 'refused': 'refused, ', 'not arrived': 'not arrived within '}
    expected = f'{words.get(outcome, f"{outcome} after ")}{seconds:.1f} s, {length:.2f} m driven'
    assert found.described == expected


def test_greatest_values_are_those_of_the_time_between_start_and_end(tmp_path):
    found = summed(tmp_path, (10.0, goal(1.0, 0.5)), (10.0, status(2)), (11.0, status(5)))
    assert (found.v, found.omega) == (0.5, 0.0)
    assert found.bearing_error == pytest.approx(math.atan2(0.5, 0.5), abs=0.01)
    assert found.distance == pytest.approx(math.hypot(0.5, 0.5), abs=0.02)
    assert math.isnan(found.across)
    assert math.isnan(found.late)
    # A path beside which it drives, too slowly for its times: they wait.
    beside = path((0.0, 0.1, 0.0), (4.0, 0.1, 0.0), times=[0.0, 4.0])
    found = summed(tmp_path / 'path', (10.0, beside), (10.0, status(2)))
    assert found.across == pytest.approx(0.1)
    # After 0.6 s it is 0.3 m behind.
    assert found.late == pytest.approx(3.98 / 2 - 0.3, abs=0.1)
    assert math.isnan(found.distance)


def test_a_path_that_is_sent_again_goes_on(tmp_path):
    """As planners do; also its times."""
    along = path((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), times=[0.0, 4.0])
    sent = [(10.0, along), (10.0, status(2)), (11.0, along), (11.0, status(5)), (11.0, status(2))]
    one = timeline_of(tmp_path, *sent)
    assert len(one.paths) == 1
    np.testing.assert_allclose(one.along[1:-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(one.late[1:-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(one.elapsed[1:-1], one.time[1:-1], atol=1e-9)


def test_the_law_is_the_one_that_drove_with_the_gains_that_it_had(tmp_path):
    own = {'controller': 'go_to_goal', 'path_controller': 'kanayama', 'kp': 1.0, 'kv': 2}
    own |= {'k_x': 3.0, 'k_y': 4.0, 'k_theta': 'x'}
    reached = [(11.0, ONE), (11.0, status(2)), (12.0, status(4))]
    along = [(10.0, ALONG), (10.0, status(2)), (12.0, status(4))]
    # Before the first goal, meanwhile, and after the end.
    before, after = changed('/go_to_goal', 'kp', 5.0), changed('/go_to_goal', 'controller', 'pose')
    changes = [(11.1 + 0.01 * k, changed('/go_to_goal', 'kp', 2.0 + k)) for k in range(40)]
    gains = {'kp': '1 1/s', 'kv': '2 1/s'}
    kanayama = {'k_x': '3 1/s', 'k_y': '4 1/m^2'}
    for number, (messages, expected) in enumerate(
        [
            (reached, {'go_to_goal': gains}),
            ([(10.5, before), *reached, (12.5, after)], {'go_to_goal': {**gains, 'kp': '5 1/s'}}),
            ([*reached, changes[0]], {'go_to_goal': {**gains, 'kp': '1 1/s, then 2 1/s'}}),
            ([*reached, *changes], {'go_to_goal': {**gains, 'kp': '1 1/s, ..., 41 1/s'}}),
            (along, {'kanayama': kanayama}),
            ([], {}),
            # A path after a goal, and a goal after a path.
            (
                [*along, (12.5, goal(9, 0)), (12.5, status(2))],
                {'kanayama': kanayama, 'go_to_goal': gains},
            ),
        ]
    ):
        found = summed(tmp_path / str(number), *messages, parameters={'/go_to_goal': own})
        assert [(law, dict(has)) for law, has in found.laws.items()] == [*expected.items()]
    assert summed(tmp_path / 'bare', *reached).laws == {}


def test_the_true_distance_says_whose_opinion_the_outcome_is(tmp_path):
    """By ground truth it stopped earlier."""
    truth = [
        (at, '/ground_truth', odom(min(0.4, 0.5 * (at - 10.0)), 0.0, 0.0, seconds=at))
        for at in np.arange(10.0, 12.0, 0.02).tolist()
    ]
    found = summed(tmp_path, (10.0, ONE), (10.0, status(2)), (11.0, status(4)), truth=truth)
    assert found.true_distance == pytest.approx(0.1)
    assert found.described == 'by odometry arrived after 1.0 s, 0.50 m driven; truly 0.10 m away'
    assert 'truly' in table_of(['run'], [found])[0]
    found = summed(tmp_path / 'late', (10.0, ONE), (10.0, status(2)), (11.0, status(5)), truth=truth)
    assert found.described == 'canceled after 1.0 s, 0.50 m driven; truly 0.10 m away'


def test_the_table_has_the_columns_that_a_run_has(tmp_path):
    first = summed(tmp_path / 'a', (10.0, ONE), (10.0, status(2)), (11.0, status(4)))
    second = summed(tmp_path / 'b', (10.0, ALONG), (10.0, status(2)))
    lines = table_of(['first', 'b'], [first, second])
    assert [re.split('  +', line.strip()) for line in lines] == [
        [
            *('run', 'outcome', 'time', 'length', 'to the goal'),
            *('max across', 'max bearing error', 'max v', 'max omega'),
        ],
        ['first', 'arrived', '1.0 s', '0.50 m', '0.000 m', '0.00 rad', '0.50 m/s', '0.00 rad/s'],
        ['b', 'not arrived', '4.0 s', '1.99 m', '0.000 m', '0.50 m/s', '0.00 rad/s'],
    ]
    assert lines[1].rindex('m/s') == lines[2].rindex('m/s')
    # A goal after the last odometry: nothing was driven to it.
    assert 'nan' not in ''.join(table_of(['late'], [summed(tmp_path / 'late', (20.0, ONE))]))
