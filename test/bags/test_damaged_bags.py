"""Damaged bags: all tools agree whether a bag can be read; if not, recover_run writes one that can."""

from __future__ import annotations

import math
import os
import shutil
import sqlite3

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from ruamel.yaml import YAML
from support.bags import SECOND, odom, start, write_bag
from support.ros_messages import goal, joint_command, twist_stamped

from diffdrive_jacobian.bags import metadata
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import PARAMETERS, Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.metadata import MetadataError, check_connections, check_metadata
from diffdrive_jacobian.bags.run_reader import read_run
from diffdrive_jacobian.bags.time_series import commanded, limits, measured
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.plots.run_figure import LABELS, draw
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import plot_run, recover_run, replay_run

COUNT = 10
STORAGES = ('mcap', 'sqlite3')
ODOMETRY_HASH = definition('nav_msgs/msg/Odometry').type_hash
OTHER_HASH = f'RIHS01_{64 * "0"}'
# Of each kind of consequence one: the others differ in the limits only.
WITH_PICTURE = ('x', 1e308)
TOOLS = {
    'plot_run': lambda bag: plot_run.main([str(bag), '-o', f'{bag}.png'], Signals()),
    'replay_run': lambda bag: replay_run.main(['--verify', str(bag)], Signals()),
    'recover_run': lambda bag: recover_run.main([str(bag)], Signals()),
}


@pytest.fixture(autouse=True)
def _quick(request, monkeypatch):
    """Save time: no bag needs to survive a power cut, and few tests need the picture itself."""
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)
    if 'drawn' not in request.fixturenames:
        monkeypatch.setattr(plot_run, 'draw', lambda runs, path, **_: [timeline(run) for run in runs])


@pytest.fixture
def drawn():
    """Let plot_run draw."""


def make_bag(path, storage, parameters=None):
    """Write a short run of a standing robot that verifies."""
    sent = [(1.0, '/start_pose', start(0, 0, 0, seconds=1.0))]
    sent += [(1.01, '/cmd_vel_out', twist_stamped(0.0, 0.0, SECOND))]
    sent += [(1.1 + i / 50, '/odom', odom(0, 0, 0, seconds=1.1 + i / 50)) for i in range(COUNT)]
    return write_bag(path, sent, storage=storage, parameters=parameters)


def edit(bag, change):
    """Change metadata.yaml; `change` gets its content, and what it returns, if anything, replaces it."""
    yaml, path = YAML(typ='safe'), bag / 'metadata.yaml'
    content = yaml.load(path.read_text())
    changed = change(content['rosbag2_bagfile_information'])
    if changed is not None:
        content['rosbag2_bagfile_information'] = changed
    with open(path, 'w') as file:
        yaml.dump(content, file)


def run(capsys, tool, bag):
    """Run a tool; return the exit code, its output and its errors."""
    code = TOOLS[tool](bag)
    out, err = capsys.readouterr()
    assert 'Traceback' not in out + err
    return code, out, err


# --- Values of metadata.yaml


def put(*keys_and_value):
    """Return a change that sets the value at the end of a path of keys; without a value: removes it."""
    *keys, last, value = keys_and_value

    def change(content):
        for key in keys:
            content = content[key]
        if value is put:
            del content[last]
        else:
            content[last] = value

    return change


