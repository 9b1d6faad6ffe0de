"""Bags as the numbers of a run: what was sent is what is read, and what is no bag is told."""

from __future__ import annotations

import inspect
import math
import shutil
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.bags import REAL, SECOND, changed, odom, start, status, write_bag
from support.ros_messages import (
    goal,
    goals,
    joint_command,
    path,
    twist,
    twist_stamped,
)

from diffdrive_jacobian.bags import run as run_module
from diffdrive_jacobian.bags import timeline as timeline_module
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import PARAMETERS, Channel, Message, Text
from diffdrive_jacobian.bags.message_definitions import definition, known_structure
from diffdrive_jacobian.bags.run_reader import BagError, Run, read_run
from diffdrive_jacobian.messages.cdr import DecodingError
from diffdrive_jacobian.messages.codecs import GOALS
from diffdrive_jacobian.messages.conversion import MAX_WAYPOINTS, MessageError

FIELDS = (
    *('odometry', 'cmd_vel', 'cmd_vel_out', 'start_pose'),
    *('wheel_commands', 'wheels', 'goals', 'planned_path', 'goal_status'),
)


# --- What was sent is what is read


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('namespace', ['', '/robot1', '/fleet/robot1'])
def test_every_series_holds_what_was_sent(tmp_path, namespace, storage):
    sent = [
        (1.0, 'start_pose', start(0.5, 0.25, -1.0, seconds=0.9)),
        (1.1, 'odom', odom(0.1, 0.2, 0.3, 0.4, 0.5, seconds=1.05)),
        (1.2, 'cmd_vel', twist(0.6, -0.7)),
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
    run = read_run(
        write_bag(
            tmp_path / 'bag',
            [(at, f'{namespace}/{topic}', message) for at, topic, message in sent],
            storage=storage,
        )
    )

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


def test_commands_may_be_stamped(tmp_path):
    sent = [
        (2.0, '/cmd_vel', twist_stamped(0.1, 0.2, SECOND)),
        (3.0, '/cmd_vel', twist_stamped(0, 0, 0)),
    ]
    run = read_run(write_bag(tmp_path / 'bag', sent))
    assert run.cmd_vel.stamps.tolist() == [SECOND, 3 * SECOND]
    assert run.cmd_vel.values.tolist() == [[0.1, 0.2], [0.0, 0.0]]


def test_topics_that_are_missing_give_empty_series(tmp_path):
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, '/odom', odom(0, 0, 0))]))
    for name in FIELDS[1:]:
        series = getattr(run, name)
        assert len(series) == 0
        assert series.values.shape == (0, series.values.shape[1])
        assert series.received.dtype == series.stamps.dtype == np.int64
    assert (run.parameters, run.parameter_events) == ({}, ())


def test_a_bag_without_messages_is_an_empty_run(tmp_path):
    run = read_run(write_bag(tmp_path / 'bag', []))
    assert [len(getattr(run, name)) for name in FIELDS] == [0] * len(FIELDS)


def test_other_topics_do_not_matter(tmp_path):
    sent = [(1.0, '/chatter', String(data='hello')), (2.0, '/odom', odom(1, 2, 0))]
    run = read_run(write_bag(tmp_path / 'bag', sent))
    assert run.odometry.values[0, :2].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ('topic', 'message'),
    [
        ('/cmd_vel', twist(math.nan, 0.0)),
        ('/odom', odom(math.inf, 0.0, 0.0)),
        ('/joint_states', JointState(name=['left_wheel_joint'], velocity=[1.0])),
        ('/goal_pose', goal(1e9, 0.0)),
        ('/joint_command', joint_command(1e308, 0.0)),
    ],
)
def test_messages_that_the_nodes_drop_are_left_out_and_counted(tmp_path, topic, message):
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, topic, message)]))
    assert [len(getattr(run, name)) for name in FIELDS] == [0] * len(FIELDS)
    assert run.skipped == {topic: 1}
    note = f'1 of 1 messages on {topic} hold invalid or implausible values and were skipped'
    assert run.notes == (note,)


