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

"""What each property of messages alone allows, and what violates it."""

from __future__ import annotations

from math import inf, nan

import pytest
from property_nodes import Scene, goal_at, odometry_at, status, twist
from support.lockstep_nodes import ABORTED, ACCEPTED, CANCELED, EXECUTING, SUCCEEDED
from support.ros_messages import path

from diffdrive_jacobian.properties import (
    AccelerationWithin,
    NeverFasterThan,
    NoStaleGoals,
    PoseFinite,
    ReachesGoal,
    Settles,
    StatusProtocol,
    StaysNear,
    StaysOnPath,
    StaysWithin,
)
from diffdrive_jacobian.testing import PropertyViolation

FAST = NeverFasterThan(0.5, 2.0)
ACCELERATION = AccelerationWithin(1.0, 2.0)
SQUARE = StaysWithin((0.0, 1.0), (-1.0, 1.0))
CORNER = [(0, 0), (1, 0), (1, 1)]
ARRIVES = [goal_at(1.0), 1.0, odometry_at(0.5, v=0.5), 0.5, odometry_at(0.96), 3.0]
ON_PATH, IN_TIME = StaysOnPath(0.1), StaysOnPath(0.1, within=1.0)
FROM_AFTER = StaysOnPath(0.1, after=0.25)
STRAIGHT = path((0, 0), (1, 0))


def commands(*twists):
    """Return commands at a period of 0.1 s."""
    return [event for one in twists for event in (twist(*one), 0.1)]


def statuses(*sequence):
    """Return the status of goals: a number, or with the stamp of another goal."""
    return [status(*one) if isinstance(one, tuple) else status(one) for one in sequence]


def accepted(*stamps):
    """Return the status of goals with these stamps. That of an EXECUTING one does not count."""
    pairs = ((number, stamp) for number, stamp in enumerate(stamps))
    return [
        one
        for number, stamp in pairs
        for one in (status(EXECUTING, 1, number), status(ACCEPTED, stamp, number))
    ]


