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

"""A recorded run over time: which goal counts when, where the path is broken, which limits hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.bags import changed, odom, start, status, write_bag
from support.ros_messages import goal, goals, twist
from support.runs import RATE, STRAIGHT, drive

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.timeline import seconds, timeline
from diffdrive_jacobian.plots.run_lines import limits

CONTROLLER = {'controller': 'go_to_goal', 'use_goal_heading': False, 'xy_goal_tolerance': 0.05}
TOPICS = {
    'Goals': '/goals',
    'GoalStatus': '/goal_status',
    'Odometry': '/odom',
    'ParameterEvent': '/parameter_events',
    'PoseStamped': '/goal_pose',
    'PoseWithCovarianceStamped': '/start_pose',
    'Twist': '/cmd_vel',
}


def odometry(**how):
    """Return (seconds, message) of the odometry of an arc; arguments as for `drive`."""
    return [(at, one) for at, topic, one in drive(**how) if topic == '/odom']


def run_of(tmp_path, sent, name='run', **parameters):
    """Return the run of (seconds, message); parameters are by node."""
    ordered = sorted(sent, key=lambda one: one[0])
    sent = [(at, TOPICS[type(one).__name__], one) for at, one in ordered]
    by_node = {f'/{node}': values for node, values in parameters.items()}
    return read_run(write_bag(tmp_path / name, sent, parameters=by_node))


# --- Which goal counts


FAR, OTHER = goal(5, 0), goal(7, 0)
WAYPOINTS = goals(goal(0.5, 0.3), goal(1.0, 0))
ON_THE_LINE = goals(goal(0.5, 0), goal(1.0, 0), goal(1.5, 0))
NINTH = goal(5, 0, stamp=9)
UNRECORDED = [
    (11.5, status(1, 11)),
    (12.0, status(4, 11)),
    (13.0, goal(7, 0, stamp=13)),
    (13.0, status(1, 13)),
]
COUNTING = {
    'from when it came until the next': (
        [(11.0, FAR), (12.0, OTHER)],
        [(0.0, -1), (1.0, 0), (2.0, 1)],
    ),
    'missed: until the closest approach': ([(10.0, WAYPOINTS)], [(0.0, 0), (1.0, 1)]),
    'not reached, as the node says': ([(10.0, WAYPOINTS), (10.0, status(2))], [(0.0, 0)]),
    'until the usual tolerance': ([(10.0, ON_THE_LINE)], [(0.0, 0), (0.96, 1), (1.96, 2)]),
    'until the tolerance from when it was set': (
        [
            (10.0, goals(goal(0.5, 0.0), goal(3.0, 0.0))),
            (10.0, changed('/go_to_goal', 'xy_goal_tolerance', 0.05)),
            (10.5, changed('/go_to_goal', 'xy_goal_tolerance', 0.2)),
        ],
        [(0.0, 0), (0.6, 1)],
    ),
    'until it is canceled': (
        [(11.0, FAR), (11.0, status(2)), (11.99, status(5))],
        [(0.0, -1), (1.0, 0), (2.0, -1)],
    ),
    'not one that is refused': (
        [(10.0, FAR), (10.01, status(2)), (11.0, OTHER), (11.01, status(6)), (11.02, status(2))],
        [(0.0, 0)],
    ),
    'until it is replaced': (
        [(10.0, FAR), (10.0, status(1)), (11.0, OTHER), (11.0, status(5)), (11.0, status(1))],
        [(0.0, 0), (1.0, 1)],
    ),
    'until one replaces it that was not recorded': (
        [(10.0, NINTH), (10.0, status(1, 9)), (11.0, status(5, 9)), *UNRECORDED],
        [(0.0, 0), (1.02, -1), (3.0, 1)],
    ),
    'until one comes after it that was not recorded': (
        [(10.0, NINTH), (10.0, status(1, 9)), (11.0, status(4, 9)), *UNRECORDED],
        [(0.0, 0), (1.5, -1), (3.0, 1)],
    ),
}
"""Messages, and `(time, goal)` whenever the goal changes, of a robot at time t at x = t / 2."""


@pytest.mark.parametrize(('messages', 'expected'), COUNTING.values(), ids=COUNTING)
def test_a_goal_counts(tmp_path, messages, expected):
    one = timeline(run_of(tmp_path, [*odometry(**STRAIGHT), *messages]))
    changes = [0, *(np.flatnonzero(np.diff(one.goal)) + 1).tolist()]
    found = [(round(float(one.time[index]), 6), int(one.goal[index])) for index in changes]
    assert found == expected
    assert (np.isnan(one.distance) == (one.goal < 0)).all()


@pytest.mark.parametrize('node', ['go_to_goal', 'renamed'])
def test_parameters_of_the_controller_count_from_when_they_were_set(tmp_path, node):
    extra = [
        (10.0, goal(5.0, 1.0, 1.0)),
        (11.0, changed(f'/{node}', 'use_goal_heading', value=True)),
        (12.0, changed(f'/{node}', 'controller', 'offset_point')),
        (12.0, changed(f'/{node}', 'offset', 0.3)),
    ]
    run = run_of(tmp_path, [*odometry(omega=0.0), *extra], **{node: CONTROLLER})
    one, x = timeline(run), run.odometry.values[:, 0]
    heading, driven = one.time >= 1.0, np.where(one.time >= 2.0, x + 0.3, x)
    assert one.goal_heading_error == pytest.approx(np.where(heading, 1.0, np.nan), nan_ok=True)
    assert one.distance == pytest.approx(np.hypot(5.0 - driven, 1.0))


@pytest.mark.parametrize('extra', [[(10.0, status(2)), (13.9, status(4))], []], ids=['node', 'other'])
def test_a_goal_that_is_only_passed_is_driven_to_until_the_end(tmp_path, extra):
    """It comes near the goal, drives on, and is placed elsewhere before the node reports success."""
    placed = (12.0, start(1.0, 0, 0, seconds=12.0))
    one = timeline(run_of(tmp_path, [*odometry(**STRAIGHT), (10.0, goal(0.5, 0)), placed, *extra]))
    assert one.breaks.tolist() == [100]
    assert not np.isnan(one.distance).any()


@pytest.mark.parametrize(
    ('extra', 'within'),
    [
        ([(10.0, status(2)), (13.0, status(4)), (13.5, start(0.625, 0, 0, seconds=13.5))], 146),
        # Without a node that says so: from the first odometry within the tolerance.
        ([], 73),
    ],
)
def test_a_goal_is_reached_when_the_node_says_so(tmp_path, extra, within):
    """Until then it has a direction, also after it was passed; then until a reset a distance."""
    back = odometry(count=100, v=-0.25, omega=0.0, begin=12.0)
    for index, (_, one) in enumerate(back):
        one.pose.pose.position.x = 1.0 - 0.25 * index / RATE
    sent = [*odometry(count=100, **STRAIGHT), *back, (10.0, goal(0.75, 0))]
    one = timeline(run_of(tmp_path, [*sent, *extra]))
    assert np.flatnonzero(np.isnan(one.bearing_error))[0] == within
    assert np.flatnonzero(np.isnan(one.distance)).tolist() == list(range(175, 200 if extra else 175))


# --- Time


@pytest.mark.parametrize('delay', [0.5, 1.7e9])
def test_what_has_no_stamp_counts_by_the_recorders_clock(tmp_path, delay):
    extra = [(12.0 + delay, twist(0.1, 0.2)), (11.0 + delay, goal(1, 1))]
    run = run_of(tmp_path, [*odometry(delay=delay), *extra])
    assert seconds(run, run.cmd_vel) == pytest.approx([2.0], abs=1e-6)
    assert timeline(run).time == pytest.approx(np.arange(200) / RATE, abs=1e-9)
    assert np.flatnonzero(timeline(run).goal == 0)[0] in (50, 51)


def test_the_path_is_broken_where_the_odometry_is_reset(tmp_path):
    still = [(14.0 + k / RATE, odom(5, 5, 0, seconds=14.0 + k / RATE)) for k in range(9)]
    half = odometry(count=50, **STRAIGHT)
    cases = {
        'placed, elsewhere, and back in time': (
            [
                *odometry(count=100),
                (12.0, start(0, 0, 0, seconds=12.0)),
                *odometry(count=100, begin=12.0),
                *still,
                (14.2, odom(5, 5, 0, seconds=1.0)),
            ],
            [100, 200, 209],
        ),
        'a message of that time may be from before': (
            [
                *half,
                (11.0, odom(0.5, 0, 0, seconds=11.0)),
                (11.0, start(0.52, 0, 0, seconds=11.0)),
                (11.02, odom(0.52, 0, 0, seconds=11.02)),
            ],
            [51],
        ),
        'a teleport': ([*half, *odometry(count=50, begin=11.0, **STRAIGHT)], [50]),
        'not a gap': ([one for one in odometry(**STRAIGHT) if not 10.5 < one[0] < 12.5], []),
    }
    for name, (sent, breaks) in cases.items():
        assert timeline(run_of(tmp_path, sent, name)).breaks.tolist() == breaks, name


# --- Limits


def test_limits_are_the_narrowest_of_the_nodes_from_when_they_were_set(tmp_path):
    unlimited = dict.fromkeys(('angular.z.max_velocity', 'angular.z.min_velocity'), math.nan)
    run = run_of(
        tmp_path,
        [*odometry(), (11.0, changed('/virtual_robot', 'max_wheel_velocity', 3.0))],
        virtual_robot={
            'linear.x.max_velocity': 0.22,
            'linear.x.min_velocity': -0.1,
            'max_wheel_velocity': 6.67,
            **unlimited,
        },
        go_to_goal={'angular.z.max_velocity': 1.0},
        wheel_bridge={'max_wheel_velocity': 9.0},
    )
    found = limits(timeline(run))
    assert {name: bounds[:, 0, 1].tolist() for name, bounds in found.items()} == {
        'v': [-0.1, 0.22],
        'omega': [-1.0, 1.0],
        'right': [-6.67, 6.67],
        'left': [-6.67, 6.67],
    }
    changes = np.array([[0.0, 6.67], [1.0, 3.0], [199 / RATE, 3.0]])
    assert found['right'][1] == pytest.approx(changes, abs=1e-9)
    run = run_of(tmp_path, odometry(count=9), 'unlimited', virtual_robot=unlimited)
    assert all(np.isnan(bounds[..., 1]).all() for bounds in limits(timeline(run)).values())