TOPICS = 'topics_with_message_count'
WRONG = {
    # Wrong types.
    'version': [None, 'nine', 0, 10, 9.0, True, math.nan],
    'storage_identifier': [None, 3, 'rosbag', ['mcap']],
    'relative_file_paths': [None, 'x', 3, [None], [3], [''], {'a': 'b'}, ['a', 'a'], ['a', 'b/a']],
    'duration': [
        None,
        3,
        [],
        {},
        {'nanoseconds': -1},
        {'nanoseconds': math.nan},
        {'nanoseconds': 2**63},
    ],
    'starting_time': [
        None,
        'x',
        {'nanoseconds_since_epoch': None},
        {'nanoseconds_since_epoch': 10**400},
    ],
    'message_count': [None, -1, 'x', 1.5, math.nan, 10**30, [3]],
    TOPICS: [None, 'x', {}, [None], ['x'], [{}], [{'topic_metadata': 3, 'message_count': 1}]],
    'compression_format': [3, ['zstd']],
    'compression_mode': [None, 3, 'squeeze'],
    'files': [None, 'x', 3, ['x'], {'path': 'x'}],
    'custom_data': ['x', 3, ['x'], {'key': 3}, {3: 'x'}, {'key': None}, {'key': {'deep': 'x'}}],
    'ros_distro': [3, ['jazzy']],
}
WRONG_TOPIC = {
    'name': [None, 3, ['x'], ''],
    'type': [None, 3, {}, ''],
    'serialization_format': [None, 3, 'json'],
    'offered_qos_profiles': ['{', 3, [3], ['x'], [{}], [{'history': 3}]],
    'type_description_hash': [None, 3],
}
REQUIRED = (
    *('version', 'storage_identifier', 'relative_file_paths', 'duration', 'starting_time'),
    *('message_count', TOPICS),
)
DAMAGED = [(f'{key}: {value!r:.40}', key, put(key, value)) for key in WRONG for value in WRONG[key]]
DAMAGED += [(f'no {key}', key, put(key, put)) for key in REQUIRED]
DAMAGED += [
    (f'{key} of a topic: {value!r:.40}', key, put(TOPICS, 0, 'topic_metadata', key, value))
    for key in WRONG_TOPIC
    for value in WRONG_TOPIC[key]
]
DAMAGED += [
    ('no name of a topic', 'name', put(TOPICS, 0, 'topic_metadata', 'name', put)),
    ('no topic_metadata', 'topic_metadata', put(TOPICS, 0, 'topic_metadata', put)),
    ('negative count of a topic', 'message_count', put(TOPICS, 0, 'message_count', -3)),
    ('other topic', '/odom', lambda content: rename(content, 'name', '/odom', '/elsewhere')),
    ('other type', '/odom', lambda content: rename(content, 'type', 'nav_msgs/msg/Odometry', 'a/msg/B')),
    ('not a map', 'rosbag2_bagfile_information', lambda content: 'x'),
    ('a list', 'rosbag2_bagfile_information', lambda content: [content]),
]


def rename(content, key, old, new):
    for topic in content[TOPICS]:
        if topic['topic_metadata'][key] == old:
            topic['topic_metadata'][key] = new


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    return {storage: make_bag(folder / storage, storage) for storage in STORAGES}


@pytest.mark.parametrize(('key', 'change'), [pytest.param(*one[1:], id=one[0]) for one in DAMAGED])
def test_a_damaged_value_is_named(bags, tmp_path, key, change):
    bag = tmp_path / 'bag'
    bag.mkdir()
    shutil.copy(bags['mcap'] / 'metadata.yaml', bag)
    check_metadata((bag / 'metadata.yaml').read_text())
    edit(bag, change)
    if key == '/odom':
        # Only the data file tells that it is wrong.
        check_metadata((bag / 'metadata.yaml').read_text())
        return
    with pytest.raises(MetadataError, match=f'metadata.yaml.*{key}'):
        check_metadata((bag / 'metadata.yaml').read_text())


# One value of each key is enough, the others are found by the same check.
KINDS = [
    one
    for i, one in enumerate(DAMAGED)
    if one[0].split(':')[0] not in {o[0].split(':')[0] for o in DAMAGED[:i]}
]