KEPT = [
    (FAST, commands((0.5, 2.0), (-0.5, -2.0))),
    # The limit, a stop, and a sequence that is early by the slack.
    (ACCELERATION, commands((0.1, 0.2), (0.2, 0.4), (0.3, 0.2), (0.0, 0.0), (0.1,), (0.2,), (0.1,))),
    (ReachesGoal(2.0), ARRIVES),
    (
        ReachesGoal(2.0),
        [goal_at(1.0), 1.0, goal_at(2.0), odometry_at(2.0, v=0.02), 1.9, odometry_at(2.0)],
    ),
    *(
        (one, [odometry_at(0), goal_at(1), 1.0, odometry_at(1.1), 1.0, goal_at(3), odometry_at(3), 1.5])
        for one in (
            Settles(1.0, 0.1),
            StaysWithin((0, 3), (0, 0)),
            StaysNear([(0.0, 0.0), (3.0, 0.0)], 0.0),
            StaysNear([(1.0, 0.0)], 2.0),
            PoseFinite(),
        )
    ),
    # A path replaces a goal.
    *(
        (one, [goal_at(1.0), STRAIGHT, odometry_at(0.5), 1.5])
        for one in (ReachesGoal(1.0), Settles(1.0, 0.1))
    ),
    (StatusProtocol(), statuses(ACCEPTED, ACCEPTED, EXECUTING, EXECUTING, ABORTED, (ABORTED, 2))),
    (StatusProtocol(), statuses(ACCEPTED, CANCELED, (ACCEPTED, 2), (EXECUTING, 2), (SUCCEEDED, 2))),
    (StatusProtocol(), statuses(ACCEPTED, EXECUTING, (ABORTED, 2), EXECUTING, SUCCEEDED)),
    (NoStaleGoals(), accepted(0, 0, 2, 0, 3)),
    # The distance counts after the first metres.
    (FROM_AFTER, [STRAIGHT, odometry_at(0.0, 1.0), odometry_at(0.5, 0.1), 0.1]),
    # A path that is replaced does not count.
    *(
        (ON_PATH, [STRAIGHT, other, odometry_at(0.0, 9.0), 0.1])
        for other in (goal_at(1.0), path((0, 9), (1, 9)), path())
    ),
]
VIOLATED = [
    *(
        (FAST, commands(one), '/cmd_vel: v ')
        for one in ((0.501,), (-0.501,), (0.0, -2.01), (nan,), (0.0, inf))
    ),
    *(
        (ACCELERATION, events, r'changes of 1 m/s and 2 rad/s per second|finite')
        for events in (
            commands((0.11,)),
            commands((0.0, 0.21)),
            commands((0.05,), (0.1,), (0.31,)),
            commands((0.1,), (0.2,), (-0.1,)),
            commands((0.1,), (nan,)),
            commands(*[(0.0,)] * 20, (0.11,)),
        )
    ),
    # Twice the limit is found even with much slack.
    (AccelerationWithin(1.0, 2.0, slack=0.5), commands((0.2,), (0.4,), (0.6,), (0.8,), (1.0,)), '1 m/s'),
    # A stop is an acceleration where it is not allowed.
    (AccelerationWithin(1.0, 2.0, stops=False), commands((0.1,), (0.2,), (0.3,), (0.0,)), '1 m/s'),
    (ReachesGoal(1.4), ARRIVES, r'1.5 s after .* the robot is 0.5 m from the goal at x 1 m, y 0 m'),
    (ReachesGoal(2.0, tolerance=0.03), ARRIVES, 'allowed: within 0.03 m and standing'),
    (ReachesGoal(1.0), [goal_at(1.0), 1.5], 'there was no odometry on /odom'),
    (ReachesGoal(1.0), [odometry_at(1.0, v=0.1), goal_at(1.0), 1.5], r'robot is 0 m .* v 0.1 m/s'),
    # A path that controllers refuse replaces nothing.
    (ReachesGoal(1.0), [goal_at(1.0), path((1, 0)), 1.5], 'there was no odometry on /odom'),
    # It creeps.
    (ReachesGoal(1.0), [goal_at(1.0), odometry_at(1.0, v=0.02), 1.5], r'robot is 0 m .* v 0.02 m/s'),
    (ReachesGoal(1.0, yaw_tolerance=0.1), [goal_at(1.0), odometry_at(1.0, theta=3.1), 2.0], '3.1 rad'),
    (ReachesGoal(2.0), [goal_at(1.0), odometry_at(0.0), 1.0], r'the run ended 1 s after .* run for 2 s'),
    (Settles(1.0, 0.1), [goal_at(1.0), 1.1, odometry_at(0.5), 0.1], '0.5 m from the'),
    (Settles(1.0, 0.1), [goal_at(1.0), odometry_at(0.5), 1.5], '0.5 m from the'),
    (
        Settles(1.0, 0.1),
        [goal_at(1.0), odometry_at(1.0), 1.5, odometry_at(1.0), 1.0, odometry_at(1.11), 0.1],
        r'2.5 s after the goal was published the robot is 0.11 m .* allowed: 0.1 m',
    ),
    (Settles(1.0, 0.1), [goal_at(1.0), odometry_at(1.0), 0.5], 'the run ended 0.5 s after the goal'),
    (SQUARE, [odometry_at(1.01)], 'allowed: x from 0 m to 1 m, y fr'),
    (SQUARE, [odometry_at(nan)], 'x nan m'),
    (StaysNear(CORNER, 0.1), [odometry_at(1.0, 1.2)], r'at most 0.1 m from the path, not 0.2 m'),
    (PoseFinite(), [odometry_at(inf)], 'x inf m'),
    (PoseFinite(), [odometry_at(0.0, v=nan)], 'v nan m/s'),
    (PoseFinite(), [odometry_at(2e6)], 'a position of at most 1e'),
    (StatusProtocol(), statuses(EXECUTING), r'stamp 1.0+ s .* as its first status; allowed: ACC'),
    (StatusProtocol(), statuses(ACCEPTED, SUCCEEDED), 'after ACCEPTED; allowed: ACCEPTED, EXECUTING, '),
    (StatusProtocol(), statuses(ACCEPTED, EXECUTING, ACCEPTED), 'ACCEPTED of .* after EXECUTING'),
    (StatusProtocol(), statuses(ABORTED, ABORTED), 'ABORTED of .* was ABORTED already; allowed: noth'),
    (StatusProtocol(), statuses(ABORTED, ACCEPTED), 'ACCEPTED of .* was ABORTED already'),
    (StatusProtocol(), statuses(ACCEPTED, (ACCEPTED, 2)), 'while the goal before is ACCEPTED'),
    (StatusProtocol(), statuses(17), '17 of .* as its first status'),
    (NoStaleGoals(), accepted(1, 3, 2), r'ACCEPTED of the goal with stamp 2\.0+ s, after one'),
    (NoStaleGoals(), accepted(1, 2, 2), r'ACCEPTED of the goal with stamp 2\.0+ s, after one'),
    (FROM_AFTER, [STRAIGHT, odometry_at(0.0, 1.0), odometry_at(0.5, -0.1001)], 'allowed'),
    (FROM_AFTER, [STRAIGHT, odometry_at(nan, 0.0)], 'allowed'),
    (
        IN_TIME,
        [odometry_at(0.0), STRAIGHT, odometry_at(0.5), 1.1],
        ' s: 1 s after the path was published',
    ),
    (IN_TIME, [STRAIGHT, odometry_at(0.2), 0.5], r'the run ended 0.5 s after the path .* 0.2 m along'),
]


def test_what_is_allowed_is_no_violation(lockstep):
    scene = Scene(lockstep)
    for required, events in KEPT:
        lockstep.require(required)
        scene(*events)


def test_violations_are_found_and_explained(lockstep):
    scene = Scene(lockstep)
    for required, events, words in VIOLATED:
        lockstep.require(required)
        with pytest.raises(PropertyViolation, match=words) as caught:
            scene(*events)
        assert caught.value.property == required
