"""Decoding without ROS equals that of rclpy; malformed and foreign messages end in a typed error."""

from __future__ import annotations

import random
import struct
from dataclasses import replace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_reading import SECOND, odom, write_bag

from diffdrive_jacobian.bags import decoding
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.decoding import (
    UndecodableError,
    decode,
    known_definition,
    recorded_definition_differs,
)
from diffdrive_jacobian.bags.journal import Channel, Message
from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.parameter_values import parameter_value
from diffdrive_jacobian.reading import read_run
from diffdrive_jacobian.reading.rows import PARAMETER_EVENTS, ROW_READERS
from diffdrive_jacobian.recovery.salvage_mcap import Topic
from diffdrive_jacobian.recovery.topic_types import definition_and_hash

TYPES = sorted({kind for _, kind in (*ROW_READERS, PARAMETER_EVENTS)})
RANGES = {
    **{f'int{bits}': (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f'uint{bits}': (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}


def random_value(kind, chance):
    """Return a random value of a field type of rclpy, such as `double` or `sequence<string>`."""
    if kind.startswith('sequence<'):
        inner = kind[len('sequence<') : -1].split(',')[0]
        return [random_value(inner, chance) for _ in range(chance.choice((0, 1, 2, 5)))]
    if kind.endswith(']'):
        inner, count = kind[:-1].split('[')
        return [random_value(inner, chance) for _ in range(int(count))]
    if kind in RANGES:
        return chance.choice((*RANGES[kind], chance.randint(*RANGES[kind])))
    if kind == 'boolean':
        return chance.random() < 0.5
    if kind == 'octet':
        return bytes([chance.randrange(256)])
    if kind in ('float', 'double'):
        return chance.choice((0.0, -0.0, 1e308, float('inf'), float('nan'), chance.gauss(0, 10)))
    if kind == 'string':
        return ''.join(chance.choices('abc /_äß漢', k=chance.choice((0, 1, 2, 3, 4, 17))))
    return random_message('{}/msg/{}'.format(*kind.split('/')), chance)


def random_message(name, chance):
    kind = message_class(name)
    values = {
        field: random_value(type_, chance) for field, type_ in kind.get_fields_and_field_types().items()
    }
    return kind(**values)


def assert_same(ours, theirs, where=''):
    if hasattr(theirs, 'get_fields_and_field_types'):
        for field in theirs.get_fields_and_field_types():
            assert_same(getattr(ours, field), getattr(theirs, field), f'{where}.{field}')
    elif isinstance(theirs, str):
        assert ours == theirs, where
    elif np.ndim(theirs) or isinstance(theirs, list) or hasattr(theirs, 'typecode'):
        assert len(ours) == len(theirs), where
        for index, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f'{where}[{index}]')
    elif isinstance(theirs, bytes):
        assert bytes([int(ours) & 0xFF]) == theirs, where
    else:
        np.testing.assert_array_equal(ours, theirs, where)


@pytest.mark.parametrize('name', TYPES)
def test_random_messages_are_decoded_as_by_rclpy(name):
    chance = random.Random(name)
    for _ in range(40):
        message = random_message(name, chance)
        data = serialize_message(message)
        assert_same(decode(data, name), deserialize_message(data, message_class(name)))
        # Fast CDR ignores bytes behind a message.
        assert_same(decode(data + b'\xf0' * 9, name), message)


@pytest.mark.parametrize('name', TYPES)
def test_big_endian_messages_are_decoded(name):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(known_definition('nav_msgs/msg/Goals').text, 'nav_msgs/msg/Goals'))
    chance = random.Random(name)
    for _ in range(5):
        data = serialize_message(random_message(name, chance))
        message = decode(data, name)
        big = bytes(store.serialize_cdr(message, name, little_endian=False))
        assert big[:2] == b'\0\0'
        again = bytes(store.serialize_cdr(decode(big, name), name))
        assert again == bytes(store.serialize_cdr(message, name))


@pytest.mark.parametrize('name', TYPES)
def test_malformed_messages_end_in_a_typed_error_or_a_message(name):
    chance = random.Random(name)
    refused = 0
    for _ in range(150):
        data = bytearray(serialize_message(random_message(name, chance)))
        for _ in range(chance.choice((0, 1, 4))):
            data[chance.randrange(len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
        try:
            decode(bytes(data[: chance.choice((0, 3, 4, len(data) // 2, len(data)))]), name)
        except UndecodableError:
            refused += 1
    assert 60 < refused < 150


def test_every_cut_of_a_message_is_refused():
    data = serialize_message(odom(1.0, 2.0, 0.5))
    for length in range(len(data)):
        with pytest.raises(UndecodableError):
            decode(data[:length], 'nav_msgs/msg/Odometry')


@pytest.mark.parametrize('head', [b'\0\2', b'\0\3', b'\0\6', b'\0\x0b', b'\1\1', b'\xff\xff', b''])
def test_other_encapsulations_than_cdr_are_refused(head):
    data = head + serialize_message(odom(1.0, 2.0, 0.5))[2:]
    with pytest.raises(UndecodableError):
        decode(data, 'nav_msgs/msg/Odometry')


@pytest.mark.parametrize('text', [b'\xff', b'caf\xe9 map', b'\xe4' * 30, b'ab\xc3'])
def test_text_that_is_not_utf8_does_not_cost_a_message(text):
    message = odom(1.0, 2.0, 0.5, 0.25)
    message.header.frame_id = message.child_frame_id = 'x' * len(text)
    data = serialize_message(message).replace(b'x' * len(text), text)
    assert text in data
    found = decode(data, 'nav_msgs/msg/Odometry')
    assert len(found.header.frame_id) == len(found.child_frame_id) == len(text)
    assert '?' in found.header.frame_id
    found.header.frame_id = found.child_frame_id = message.header.frame_id
    assert_same(found, message)


def test_a_type_that_is_not_known_is_refused():
    with pytest.raises(UndecodableError, match='my_msgs/msg/Mine is not a type of ROS 2 Jazzy'):
        decode(b'\0\1\0\0', 'my_msgs/msg/Mine')
    with pytest.raises(UnknownTypeError):
        known_definition('my_msgs/msg/Mine')


# --- Definitions


@pytest.mark.parametrize('name', TYPES)
def test_known_definitions_are_those_of_the_installed_packages(name):
    """An rosbags or ROS release that changes a type fails here."""
    assert known_definition(name).type_hash == definition(name).type_hash


def other_hash():
    return 'RIHS01_' + '0' * 64


def test_only_a_valid_hash_tells_another_definition():
    name = 'nav_msgs/msg/Odometry'
    own = definition(name).type_hash
    assert recorded_definition_differs(name, [own, other_hash()])
    assert not recorded_definition_differs(name, [own, '', 'INVALID', 'RIHS02_' + '0' * 64, 'RIHS01_'])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_of_another_definition_are_reported_and_not_misread(tmp_path, storage):
    channels = [
        Channel(
            id=index,
            topic=topic,
            type_name='nav_msgs/msg/Odometry',
            definition='float64 x\n',
            type_hash=type_hash,
        )
        for index, (topic, type_hash) in enumerate(
            [('/odom', other_hash()), ('/other', definition('nav_msgs/msg/Odometry').type_hash)]
        )
    ]
    data = [Message(0, SECOND, serialize_message(odom(1.0, 2.0, 0.5)))]
    build_bag(lambda: [*channels, *data], tmp_path / 'bag', storage)
    run = read_run(tmp_path / 'bag')
    assert len(run.odometry) == 0
    assert run.skipped == {'/odom': 1}
    assert run.notes == (
        '1 of 1 messages on /odom were recorded with another definition of nav_msgs/msg/Odometry '
        'and were skipped',
    )


def test_definitions_of_a_bag_never_become_code(tmp_path, monkeypatch):
    """Neither reading nor recovery hands a stranger's definition to rosbags' code generator."""
    write_bag(tmp_path / 'bag', [(1.0, '/odom', odom(1.0, 2.0, 0.5))])
    decode(serialize_message(odom(0, 0, 0)), 'nav_msgs/msg/Odometry')

    def generated(*_, **__):
        raise AssertionError('code was generated from a definition')

    monkeypatch.setattr('rosbags.typesys.store.generate_python_code', generated)
    assert len(read_run(tmp_path / 'bag').odometry) == 1
    foreign = Topic(1, '/x', 'evil_msgs/msg/Evil', 'cdr', '', '', 'int32 a\nint32 class\n')
    text, type_hash = definition_and_hash(foreign)
    assert text == foreign.definition
    assert type_hash.startswith('RIHS01_')


@pytest.mark.parametrize('name', [*TYPES, 'tf2_msgs/msg/TFMessage'])
def test_a_parsed_definition_has_the_hash_of_the_type(name):
    known = known_definition(name)
    other = Topic(1, '/x', name.replace('/msg/', '/msg/X'), 'cdr', '', '', known.text)
    assert definition_and_hash(Topic(1, '/x', name, 'cdr', '', '', ''))[1] == known.type_hash
    assert definition_and_hash(other)[1] != known.type_hash


@pytest.mark.parametrize('text', ['evil_msgs/Evil a\n', 'x' * 1000, '%', '\0'])
def test_a_definition_that_cannot_be_parsed_leaves_the_topic_out(text):
    with pytest.raises(UnknownTypeError):
        definition_and_hash(Topic(1, '/x', 'evil_msgs/msg/Evil', 'cdr', '', '', text))


# --- Values of parameters and states of goals


def test_values_of_parameters_are_those_of_rclpy():
    chance = random.Random('parameters')
    for _ in range(100):
        message = random_message('rcl_interfaces/msg/ParameterValue', chance)
        message.type = chance.randint(0, 9)
        expected = parameter_value_to_python(message)
        ours = decode(serialize_message(message), 'rcl_interfaces/msg/ParameterValue')
        for one in (parameter_value(ours), parameter_value(message)):
            np.testing.assert_equal(one, list(expected) if np.ndim(expected) else expected)
    with pytest.raises(MessageError, match='must be 0 to 9, got 10'):
        parameter_value(ParameterValue(type=10))
    assert ParameterType.PARAMETER_STRING_ARRAY == 9


def test_states_of_goals_are_those_of_action_msgs():
    for state in GoalState:
        assert getattr(GoalStatus, f'STATUS_{state.name}') == state
    assert len(GoalState) == sum(name.startswith('STATUS_') for name in dir(GoalStatus))


def test_the_length_of_a_text_is_found_with_its_own_byte_order():
    text = b'caf\xe9'
    head = struct.pack('>iII', 3, 4, len(text) + 1) + text + b'\0' + b'\0\0\0'
    found = decode(b'\0\0\0\0' + head, 'std_msgs/msg/Header')
    assert (found.stamp.sec, found.stamp.nanosec, found.frame_id) == (3, 4, 'caf?')


def serialized(type_name, **fields):
    return serialize_message(message_class(type_name)(**fields))


def test_a_message_of_very_many_nested_messages_is_refused(monkeypatch):
    """Poses and parameters take up to thirty times more memory as Python objects than as CDR."""
    pose = message_class('geometry_msgs/msg/PoseStamped')()
    name = 'nav_msgs/msg/Goals'
    # Goals and its Header and Time, and six for each pose.
    monkeypatch.setattr(decoding, '_SMALL', 1000)
    monkeypatch.setattr(decoding, 'MAX_OBJECTS', 3 + 6 * 50)
    assert len(decode(serialized(name, goals=[pose] * 50), name).goals) == 50
    with pytest.raises(UndecodableError):
        decode(serialized(name, goals=[pose] * 51), name)
    # It counts for each message anew.
    assert len(decode(serialized(name, goals=[pose] * 50), name).goals) == 50


def test_a_large_message_with_very_many_strings_is_refused(monkeypatch):
    monkeypatch.setattr(decoding, 'MAX_TEXTS', 1000)
    for name, field in (
        ('sensor_msgs/msg/JointState', 'name'),
        ('rcl_interfaces/msg/ParameterValue', 'string_array_value'),
    ):
        assert len(getattr(decode(serialized(name, **{field: ['abc'] * 100}), name), field)) == 100
        with pytest.raises(UndecodableError):
            decode(serialized(name, **{field: ['abc'] * 150}), name)


@pytest.mark.parametrize('name', ['sensor_msgs/msg/Image', 'sensor_msgs/msg/PointCloud2'])
def test_large_arrays_of_numbers_are_decoded(name):
    size = decoding.MAX_TEXTS + 1
    store = get_typestore(Stores.ROS2_JAZZY)
    message = replace(decode(serialized(name), name), data=np.zeros(size, np.uint8))
    assert len(decode(bytes(store.serialize_cdr(message, name)), name).data) == size