@pytest.mark.parametrize(
    ('key', 'change', 'storage'),
    [pytest.param(*one[1:], STORAGES[i % 2], id=one[0]) for i, one in enumerate(KINDS)],
)
def test_all_tools_name_the_damage_and_recover_run_repairs_it(
    bags, tmp_path, capsys, monkeypatch, key, change, storage
):
    bag = shutil.copytree(bags[storage], tmp_path / 'a bag')
    for file in bag.iterdir():
        assert file.suffix in ('.mcap', '.db3', '.yaml')
    edit(bag, change)
    for tool in ('plot_run', 'replay_run'):
        code, out, err = run(capsys, tool, bag)
        assert (code, out) == (2, '')
        assert len(err.splitlines()) == 1
        assert key in err
        assert f"`recover_run '{bag}'` saves what can be read" in err
    code, out, err = run(capsys, 'recover_run', bag)
    assert (code, err) == (0, '')
    assert key in out
    recovered = tmp_path / 'a bag_recovered'
    assert read_run(recovered).notes == ()
    assert len(read_run(recovered).odometry) == COUNT
    assert run(capsys, 'replay_run', recovered)[0] == 0
    code, out, err = run(capsys, 'recover_run', recovered)
    # SQLite has no checksums.
    expected = (1, 'is complete') if storage == 'mcap' else (3, 'cannot be called complete')
    assert code == expected[0]
    assert expected[1] in err


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize(
    'change',
    [
        put('ros_distro', None),
        put('ros_distro', put),
        put('custom_data', None),
        put('custom_data', put),
        put('compression_format', None),
        put('compression_mode', put),
        put('files', put),
        put('files', []),
        put('version', 5),
        put('unknown', [1, 2]),
        put(TOPICS, 0, 'topic_metadata', 'type_description_hash', put),
    ],
)
def test_all_tools_read_metadata_that_other_versions_write(bags, tmp_path, capsys, change, storage):
    bag = shutil.copytree(bags[storage], tmp_path / 'bag')
    edit(bag, change)
    codes = [run(capsys, tool, bag)[0] for tool in TOOLS]
    assert codes == [0, 0, 1 if storage == 'mcap' else 3]


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('said', [0, COUNT - 1, COUNT + 1])
def test_all_tools_note_another_number_of_messages(bags, tmp_path, capsys, said, storage):
    bag = shutil.copytree(bags[storage], tmp_path / 'bag')

    def change(content):
        content['message_count'] += said - COUNT
        for topic in content[TOPICS]:
            if topic['topic_metadata']['name'] == '/odom':
                topic['message_count'] = said

    edit(bag, change)
    note = f'{COUNT} messages on /odom were found, the bag should have {said}'
    assert run(capsys, 'plot_run', bag) == (0, f'{bag}.png\n', f'plot_run: {bag}: {note}\n')
    code, out, _ = run(capsys, 'replay_run', bag)
    assert code == 0
    assert f'note: {note}' in out
    code, out, err = run(capsys, 'recover_run', bag)
    assert (code, err) == (0, '')
    assert f'{COUNT + 2} messages' in out
    assert len(read_run(tmp_path / 'bag_recovered').odometry) == COUNT


@pytest.mark.parametrize('storage', STORAGES)
def test_qos_that_differs_between_metadata_and_file_hides_no_messages(bags, tmp_path, capsys, storage):
    """rosbags takes such topics for two and reads nothing, without a word."""
    bag = shutil.copytree(bags[storage], tmp_path / 'bag')
    profile = {
        **{'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile'},
        **{name: {'sec': 0, 'nsec': 0} for name in ('deadline', 'lifespan')},
        **{'liveliness': 'automatic', 'liveliness_lease_duration': {'sec': 0, 'nsec': 0}},
        'avoid_ros_namespace_conventions': False,
    }
    edit(bag, lambda content: rename_all(content, 'offered_qos_profiles', [profile]))
    for tool in ('plot_run', 'replay_run'):
        code, _, err = run(capsys, tool, bag)
        assert code == 2
        assert 'QoS' in err
        assert 'recover_run' in err
    assert run(capsys, 'recover_run', bag)[0] == 0
    assert len(read_run(tmp_path / 'bag_recovered').odometry) == COUNT


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('"wheel_radius": 0.033', '"wheel_radius": 0.035', 'parameters of /virtual_robot'),
        (ODOMETRY_HASH, OTHER_HASH, 'type hash of /odom'),
    ],
)
def test_recover_run_compares_metadata_with_the_data_file(tmp_path, capsys, storage, old, new, said):
    bag = make_bag(tmp_path / 'bag', storage, {'/virtual_robot': {'wheel_radius': 0.033}})
    metadata = bag / 'metadata.yaml'
    text = metadata.read_text()
    assert text.count(old) == 1
    metadata.write_text(text.replace(old, new))
    code, out, err = run(capsys, 'recover_run', bag)
    assert (code, err) == (0, '')
    assert f'lost: metadata.yaml differs from the data file, from which is saved: {said}\n' in out
    recovered = read_run(tmp_path / 'bag_recovered')
    assert (len(recovered.odometry), recovered.notes) == (COUNT, ())
    assert recovered.of_node('virtual_robot') == {'wheel_radius': 0.033}


def test_messages_that_were_skipped_are_named_where_they_are_missed(tmp_path, capsys):
    bag = make_bag(tmp_path / 'bag', 'mcap')
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace(ODOMETRY_HASH, OTHER_HASH))
    for tool in ('plot_run', 'replay_run'):
        code, out, err = run(capsys, tool, bag)
        assert (code, out) != (0, '')
        assert 'has no odometry' in err
        assert f'{COUNT} of {COUNT} messages on /odom were recorded with another definition' in err


