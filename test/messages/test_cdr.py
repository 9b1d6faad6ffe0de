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

"""Fields read from and written into serialized messages, compared with rclpy's own conversion."""

from __future__ import annotations

import copy
import struct
import tracemalloc
from functools import cache

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import (
    Point32,
    Polygon,
    PolygonStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Twist,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterEvent
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_msgs.msg import Empty, Float64MultiArray, Header, String

from diffdrive_jacobian.faults.message_field import MessageField
from diffdrive_jacobian.messages.cdr import DecodingError, Reader, Writer
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import import_type
from diffdrive_jacobian.messages.structure import (
    Array,
    Number,
    Sequence,
    Structure,
    Text,
    field_value,
    structure,
    walk,
)

CLASSES = (
    *(ParameterDescriptor, ParameterEvent),
    *(Odometry, Twist, JointState, Clock, PoseStamped, PoseWithCovarianceStamped),
    *(Goals, Float64MultiArray, GoalStatus, LaserScan),
)
by_class = pytest.mark.parametrize('message_class', CLASSES, ids=lambda one: one.__name__)
quickly = settings(max_examples=5, deadline=None)
ENCAPSULATIONS = (b'\0\0', b'\0\1', b'\0\2', b'\0\3', b'\0\6', b'\0\7', b'\0\10', b'\0\11', b'\1\1')
"""CDR, parameter lists and version 2, in both byte orders, and an unknown one."""


def values(kind):
    """Return a strategy for a field."""
    match kind:
        case Number(code='?'):
            return st.booleans()
        case Number(code='c'):
            return st.binary(min_size=1, max_size=1)
        case Number():
            small = st.floats(-(2.0**126), 2.0**126, width=32)
            floats = small if kind.code == 'f' else st.floats()
            return floats if kind.is_float else st.integers(*kind.limits)
        case Text():
            return st.text(max_size=20)
        case Structure():
            return messages(import_type(kind.name.replace('/', '/msg/')))
        case Array():
            # A few different ones, repeated: drawing 36 takes long.
            few = st.lists(values(kind.element), min_size=1, max_size=5)
            return few.map(lambda some: [some[number % len(some)] for number in range(kind.count)])
        case Sequence():
            return st.lists(values(kind.element), max_size=min(4, kind.most or 4))


@cache
def messages(message_class):
    fields = structure(message_class).fields
    return st.builds(message_class, **{name: values(kind) for name, kind in fields})


def readable(kind, prefix=''):
    """Return the paths of all fields that a Reader can return."""
    paths = []
    for name, field in kind.fields:
        path, element = prefix + name, getattr(field, 'element', field)
        if isinstance(field, Structure):
            paths += readable(field, f'{path}.')
        if isinstance(field, Sequence) and isinstance(element, Structure):
            inner = readable(element, f'{path}[].')
            paths += [one for one in inner if one.count('[]') == 1]
        if isinstance(element, (Number, Text)):
            paths.append(path)
    return paths


def numbers(message):
    """Return the paths and types of all numbers of a message that a Writer can write."""
    found = {}
    for path, kind, value in walk(structure(type(message)), message):
        element = getattr(kind, 'element', kind)
        if isinstance(element, Number) and not path.startswith('len('):
            paths = [path] if element is kind else [f'{path}[{one}]' for one in range(len(value))]
            found.update(dict.fromkeys(paths, element))
    return found


def bits(value):
    """Return a value such that equal means equal bits, also for NaN."""
    if isinstance(value, float):
        return struct.pack('<d', value)
    if hasattr(value, 'get_fields_and_field_types'):
        return tuple(bits(getattr(value, name)) for name in value.get_fields_and_field_types())
    if isinstance(value, (str, int, bytes)):
        return value
    return tuple(bits(one) for one in (value.tolist() if hasattr(value, 'tolist') else value))


def outcome(read, data):
    """Return the bits that a function reads, or None if it refuses the bytes as it should."""
    try:
        return bits(read(data))
    except DecodingError:
        return None


def rclpy_outcome(message_class, fields, data):
    try:
        message = deserialize_message(data, message_class)
    except RuntimeError:
        return None
    return tuple(bits(field_value(message, path)) for path in fields)


def reader(message_class, fields):
    return Reader(message_class, fields, deserialize=deserialize_message)


# --- Reading


@by_class
@quickly
@given(data=st.data())
def test_any_fields_are_read_as_rclpy_reads_them(message_class, data):
    every = readable(structure(message_class))
    fields = data.draw(st.lists(st.sampled_from(every), unique=True))
    read = reader(message_class, fields)
    for message in data.draw(st.lists(messages(message_class), min_size=1, max_size=3)):
        serialized = serialize_message(message)
        expected = rclpy_outcome(message_class, fields, serialized)
        assert expected is not None
        # The second time with the layout of the first.
        assert outcome(read, serialized) == outcome(read, serialized) == expected


LENGTHS = [struct.pack('<I', one) for one in (0, 1, 2, 5, 255, 1 << 16, (1 << 32) - 1)]
NESTED = Float64MultiArray, ParameterEvent
"""Types with sequences in nested structures: rclpy reads too long ones as empty."""


@by_class
@quickly
@given(data=st.data())
def test_damaged_bytes_are_refused_or_read_as_by_rclpy(message_class, data):
    """Overwritten, lengths too, prolonged, or under another encapsulation."""
    fields = readable(structure(message_class))
    read = reader(message_class, fields)
    serialized = serialize_message(data.draw(messages(message_class)))
    # A layout to be misled by.
    read(serialized)
    damaged = bytearray(serialized)
    word = data.draw(st.binary(min_size=1, max_size=8) | st.sampled_from(LENGTHS))
    place = data.draw(st.integers(4, len(damaged)) | st.integers(4, 40))
    damaged[place : place + len(word)] = word
    damaged += data.draw(st.binary(max_size=9))
    damaged[:2] = data.draw(st.just(damaged[:2]) | st.sampled_from(ENCAPSULATIONS))
    ours = outcome(read, bytes(damaged))
    theirs = rclpy_outcome(message_class, fields, bytes(damaged))
    # The exception is that of the test of sequences in nested structures.
    assert ours == theirs or (ours is None and message_class in NESTED)


def test_bytes_cut_off_anywhere_are_refused_as_by_rclpy():
    joints = JointState(name=['left', 'right'], velocity=[1.0, 2.0])
    for message in (joints, ParameterEvent(node='a', new_parameters=[Parameter(name='b')])):
        fields = readable(structure(type(message)))
        read, serialized = reader(type(message), fields), serialize_message(message)
        assert outcome(read, serialized) is not None
        assert outcome(read, b'') is None
        for size in range(len(serialized)):
            data = serialized[:size]
            assert outcome(read, data) == rclpy_outcome(type(message), fields, data), size


def test_a_sequence_in_a_nested_structure_with_more_elements_than_bytes_is_refused():
    """As any other one is by rclpy, which reads this one as empty: the points would be lost silently."""
    points = [Point32(x=1.0)] * 5
    serialized = serialize_message(PolygonStamped(polygon=Polygon(points=points)))
    fields = ['polygon.points[].x']
    read = reader(PolygonStamped, fields)
    assert read(serialized) == ((1.0,) * 5,)
    first = len(serialized) - 5 * 12
    # Less than one byte for each point is left.
    for damaged in (serialized[:first], serialized[: first + 4]):
        assert outcome(read, damaged) is None
        assert rclpy_outcome(PolygonStamped, fields, damaged) == ((),)


def test_unusual_strings_are_read_as_rclpy_reads_them():
    """Without NUL, with one inside, with invalid UTF-8."""
    for content in (
        *(b'\0\0\0\0', b'\1\0\0\0a', b'\4\0\0\0a\0b\0', b'\4\0\0\0abcd'),
        b'\4\0\0\0a\xff\xfe\0',
    ):
        data = b'\0\1\0\0' + content
        assert Reader(String, ['data'])(data) == (deserialize_message(data, String).data,)


def test_other_encapsulations_are_left_to_rclpy():
    fields = ['stamp.sec', 'stamp.nanosec', 'frame_id']
    for encapsulation in ENCAPSULATIONS[:-1]:
        big = not encapsulation[1] & 1
        fixed = struct.pack('>2xiII' if big else '<2xiII', 12, 34, 5)
        data = encapsulation + fixed + b'odom\0'
        assert reader(Header, fields)(data) == (12, 34, 'odom')
        if encapsulation == b'\0\1':
            assert Reader(Header, fields)(data) == (12, 34, 'odom')
        else:
            words = f'little-endian CDR, which begins with 0001, .* begins with {encapsulation.hex()}'
            with pytest.raises(DecodingError, match=words):
                Reader(Header, fields)(data)


def test_a_huge_length_takes_no_memory():
    data = b'\0\1\0\0' + bytes(8) + b'\1\0\0\0\0\0\0\0'
    read = Reader(JointState, ['name', 'position', 'velocity'])
    tracemalloc.start()
    try:
        for lengths in (b'\xff\xff\xff\xff', bytes(4) + b'\xff\xff\xff\xff', b'\xff\xff\xff\x7f'):
            with pytest.raises(DecodingError):
                read(data + lengths + bytes(64))
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


def test_messages_of_many_sizes_are_read_one_after_the_other_in_little_memory():
    read = Reader(JointState, ['name', 'velocity'])
    for count in (*range(20), 5000, 3):
        names = [str(one) for one in range(count)]
        data = serialize_message(JointState(name=names, velocity=[0.5] * count))
        assert read(data) == (tuple(names), (0.5,) * count)
    assert len(read._layouts) <= 16


def test_the_start_of_a_message_can_be_read_without_the_rest():
    message = Goals(goals=[PoseStamped()] * 3)
    message.header.stamp.sec = 7
    data = serialize_message(message)[:24]
    fields = ['header.stamp.sec', 'header.frame_id']
    assert Reader(Goals, fields, whole=False)(data) == (7, '')
    with pytest.raises(DecodingError):
        Reader(Goals, fields)(data)


def test_a_field_that_cannot_be_read_is_an_error():
    for wrong in ('pose', 'pose.pose.q', 'header.stamp.sec.x', 'len(q)', 'pose.covariance[]'):
        with pytest.raises(ValueError, match='a field of Odometry must be'):
            Reader(Odometry, [wrong])
    fields = ('number', Number('b')), ('text', Text(wide=True))
    wide = Structure('a_msgs/One', fields)
    with pytest.raises(TypeError, match=r'a_msgs/One.text must not be a wide string'):
        Reader(wide, ['number'])


# --- Writing


@by_class
@quickly
@given(data=st.data())
def test_numbers_are_written_as_rclpy_writes_them(message_class, data):
    template = data.draw(messages(message_class))
    kinds = numbers(template)
    subset = st.sets(st.sampled_from(list(kinds)), max_size=8) if kinds else st.just(set())
    paths = data.draw(subset)
    chosen = [(path, kind) for path, kind in kinds.items() if path in paths]
    write = Writer(template, [path for path, _ in chosen])
    message = copy.deepcopy(template)
    for _ in range(2):
        new = [data.draw(values(kind)) for _, kind in chosen]
        for (path, _), value in zip(chosen, new, strict=True):
            MessageField(message_class, path).replace(message, lambda _, value=value: value)
        ours, theirs = write((*new,)), serialize_message(message)
        assert bits(deserialize_message(ours, message_class)) == bits(
            deserialize_message(theirs, message_class)
        )
        # Padding is not set by rclpy, which also appends bytes that are not part of the message.
        differing = [mine for mine, other in zip(ours, theirs, strict=False) if mine != other]
        assert not any(differing)
        assert len(ours) <= len(theirs)
        with pytest.raises(RuntimeError):
            deserialize_message(ours[:-1], message_class)


def test_what_cannot_be_written_is_an_error():
    for fields, error in (
        (['linear.q'], 'a field must be a number'),
        (['linear'], 'a field must be a number'),
        (['angular.z', 'linear.x'], 'in the order of the message'),
        (['linear.x', 'linear.x'], 'in the order of the message'),
    ):
        with pytest.raises(ValueError, match=error):
            Writer(Twist(), fields)
    for numbers in ((), (1.0, 2.0), ('1',), (None,)):
        with pytest.raises(ValueError, match='Twist cannot be serialized'):
            Writer(Twist(), ['linear.x'])(numbers)
    with pytest.raises(ValueError, match='Clock cannot be serialized'):
        Writer(Clock(), ['clock.sec'])((1 << 31,))
    with pytest.raises(MessageError, match='String cannot be serialized'):
        Writer(String(data='\ud800'), [])


def test_a_message_without_fields_is_one_byte():
    read = Reader(Empty, [])
    assert read(serialize_message(Empty())) == read(Writer(Empty(), [])(())) == ()
    with pytest.raises(DecodingError):
        read(b'\0\1\0\0')
