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

"""Bags as the numbers of a run: what was sent is what is read, and what is no bag is told."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.bags import SECOND, changed, odom, start, status, write_bag
from support.raw_bags import channel
from support.ros_messages import (
    goal,
    goals,
    joint_command,
    path,
    spoiled,
    twist,
    twist_stamped,
)
from support.runs import sample

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.bags.run import COLUMNS
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.errors import InterruptionError
from diffdrive_jacobian.messages.codecs import FaultEvent
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS

# --- What was sent is what is read


@pytest.mark.parametrize(('namespace', 'storage'), [('', 'mcap'), ('/fleet/robot1', 'sqlite3')])
def test_every_series_holds_what_was_sent(tmp_path, namespace, storage):
    sent = [
        (1.0, 'start_pose', start(0.5, 0.25, -1.0, seconds=0.9)),
        (1.1, 'odom', odom(0.1, 0.2, 0.3, 0.4, 0.5, seconds=1.05)),
        (1.2, 'cmd_vel', twist(0.6, -0.7) if not namespace else twist_stamped(0.6, -0.7, 0)),
        (1.3, 'cmd_vel_out', twist_stamped(0.8, 0.9, 1_250_000_000)),
        (1.4, 'joint_command', joint_command(3.0, 4.0)),
        (1.5, 'joint_states', joint_command(5.0, 6.0, 1_450_000_000)),
        (1.6, 'goal_pose', goal(1.0, 2.0, 0.5, stamp=1)),
        (1.7, 'goals', goals(goal(3.0, 4.0), goal(5.0, 6.0, -0.5), stamp=7)),
        (1.75, 'path', path((0, 1), (2, 3, 0.5), stamp=8, times=[5.0, 6.5])),
        (1.76, 'path', path((4, 5), (6, 7), stamp=9)),
        (1.8, 'goal_status', status(4, seconds=7)),
        (1.9, 'odom', odom(-0.1, -0.2, 3.0, seconds=1.85)),
    ]
    named = [(at, f'{namespace}/{topic}', message) for at, topic, message in sent]
    # Of other types or names.
    named += [(1.0, '/r1/odom', twist(0, 0)), (2.0, '/r1/cmd_vel', String()), (3.0, '/text', String())]
    run = read_run(write_bag(tmp_path / 'bag', named, storage=storage))

    def holds(series, received, stamps, values):
        assert (series.received / SECOND).tolist() == pytest.approx(received, abs=1e-12)
        assert (series.stamps / SECOND).tolist() == pytest.approx(stamps, abs=1e-12)
        assert series.values == pytest.approx(np.array(values), abs=1e-15, nan_ok=True)

    holds(run.start_pose, [1.0], [0.9], [[0.5, 0.25, -1.0]])
    rows = [[0.1, 0.2, 0.3, 0.4, 0.5], [-0.1, -0.2, 3.0, 0.0, 0.0]]
    holds(run.odometry, [1.1, 1.9], [1.05, 1.85], rows)
    holds(run.cmd_vel, [1.2], [1.2], [[0.6, -0.7]])
    holds(run.cmd_vel_out, [1.3], [1.25], [[0.8, 0.9]])
    holds(run.wheel_commands, [1.4], [1.4], [[4.0, 3.0]])
    holds(run.wheels, [1.5], [1.45], [[6.0, 5.0]])
    three = [[1.0, 2.0, 0.5], [3.0, 4.0, 0.0], [5.0, 6.0, -0.5]]
    holds(run.goals, [1.6, 1.7, 1.7], [1.0, 7.0, 7.0], three)
    planned = [
        [0.0, 1.0, 0.0, 0.0],
        [2.0, 3.0, 0.5, 1.5],
        [4.0, 5.0, 0.0, math.nan],
        [6.0, 7.0, 0.0, math.nan],
    ]
    holds(run.planned_path, [1.75, 1.75, 1.76, 1.76], [8.0, 8.0, 9.0, 9.0], planned)
    holds(run.goal_status, [1.8], [7.0], [[4.0]])
    assert run.notes == ()


def test_topics_that_are_missing_give_empty_series(tmp_path):
    run = read_run(write_bag(tmp_path / 'bag', []))
    for name, columns in COLUMNS.items():
        series = getattr(run, name)
        assert series.values.shape == (0, len(columns))
        assert series.received.dtype == series.stamps.dtype == np.int64
    assert (run.parameters, run.parameter_events) == ({}, ())


def test_messages_that_the_nodes_drop_are_left_out_and_counted(tmp_path):
    sent = {
        '/cmd_vel': twist(math.nan, 0.0),
        '/odom': odom(math.inf, 0.0, 0.0),
        '/joint_states': JointState(name=['left_wheel_joint'], velocity=[1.0]),
        '/goal_pose': goal(1e9, 0.0),
        '/start_pose': spoiled(start(0, 0, 0, seconds=1), 'pose.pose.orientation.w', 2.0),
        '/joint_command': joint_command(1e308, 0.0),
        '/goals': goals(*[goal(1.0, 0.0)] * (MAX_WAYPOINTS + 1)),
    }
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, *one) for one in sent.items()]))
    assert not any(len(getattr(run, name)) for name in COLUMNS)
    assert run.skipped == dict.fromkeys(sent, 1)
    assert {note.removeprefix('1 of 1 messages on ') for note in run.notes} == {
        f'{topic} hold invalid or implausible values and were skipped' for topic in sent
    }


def test_messages_that_cannot_be_decoded_are_skipped_and_counted(tmp_path):
    good = Message(0, SECOND, serialize_message(odom(1, 2, 0)))
    # The last one is an odometry of a big-endian machine.
    others = (b'', b'\0\1\0\0', b'\xff' * 300, bytes(720))
    damaged = [Message(0, SECOND, data) for data in others]
    records = [good, *damaged, good]
    build_bag([channel(0, '/odom', 'nav_msgs/msg/Odometry')], records, tmp_path / 'bag')
    run = read_run(tmp_path / 'bag')
    assert run.odometry.values[:, 0].tolist() == [1.0, 1.0]
    assert run.skipped == {'/odom': 4}
    why = 'cannot be decoded as little-endian CDR'
    assert run.notes == (f'4 of 6 messages on /odom {why} and were skipped',)


def test_events_of_faults_are_read_and_other_messages_on_their_topic_noted(tmp_path):
    texts = ['', 'x', '3', '{"fault": 1, "what": "begins"}', '[' * 100_000]
    texts.append(json.dumps({'time': 1.0, 'fault': 'Loss()', 'what': 'begins'}))
    sent = [(11.0, '/fault_events', String(data=data)) for data in texts]
    run = read_run(write_bag(tmp_path / 'bag', sent))
    assert run.fault_events == ((11 * SECOND, FaultEvent('Loss()', 'begins')),)
    assert '1 events of faults' in repr(run)
    assert '5 of 6 messages on /fault_events hold invalid' in run.notes[0]


def test_a_run_and_a_series_are_printed_in_short(tmp_path):
    sent = [(index / 50, '/odom', odom(index, 0, 0)) for index in range(200)]
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters={'/go_to_goal': {'kp': 3.0}}))
    assert repr(run.goals) == 'Series(0 messages of [x, y, theta])'
    assert str(run).splitlines() == [
        f"Run('{tmp_path / 'bag'}':",
        '  odometry: 200 messages of [x, y, theta, v, omega], recorded over 3.980 s',
        '  parameters of /go_to_goal',
        ')',
    ]


# --- Names and parameters


def test_several_topics_of_one_name_are_told_apart_by_whom_is_meant(tmp_path):
    sent = [(1.0, f'/r{index}/odom', odom(index, 0, 0)) for index in (1, 2)]
    bag = write_bag(tmp_path / 'bag', [*sent, (1.0, '/pose', odom(3, 0, 0)), (1.0, '/text', String())])
    with pytest.raises(BagError, match='several topics odom: /r1/odom, /r2/odom'):
        read_run(bag)
    for topic, x in (('/r2/odom', 2.0), ('/pose', 3.0)):
        assert read_run(bag, {'odom': topic}).odometry.values[0, 0] == x
    for topic in ('/nowhere', '/text'):
        with pytest.raises(BagError, match=f'no topic {topic} of nav_msgs/msg/Odometry; it has /pose, '):
            read_run(bag, {'odom': topic})


def test_parameters_are_those_of_the_beginning_and_changes_come_after(tmp_path):
    parameters = {
        '/a/virtual_robot': {'max_wheel_velocity': math.nan},
        '/go_to_goal': {'kp': 3.0},
        **{f'/{name}/wheel_bridge': {'left_wheel_name': 'L', 'right_wheel_name': 'R'} for name in 'ab'},
    }
    sent = [
        (1.0, '/joint_states', JointState(name=['R', 'L'], velocity=[2.0, 1.0])),
        (2.0, '/parameter_events', changed('/go_to_goal', 'kp', 6.0)),
    ]
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters=parameters))
    assert math.isnan(run.of_node('virtual_robot')['max_wheel_velocity'])
    assert run.of_node('go_to_goal') == {'kp': 3.0}
    # Of several none is meant, but the names of the wheels are the same.
    assert run.of_node('wheel_bridge') == {}
    assert run.wheels.values.tolist() == [[2.0, 1.0]]
    ((received, change),) = run.parameter_events
    assert (received, change.node, change.values) == (2 * SECOND, '/go_to_goal', {'kp': 6.0})


# --- What follows of a run


@pytest.mark.parametrize('calls', [0, 20])
def test_reading_and_verification_end_with_the_next_message(tmp_path, calls):
    stopped = [(10.01, '/cmd_vel_out', twist_stamped(0.0, 0.0, 10 * SECOND + 1))]
    bag = write_bag(tmp_path / 'bag', sample(stopped, count=40))
    run = read_run(bag)
    for function, given in ((read_run, bag), (verify, run)):
        answers = iter([False] * calls + [True])
        with pytest.raises(InterruptionError):
            function(given, interrupted=lambda answers=answers: next(answers))
        assert next(answers, None) is None