def test_many_topics_are_checked_in_linear_time(monkeypatch):
    compared = 0

    def count(*connections, alike=metadata._alike):
        nonlocal compared
        compared += 1
        return alike(*connections)

    monkeypatch.setattr(metadata, '_alike', count)
    ext = ConnectionExtRosbag2('cdr', [])
    definition = MessageDefinition(MessageDefinitionFormat.NONE, '')
    topics = [
        Connection(index, f'/t{index}', 'std_msgs/msg/String', definition, '', 1, ext, None)
        for index in range(500)
    ]
    check_connections(topics, topics)
    assert compared == len(topics)
    with pytest.raises(MetadataError, match='does not describe the topic /t0 '):
        check_connections(topics[1:], topics)


def rename_all(content, key, value):
    for topic in content[TOPICS]:
        topic['topic_metadata'][key] = value


@pytest.mark.parametrize('text', ['', '[1, 2', '\0', 'x', '[[' * 1500, '{a: ' * 1500, '- ' * 1500])
def test_metadata_that_is_no_map_or_too_deep_is_damage(text):
    with pytest.raises(MetadataError, match=r'metadata\.yaml'):
        check_metadata(text)


@pytest.mark.parametrize('text', ['', '{', '[1, 2]', '3', '[' * 10_000, '{"kp": ' + '9' * 5000 + '}'])
def test_parameters_that_are_none_are_left_out_by_recover_run(tmp_path, capsys, text):
    known = definition('nav_msgs/msg/Odometry')
    channel = Channel(
        id=0, topic='/odom', type_name=known.name, definition=known.text, type_hash=known.type_hash
    )
    records = [
        Text(f'{PARAMETERS}/robot', text),
        Text(f'{PARAMETERS}/other', '{"kp": 3.0}'),
        *(Message(0, i * SECOND, serialize_message(odom(0, 0, 0, seconds=i))) for i in (1, 2)),
    ]
    build_bag([channel], records, tmp_path / 'bag', 'mcap')
    code, _, err = run(capsys, 'plot_run', tmp_path / 'bag')
    assert code == 2
    assert 'parameters of /robot' in err
    assert 'recover_run' in err
    code, out, _ = run(capsys, 'recover_run', tmp_path / 'bag')
    assert code == 0
    assert 'parameters of /robot' in out
    assert read_run(tmp_path / 'bag_recovered').parameters == {'/other': {'kp': 3.0}}


@pytest.mark.parametrize('value', ['x', None, [1], {}, True, 10**400, math.nan, 1e308, -1.0])
def test_parameters_of_another_kind_do_not_end_the_plot(tmp_path, value):
    names = ('xy_goal_tolerance', 'offset', 'linear.x.max_velocity', 'max_wheel_velocity')
    names += ('controller', 'left_wheel_name', 'right_wheel_name')
    nodes = ('/go_to_goal', '/virtual_robot', '/wheel_bridge')
    sent = [(1.0, '/goal_pose', goal(1.0, 0.5)), (1.0, '/joint_states', joint_command(1, 2))]
    sent += [(1.1 + i / 50, '/odom', odom(i / 50, 0, 0, seconds=1.1 + i / 50)) for i in range(COUNT)]
    parameters = {node: dict.fromkeys(names, value) for node in nodes}
    parameters['/go_to_goal'] |= {'controller': 'offset_point'}
    bag = write_bag(tmp_path / 'bag', sent, parameters=parameters)
    found = read_run(bag)
    assert len(found.wheels) == (value != 'x')
    one = timeline(found)
    for bounds in limits(one).values():
        assert not np.isinf(bounds).any()
    for quantity in LABELS:
        measured(one, quantity)
        commanded(one, quantity)
    if value in WITH_PICTURE:
        draw([found], tmp_path / 'run.png')


# --- Messages that cannot be decoded


def add_damaged(bag, count, data=b'\0\1\0\0xyz'):
    """Replace the content of some messages on /odom in an SQLite bag."""
    with sqlite3.connect(bag / f'{bag.name}.db3') as database:
        rows = database.execute(
            "SELECT messages.id FROM messages JOIN topics ON topic_id = topics.id WHERE name = '/odom' "
            'ORDER BY messages.id'
        ).fetchall()
        for (row,) in rows[:count]:
            database.execute('UPDATE messages SET data = ? WHERE id = ?', (data, row))
    database.close()