@pytest.mark.parametrize('speed', [1e6, -1e6])
def test_wheel_speeds_are_plausible_up_to_a_limit(tmp_path, speed):
    beyond = float(np.nextafter(speed, 2.0 * speed))
    sent = [
        (1.0, '/joint_states', joint_command(speed, 0)),
        (2.0, '/joint_states', joint_command(0, beyond)),
    ]
    assert read_run(write_bag(tmp_path / 'bag', sent)).wheels.values.tolist() == [[0.0, speed]]


# --- What is printed


def test_a_run_and_a_series_are_printed_in_short(tmp_path):
    sent = [(index / 50, '/odom', odom(index, 0, 0)) for index in range(200)]
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters={'/go_to_goal': {'kp': 3.0}}))
    assert repr(run.odometry) == (
        'Series(200 messages of [x, y, theta, v, omega], recorded over 3.980 s)'
    )
    assert repr(run.goals) == 'Series(0 messages of [x, y, theta])'
    assert str(run) == '\n'.join(
        [
            f"Run('{tmp_path / 'bag'}':",
            '  odometry: 200 messages of [x, y, theta, v, omega], recorded over 3.980 s',
            '  parameters of /go_to_goal',
            ')',
        ]
    )


def test_the_columns_of_every_series_are_named(tmp_path):
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, '/odom', odom(0, 0, 0))]))
    for name in FIELDS:
        series = getattr(run, name)
        assert len(series.columns) == series.values.shape[1]
        assert f'`[{", ".join(series.columns)}]`' in inspect.getsource(run_module)


# --- Names


def test_several_topics_of_one_name_are_told_apart_by_whom_is_meant(tmp_path):
    sent = [(1.0, f'/r{index}/odom', odom(index, 0, 0)) for index in (1, 2)]
    bag = write_bag(tmp_path / 'bag', sent)
    with pytest.raises(BagError, match='several topics odom: /r1/odom, /r2/odom'):
        read_run(bag)
    assert read_run(bag, {'odom': '/r2/odom'}).odometry.values[0, 0] == 2.0


def test_a_topic_may_have_another_name(tmp_path):
    bag = write_bag(tmp_path / 'bag', [(1.0, '/pose', odom(1, 0, 0)), (1.0, '/odom', String())])
    assert len(read_run(bag).odometry) == 0
    assert len(read_run(bag, {'odom': '/pose'}).odometry) == 1


@pytest.mark.parametrize('topic', ['/nowhere', '/text'])
def test_a_named_topic_must_be_there_and_of_its_type(tmp_path, topic):
    bag = write_bag(tmp_path / 'bag', [(1.0, '/text', String())])
    with pytest.raises(BagError, match=f'no topic {topic} of nav_msgs/msg/Odometry; it has /text'):
        read_run(bag, {'odom': topic})


def test_a_topic_of_another_type_is_not_read(tmp_path):
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, '/odom', Twist()), (2.0, '/cmd_vel', Odometry())]))
    assert (len(run.odometry), len(run.cmd_vel)) == (0, 0)


# --- Parameters


def test_parameters_are_those_of_the_beginning_and_changes_come_after(tmp_path):
    parameters = {
        '/a/virtual_robot': {'max_wheel_velocity': math.nan},
        '/go_to_goal': {'kp': 3.0},
    }
    sent = [(2.0, '/parameter_events', changed('/go_to_goal', 'kp', 6.0))]
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters=parameters))
    assert math.isnan(run.of_node('virtual_robot')['max_wheel_velocity'])
    assert run.of_node('go_to_goal') == {'kp': 3.0}
    assert run.of_node('wheel_bridge') == {}
    assert run.parameter_events == ((2 * SECOND, '/go_to_goal', {'kp': 6.0}),)


def test_of_several_nodes_of_a_name_none_is_meant(tmp_path):
    parameters = {f'/{name}/go_to_goal': {'kp': 3.0} for name in 'ab'}
    run = read_run(write_bag(tmp_path / 'bag', [], parameters=parameters))
    assert run.of_node('go_to_goal') == {}


