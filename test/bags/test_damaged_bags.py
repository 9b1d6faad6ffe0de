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

"""Damaged bags: all tools agree whether a bag can be read; if not, recover_run writes one that can.

Random damage is in `test_damage_fuzz`.
"""

from __future__ import annotations

import json
import math
import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import replace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from support.bags import SECOND, odom, start, write_bag
from support.raw_bags import PLUGINS, channel, data_file, run_tool, write_records
from support.ros_messages import goal, joint_command, twist_stamped

from diffdrive_jacobian.bags import BagError, DamagedBagError, NothingToSaveError, read_run, recover
from diffdrive_jacobian.bags.bag_reader import find_damage
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import PARAMETERS, Message, Text
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.recovery import UncheckedError
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.plots.run_lines import limits
from diffdrive_jacobian.safe_yaml import load_yaml
from diffdrive_jacobian.tools import plot_run, recover_run, replay_run

pytestmark = [pytest.mark.usefixtures('quick_disk'), pytest.mark.slow]

COUNT = 10
ODOMETRY = definition('nav_msgs/msg/Odometry')


def make_bag(path, storage, parameters=None):
    """Write a short run of a standing robot that verifies."""
    sent = [(1.0, '/start_pose', start(0, 0, 0, seconds=1.0))]
    sent += [(1.01, '/cmd_vel_out', twist_stamped(0.0, 0.0, SECOND))]
    sent += [(1.1 + i / 50, '/odom', odom(0, 0, 0, seconds=1.1 + i / 50)) for i in range(COUNT)]
    return write_bag(path, sent, storage=storage, parameters=parameters)


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Bags by their storage, which are not changed."""
    folder = tmp_path_factory.mktemp('bags')
    return {storage: make_bag(folder / storage, storage) for storage in PLUGINS}


@pytest.fixture(params=PLUGINS)
def bag(request, whole, tmp_path):
    return shutil.copytree(whole[request.param], tmp_path / 'bag')


# --- Values of metadata.yaml

KEY = 'rosbag2_bagfile_information'
TOPICS = 'topics_with_message_count'
ABSENT = object()


def edit(bag, *keys_and_value):
    """Set the value at the end of a path of keys in metadata.yaml, or remove it if it is ABSENT."""
    *keys, last, value = keys_and_value
    path = bag / 'metadata.yaml'
    content = load_yaml(path)
    inner = content[KEY]
    for key in keys:
        inner = inner[key]
    if value is ABSENT:
        del inner[last]
    else:
        inner[last] = value
    # Which is YAML.
    path.write_text(json.dumps(content))


INVALID = {
    'version': [ABSENT, None, 'nine', 0, 10, 9.0, True],
    'storage_identifier': [ABSENT, None, 'rosbag', ['mcap']],
    'relative_file_paths': [ABSENT, 3, 'x', [None], [''], ['a\0'], {'a': 'b'}, ['a', 'a'], ['a', 'b/a']],
    'duration': [ABSENT, 3, {}, *({'nanoseconds': one} for one in (-1, 2**63))],
    'starting_time': [ABSENT, 'x', {'nanoseconds_since_epoch': None}],
    'message_count': [ABSENT, -1, 1.5, 2**63],
    TOPICS: [ABSENT, None, 'x', {}, [None], [{}], [{'topic_metadata': 3, 'message_count': 1}]],
    'compression_format': [3],
    'compression_mode': [None, 'squeeze'],
    'files': [3, ['x']],
    'custom_data': ['x', {'key': 3}],
    'ros_distro': [3],
}
INVALID_TOPIC = {
    'name': [ABSENT, None, ['x'], ''],
    'type': [3, ''],
    'serialization_format': [None, 'json'],
    'offered_qos_profiles': ['{', 3, ['x'], [{}], [{'history': 3}]],
    'type_description_hash': [3],
}
TOPIC = (TOPICS, 0, 'topic_metadata')


HARMLESS = {'version', 'duration', 'message_count', 'compression_format', 'files', 'ros_distro'}
"""Some values of these are read."""


def test_an_invalid_value_is_an_error_or_changes_nothing(whole, tmp_path):
    changes = [(key, value) for key, values in INVALID.items() for value in values]
    changes += [(*TOPIC, key, value) for key, values in INVALID_TOPIC.items() for value in values]
    changes += [(*TOPIC, ABSENT), (TOPICS, 0, 'message_count', -3)]
    read = set()
    for number, change in enumerate(changes):
        bag = shutil.copytree(whole['mcap'], tmp_path / str(number))
        edit(bag, *change)
        with suppress(DamagedBagError):
            assert len(read_run(bag).odometry) == COUNT, change
            read.add(change[-2])
        with suppress(NothingToSaveError):
            assert len(read_run(recover(bag).bag).odometry) == COUNT, change
    assert read <= HARMLESS | {'type_description_hash'}


@pytest.mark.parametrize(('key', 'value'), [('name', ''), ('type', 3)])
def test_names_of_topics_and_types_must_be_text(bag, key, value):
    edit(bag, *TOPIC, key, value)
    with pytest.raises(DamagedBagError, match=f'the {key} of a topic must be text .*, got {value!r}'):
        read_run(bag)


@pytest.mark.parametrize('text', ['', '[1, 2', '\0', 'x', 'x: !!y z', f'{KEY}: 3', '[[' * 1500])
def test_metadata_that_is_no_map_or_too_deep_is_damage(whole, tmp_path, text):
    bag = shutil.copytree(whole['mcap'], tmp_path / 'bag')
    (bag / 'metadata.yaml').write_text(text)
    with pytest.raises(BagError, match=r'metadata|YAML'):
        read_run(bag)
    assert len(read_run(recover(bag).bag).odometry) == COUNT


@pytest.mark.parametrize(('key', 'value'), [('storage_identifier', 'nine'), ('name', '/x')])
def test_all_tools_agree_on_a_damaged_bag(bag, tmp_path, capsys, key, value):
    if key == 'storage_identifier':
        edit(bag, key, value)
    else:
        # Only the data file shows that it is wrong.
        edit(bag, TOPICS, topic_index(bag), 'topic_metadata', key, value)
    bag = bag.rename(tmp_path / 'a bag')
    named = 'nine' if value == 'nine' else '/odom'
    for tool in (plot_run, replay_run):
        code, out, err = run_tool(tool.main, capsys, bag)
        assert (code, out) == (2, '')
        assert len(err.splitlines()) == 1
        assert named in err
        assert f"`recover_run '{bag}'` saves what can be read" in err
    code, out, err = run_tool(recover_run.main, capsys, bag)
    assert (code, err) == (0, '')
    assert named in out
    recovered = tmp_path / 'a bag_recovered'
    assert len(read_run(recovered).odometry) == COUNT
    assert run_tool(replay_run.main, capsys, recovered, '--verify')[0] == 0


def topic_index(bag, topic='/odom'):
    """Return the index of a topic in metadata.yaml."""
    content = load_yaml(bag / 'metadata.yaml')
    topics = content[KEY][TOPICS]
    return [one['topic_metadata']['name'] for one in topics].index(topic)


def test_metadata_that_other_versions_write_is_read(whole, tmp_path):
    bag = shutil.copytree(whole['mcap'], tmp_path / 'bag')
    text = (bag / 'metadata.yaml').read_text()
    for change in (
        *(('ros_distro', None), ('ros_distro', ABSENT), ('custom_data', None), ('custom_data', ABSENT)),
        *(('compression_format', None), ('compression_mode', ABSENT), ('files', ABSENT), ('files', [])),
        *(('version', 5), ('unknown', [1, 2])),
        (*TOPIC, 'type_description_hash', ABSENT),
    ):
        (bag / 'metadata.yaml').write_text(text)
        edit(bag, *change)
        run = read_run(bag)
        assert (len(run.odometry), run.notes, find_damage(bag)) == (COUNT, (), ''), change
    with pytest.raises(NothingToSaveError):
        recover(bag)


@pytest.mark.parametrize('told', [0, COUNT + 1])
def test_another_number_of_messages_is_noted(bag, told):
    edit(bag, 'message_count', 2 + told)
    edit(bag, TOPICS, topic_index(bag), 'message_count', told)
    run = read_run(bag)
    assert run.notes == (f'{COUNT} messages on /odom were found, the bag should have {told}',)
    assert f'it should have {2 + told} messages, {2 + COUNT} can be read' in find_damage(bag)
    recovery = recover(bag)
    assert recovery.summary.messages == 2 + COUNT
    assert len(read_run(recovery.bag).odometry) == len(run.odometry) == COUNT


def test_qos_that_differs_from_the_file_hides_no_messages(bag):
    """rosbags takes such topics for two and reads nothing, without a word."""
    profile = {
        **{'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile'},
        **{name: {'sec': 0, 'nsec': 0} for name in ('deadline', 'lifespan')},
        **{'liveliness': 'automatic', 'liveliness_lease_duration': {'sec': 0, 'nsec': 0}},
        'avoid_ros_namespace_conventions': False,
    }
    edit(bag, TOPICS, topic_index(bag), 'topic_metadata', 'offered_qos_profiles', [profile])
    with pytest.raises(BagError, match=r'QoS.*recover_run'):
        read_run(bag)
    assert len(read_run(recover(bag).bag).odometry) == COUNT


@pytest.mark.parametrize(
    ('storage', 'old', 'new', 'said'),
    [
        ('mcap', '"wheel_radius": 0.033', '"wheel_radius": 0.035', 'parameters of /virtual_robot'),
        ('sqlite3', ODOMETRY.type_hash, f'RIHS01_{64 * "0"}', 'type hash of /odom'),
    ],
)
def test_metadata_is_compared_with_the_data_file(tmp_path, storage, old, new, said):
    bag = make_bag(tmp_path / 'bag', storage, {'/virtual_robot': {'wheel_radius': 0.033}})
    text = (bag / 'metadata.yaml').read_text()
    assert text.count(old) == 1
    (bag / 'metadata.yaml').write_text(text.replace(old, new))
    recovery = recover(bag)
    assert recovery.lost == (f'metadata.yaml differs from the data file, from which is saved: {said}',)
    run = read_run(recovery.bag)
    assert (len(run.odometry), run.notes) == (COUNT, ())
    assert run.of_node('virtual_robot') == {'wheel_radius': 0.033}


# --- Cells of SQLite


@pytest.mark.parametrize(
    ('table', 'column', 'value', 'left'),
    [
        ('topics', 'name', b'/o', 0),
        ('topics', 'type', 'a.b/msg/C', 0),
        ('topics', 'id', 7, 0),
        ('topics', 'serialization_format', 'json', 0),
        ('topics', 'offered_qos_profiles', '{', COUNT),
        ('topics', 'type_description_hash', 'x', COUNT),
        ('message_definitions', 'encoded_message_definition', '\x1b[2J', COUNT),
        ('messages', 'topic_id', 'x', COUNT - 1),
        ('messages', 'timestamp', -1, COUNT - 1),
        ('messages', 'timestamp', 'x', COUNT - 1),
        ('messages', 'data', 'x', COUNT - 1),
        ('metadata', 'metadata', '- &a [*a]', COUNT),
        ('schema', 'schema_version', 99, COUNT),
    ],
)
def test_an_invalid_cell_is_damage_or_changes_nothing(whole, tmp_path, table, column, value, left):
    bag = shutil.copytree(whole['sqlite3'], tmp_path / 'bag')
    change = f'UPDATE {table} SET {column} = ? WHERE rowid = (SELECT max(rowid) FROM {table})'
    with closing(sqlite3.connect(data_file(bag))) as database, database:
        database.execute(change, (value,))
    with suppress(DamagedBagError):
        run = read_run(bag)
        assert len(run.odometry) == left
        assert left + sum(run.skipped.values()) + sum(run.missing.values()) == COUNT
    with suppress(UncheckedError):
        assert len(read_run(recover(bag).bag).odometry) == left


# --- Parameters


def test_parameters_that_are_none_are_left_out_by_recover_run(tmp_path):
    poses = [Message(0, i * SECOND, serialize_message(odom(0, 0, 0, seconds=i))) for i in (1, 2)]
    other = Text(f'{PARAMETERS}/other', '{"kp": 3.0}')
    for number, text in enumerate(('', '[1, 2]', '3', '[' * 10_000, '{"kp": ' + '9' * 5000 + '}')):
        bag = tmp_path / f'{number}'
        records = [Text(f'{PARAMETERS}/robot', text), other, *poses]
        build_bag([channel(0, '/odom', ODOMETRY.name)], records, bag)
        with pytest.raises(BagError, match=r'parameters of /robot.*recover_run'):
            read_run(bag)
        recovery = recover(bag)
        assert 'parameters of /robot' in recovery.lost[0]
        assert read_run(recovery.bag).parameters == {'/other': {'kp': 3.0}}


def test_invalid_parameters_are_as_if_absent(tmp_path):
    sent = [
        (1.0, '/goal_pose', goal(1.0, 0.5)),
        (1.0, '/joint_states', joint_command(1, 2)),
        (1.2, '/joint_command', joint_command(1, 2)),
    ]
    sent += [(1.1 + i / 50, '/odom', odom(i / 50, 0, 0, seconds=1.1 + i / 50)) for i in range(COUNT)]
    names = ('xy_goal_tolerance', 'offset', 'linear.x.max_velocity', 'max_wheel_velocity')
    names += ('left_wheel_name', 'right_wheel_name')
    law = {'controller': 'offset_point'}

    def given(value):
        values = dict.fromkeys(names, value)
        return {'/go_to_goal': values | law, '/virtual_robot': values, '/wheel_bridge': values}

    run = read_run(write_bag(tmp_path / 'bag', sent, parameters=given(None)))
    np.testing.assert_array_equal(run.wheel_commands.values, [[2.0, 1.0]])
    assert len(run.wheels) == 1
    for value in ('x', None, [1], {}, True, 10**400, math.nan, -1.0, 1e308):
        one = timeline(replace(run, parameters=given(value)))
        for bounds in limits(one).values():
            assert not np.isinf(bounds).any()


# --- Messages that cannot be decoded


def test_messages_that_cannot_be_decoded_leave_the_bag_readable(whole, tmp_path):
    bag = shutil.copytree(whole['sqlite3'], tmp_path / 'bag')
    with closing(sqlite3.connect(data_file(bag))) as database, database:
        database.execute(
            "UPDATE messages SET data = ? WHERE topic_id = (SELECT id FROM topics WHERE name = '/odom') "
            'AND timestamp < ?',
            (b'\0\1\0\0xyz', round(1.15 * SECOND)),
        )
    note = f'3 of {COUNT} messages on /odom cannot be decoded as little-endian CDR'
    assert verify(read_run(bag)).notes[0] == f'{note} and were skipped'
    with pytest.raises(UncheckedError) as caught:
        recover(bag)
    assert caught.value.args[-1] == note
    (bag / 'metadata.yaml').unlink()
    recovery = recover(bag)
    assert recovery.undecodable == (note,)
    assert read_run(recovery.bag).skipped == {'/odom': 3}


def test_recover_run_says_what_it_did_not_check(tmp_path):
    mine = replace(channel(0, '/x', ODOMETRY.name), type_name='my_msgs/msg/Mine', type_hash='RIHS01_00')
    journal = write_records(tmp_path / 'bag', mine, Message(0, SECOND, b'\0\1\0\0\1\0\0\0'))
    assert recover(journal).undecodable == (
        'the 1 messages on /x were not checked: their type is not installed as it was recorded',
    )


# --- What the message about an unreadable bag says


def test_recover_run_is_named_where_something_may_be_saved(bag, tmp_path):
    file = data_file(bag)
    file.write_bytes(file.read_bytes()[:-5000])
    journal = write_records(tmp_path / 'my crash', Text('storage', 'mcap'))
    for given in (bag, file):
        with pytest.raises(BagError, match=f'`recover_run {given}`'):
            read_run(given)
    for given in (journal, tmp_path / 'my crash'):
        with pytest.raises(BagError, match=f"`recover_run '{journal}'`"):
            read_run(given)
    (bag / 'metadata.yaml').unlink()
    with pytest.raises(BagError, match=f'`recover_run {bag}`'):
        read_run(bag)
    file.unlink()
    (tmp_path / 'folder').mkdir()
    for letter in (tmp_path / 'folder' / 'letter', tmp_path / 'letter.txt'):
        letter.write_text('Dear')
    for name, words in {
        'bag': 'an empty folder',
        'nothing': 'there is no bag',
        'folder': r'without metadata\.yaml',
        'letter.txt': 'neither MCAP nor SQLite',
    }.items():
        with pytest.raises(BagError, match=f'{name}.*{words}|{words}.*{name}') as caught:
            read_run(tmp_path / name)
        assert '`recover_run' not in str(caught.value)