def test_one_message_that_cannot_be_decoded_leaves_the_bag_readable(tmp_path, capsys):
    bag = make_bag(tmp_path / 'bag', 'sqlite3')
    add_damaged(bag, 3)
    note = f'3 of {COUNT} messages on /odom cannot be decoded'
    assert run(capsys, 'plot_run', bag)[::2] == (0, f'plot_run: {bag}: {note} and were skipped\n')
    code, out, _ = run(capsys, 'replay_run', bag)
    assert code == 0
    assert f'note: {note} and were skipped' in out
    assert read_run(bag).skipped == {'/odom': 3}
    code, out, err = run(capsys, 'recover_run', bag)
    assert (code, out) == (3, '')
    assert err.endswith(f'{note}\n')


def test_recover_run_reports_messages_that_cannot_be_decoded(tmp_path, capsys):
    bag = make_bag(tmp_path / 'bag', 'sqlite3')
    add_damaged(bag, 3)
    (bag / 'metadata.yaml').unlink()
    code, out, _ = run(capsys, 'recover_run', bag)
    assert code == 0
    assert f'saved as recorded: 3 of {COUNT} messages on /odom cannot be decoded' in out
    assert read_run(tmp_path / 'bag_recovered').skipped == {'/odom': 3}


def test_recover_run_says_what_it_did_not_check(tmp_path, capsys):
    channel = Channel(
        id=0, topic='/x', type_name='my_msgs/msg/Mine', definition='int32 a\n', type_hash='RIHS01_00'
    )
    write_journal(tmp_path / 'bag', [channel, Message(0, SECOND, b'\0\1\0\0\1\0\0\0')])
    code, out, _ = run(capsys, 'recover_run', tmp_path / 'bag')
    assert code == 0
    assert 'the 1 messages on /x were not checked: their type is not installed as it was recorded' in out


# --- What the message about an unreadable bag says


def write_journal(bag, records):
    writer = JournalWriter(journal_of(bag))
    for record in records:
        writer.add(record)
    writer.flush()
    writer.close()
    return writer.path


@pytest.mark.parametrize('tool', ['plot_run', 'replay_run'])
def test_a_journal_beside_a_missing_bag_is_named(tmp_path, capsys, monkeypatch, tool):
    monkeypatch.chdir(tmp_path)
    write_journal(tmp_path / 'my crash', [Text('storage', 'mcap')])
    code, _, err = run(capsys, tool, 'my crash')
    assert code == 2
    assert 'there is no bag my crash, but the journal of an interrupted recording' in err
    assert "`recover_run 'my crash.journal.mcap'` makes the bag of it" in err


@pytest.mark.parametrize('tool', ['plot_run', 'replay_run'])
@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('what', ['folder', 'file', 'folder without metadata', 'journal'])
def test_a_bag_that_was_cut_off_is_recovered_by_the_command_that_is_named(
    bags, tmp_path, capsys, monkeypatch, tool, storage, what
):
    bag = shutil.copytree(bags[storage], tmp_path / storage)
    (file,) = (one for one in bag.iterdir() if one.suffix in ('.mcap', '.db3'))
    file.write_bytes(file.read_bytes()[:-5000])
    given = {'file': file, 'journal': write_journal(tmp_path / 'x', [])}.get(what, bag)
    if what == 'folder without metadata':
        (bag / 'metadata.yaml').unlink()
    code, _, err = run(capsys, tool, given)
    assert code == 2
    assert len(err.splitlines()) == 1
    assert f'`recover_run {given}`' in err


def test_for_what_is_no_bag_recover_run_is_not_named(tmp_path, capsys):
    (tmp_path / 'letter.txt').write_text('Dear')
    (tmp_path / 'empty').mkdir()
    for name in ('letter.txt', 'empty', 'nothing'):
        code, _, err = run(capsys, 'plot_run', tmp_path / name)
        assert code == 2
        assert 'recover_run' not in err


def test_a_wheel_command_beyond_all_measure_does_not_end_the_plot(tmp_path, capsys, drawn):
    sent = [(1.0 + i / 50, '/odom', odom(0, 0, 0, seconds=1.0 + i / 50)) for i in range(COUNT)]
    sent += [
        (1.5, '/joint_command', joint_command(1e308, -1e308)),
        (1.6, '/joint_command', joint_command(1, 2)),
    ]
    bag = write_bag(tmp_path / 'bag', sent)
    assert run(capsys, 'plot_run', bag)[0] == 0
    assert (tmp_path / 'bag.png').stat().st_size > 10_000
    np.testing.assert_array_equal(read_run(bag).wheel_commands.values, [[2.0, 1.0]])