def test_parameters_name_the_wheels(tmp_path):
    names = {'left_wheel_name': 'L', 'right_wheel_name': 'R'}
    message = JointState(name=['R', 'L'], velocity=[2.0, 1.0])
    bag = write_bag(
        tmp_path / 'bag', [(1.0, '/joint_states', message)], parameters={'/virtual_robot': names}
    )
    assert read_run(bag).wheels.values.tolist() == [[2.0, 1.0]]


# --- What is no bag


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Directories of a bag in each storage. They are not changed."""
    folder = tmp_path_factory.mktemp('written')
    sent = [(index / 50, '/odom', odom(index, 0, 0)) for index in range(200)]
    return [write_bag(folder / storage, sent, storage=storage) for storage in ('mcap', 'sqlite3')]


@pytest.fixture
def good(written, tmp_path):
    """Copies of them by storage."""
    return {path.name: shutil.copytree(path, tmp_path / path.name) for path in written}


def test_there_must_be_a_bag(tmp_path):
    with pytest.raises(BagError, match='there is no bag'):
        read_run(tmp_path / 'nothing')


def test_an_empty_folder_is_no_bag(tmp_path):
    with pytest.raises(BagError, match='an empty folder'):
        read_run(tmp_path)


def test_a_folder_of_something_else_is_no_bag(tmp_path):
    (tmp_path / 'letter').write_text('Dear')
    with pytest.raises(BagError, match=r'without metadata\.yaml'):
        read_run(tmp_path)


@pytest.mark.parametrize('name', ['letter.txt', 'letter.mcap', 'letter.db3', 'letter'])
@pytest.mark.parametrize('content', [b'', b'Dear', b'\x00' * 4096])
def test_another_file_is_no_bag(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match='letter'):
        read_run(tmp_path / name)


@pytest.mark.parametrize(
    'text', ['', 'x', '[1, 2', 'rosbag2_bagfile_information: 3', '{}', '\x00', 'a: b']
)
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_damaged_metadata_is_told(good, storage, text):
    (good[storage] / 'metadata.yaml').write_text(text)
    with pytest.raises(BagError, match=storage):
        read_run(good[storage])


@pytest.mark.parametrize('kept', [0.0, 0.001, 0.3, 0.6, 0.99])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_file_that_was_cut_off_is_told(good, storage, kept):
    (file,) = (one for one in good[storage].iterdir() if one.suffix in ('.mcap', '.db3'))
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    with pytest.raises(BagError, match=storage):
        read_run(good[storage])


@pytest.mark.parametrize('place', [0.02, 0.2, 0.4, 0.6, 0.8])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_file_that_was_overwritten_is_told_or_read(good, storage, place):
    (file,) = (one for one in good[storage].iterdir() if one.suffix in ('.mcap', '.db3'))
    data = bytearray(file.read_bytes())
    begin = int(place * len(data))
    data[begin : begin + 200] = b'\xff' * 200
    file.write_bytes(data)
    with suppress(BagError):
        assert isinstance(read_run(good[storage]), Run)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_data_may_be_missing(good, storage):
    for file in good[storage].iterdir():
        if file.suffix in ('.mcap', '.db3'):
            file.unlink()
    with pytest.raises(BagError, match=storage):
        read_run(good[storage])


@pytest.mark.parametrize('data', [b'', b'\x00\x01\x00\x00', b'\xff' * 300])
def test_a_message_that_cannot_be_decoded_is_skipped_and_counted(tmp_path, data):
    known = definition('nav_msgs/msg/Odometry')
    channel = Channel(
        id=0, topic='/odom', type_name=known.name, definition=known.text, type_hash=known.type_hash
    )
    good = Message(0, SECOND, serialize_message(odom(1, 2, 0)))
    build_bag([channel], [good, Message(0, SECOND, data), good], tmp_path / 'bag', 'mcap')
    run = read_run(tmp_path / 'bag')
    assert run.odometry.values[:, 0].tolist() == [1.0, 1.0]
    assert run.skipped == {'/odom': 1}
    assert run.notes == ('1 of 3 messages on /odom cannot be decoded and were skipped',)


@pytest.mark.parametrize('text', ['', '{', '[1, 2]', '3'])
def test_parameters_that_are_none_are_told(tmp_path, text):
    build_bag([], [Text(f'{PARAMETERS}/robot', text)], tmp_path / 'bag', 'mcap')
    with pytest.raises(BagError, match='bag'):
        read_run(tmp_path / 'bag')


# --- A recorded robot


def test_a_bag_of_another_robot_is_read(tmp_path):
    run = read_run(shutil.copytree(REAL, tmp_path / 'bag'))
    assert len(run.odometry) > 1000
    assert (np.diff(run.odometry.stamps) > 0).all()
    assert run.odometry.values[:, 3].max() == pytest.approx(0.15)
    assert {tuple(row) for row in run.cmd_vel.values.tolist()} <= {
        *((0.15, 0.0), (0.15, 0.8), (-0.1, -0.6), (0.0, 1.2), (0.0, 0.0))
    }


# --- Many waypoints


def test_goals_with_more_poses_than_the_node_accepts_are_skipped_and_counted(tmp_path):
    most = goals(*[goal(1.0, 0.0)] * MAX_WAYPOINTS)
    beyond = goals(*[goal(1.0, 0.0)] * (MAX_WAYPOINTS + 1))
    run = read_run(write_bag(tmp_path / 'bag', [(1.0, '/goals', beyond), (2.0, '/goals', most)]))
    assert len(run.goals) == MAX_WAYPOINTS
    assert run.skipped == {'/goals': 1}


@pytest.mark.parametrize('order', ['<', '>'])
def test_the_number_of_poses_is_known_without_decoding_them(order):
    """1.5 million poses would take seconds of each message."""
    read = GOALS.reader(known_structure(GOALS.type_name))
    for frame in (b'', b'odom', b'a' * 300):
        for number in (MAX_WAYPOINTS + 1, 2**32 - 1):
            data = b'\0\1\0\0' if order == '<' else bytes(4)
            data += struct.pack(f'{order}iII', 1, 2, len(frame) + 1) + frame + b'\0'
            data += bytes(-len(data) % 4) + struct.pack(f'{order}I', number)
            with pytest.raises(MessageError, match=f'at most {MAX_WAYPOINTS} poses, got {number}'):
                read(data)
            for end in range(len(data)):
                with pytest.raises(DecodingError):
                    read(data[:end])


def test_a_route_is_followed_in_one_pass_over_the_odometry(monkeypatch):
    searched = []
    distances = timeline_module._distances

    def counted(run, places, target):
        searched.append(len(places))
        return distances(run, places, target)

    monkeypatch.setattr(timeline_module, '_distances', counted)
    totals = []
    for n in (1000, 2000):
        times = SECOND + np.arange(n) * SECOND // 10
        values = np.zeros((n, 5))
        values[:, 0], values[:, 3] = 0.1 * np.arange(n), 1.0
        targets = values[1::2, :3]
        first = np.full(len(targets), times[0])
        empty = {name: series_of(name, [], []) for name in run_module.COLUMNS}
        given = {
            'odometry': series_of('odometry', times, values),
            'goals': series_of('goals', first, targets),
        }
        run = Run(path=Path('run'), **(empty | given))
        searched.clear()
        # The goal changes at the message at which it is reached.
        expected = np.minimum(np.arange(n) // 2 + np.arange(n) % 2, len(targets) - 1)
        np.testing.assert_array_equal(timeline_module.timeline(run).goal, expected)
        totals.append(sum(searched))
    assert totals[1] < 2.5 * totals[0]


def series_of(name, times, values):
    columns = run_module.COLUMNS[name]
    times = np.asarray(times, dtype=np.int64)
    values = np.asarray(values, dtype=np.float64).reshape(len(times), len(columns))
    return run_module.Series(received=times, stamps=times, values=values, columns=columns)
