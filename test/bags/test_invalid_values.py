"""Bags and journals with invalid values anywhere: reading them ends in a typed error, or in a run.

Their bytes are whole, with right checksums. Damaged bytes are in `test_damage_fuzz`.
"""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing, suppress

import pytest
from hostile_bags import chunk
from rclpy.serialization import serialize_message
from ruamel.yaml import YAML
from support.bags import SECOND, changed, odom, write_bag
from support.raw_bags import LATCHED, PLUGINS, channel, data_file, mcap_records, write_records
from support.ros_messages import goal, joint_command, twist

from diffdrive_jacobian.bags import BagError, NotABagError, NothingToSaveError, mcap, read_run, recover
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Message, Text
from diffdrive_jacobian.bags.timeline import commanded, limits, measured, timeline
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.plots.run_figure import LABELS

pytestmark = pytest.mark.usefixtures('quick_disk')

TYPED = (BagError, NotABagError, NothingToSaveError, ParameterError)
VALUES = (
    *(None, True, 0, -1, 1, 7, 2**31, 2**63 - 1, 2**63, -(2**63), 10**30, 0.5, -0.0, 1e308),
    *(float('nan'), float('inf'), '', 'x', '/odom', '3', '\0', '\x1b[2J', 'a/b/c/d', '../..', 'é' * 300),
    *('nav_msgs/msg/Odometry', 'this/msg/X', 'a.b/msg/C', '{', '[', '- &a [*a]', '{"a": NaN}'),
    *([], {}, [None], [[]], ['x'], {'x': None}, {'nanoseconds': 'x'}, [{'topic_metadata': {}}]),
)
PARAMETERS = {'/virtual_robot': {'wheel_radius': 0.03}, '/go_to_goal': {'xy_goal_tolerance': 0.1}}


def sent():
    """Yield what is in the bags that become invalid."""
    for index in range(4):
        at = 1.0 + index / 10
        yield at, '/odom', odom(index / 20, 0, 0, 0.5, seconds=at)
        yield at, '/cmd_vel', twist(0.5, 0.0)
        yield at, '/joint_states', joint_command(1.0, 1.0, round(at * SECOND))
    yield 1.2, '/goal_pose', goal(0.3, 0.1)
    yield 1.3, '/parameter_events', changed('/virtual_robot', 'wheel_radius', 0.04)


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    messages = sorted(sent(), key=lambda one: one[0])
    return {
        storage: write_bag(folder / storage, messages, storage=storage, parameters=PARAMETERS)
        for storage in PLUGINS
    }


# --- The oracle


def attempt(function, *arguments):
    """Call a function and return whether it returned. Errors other than the typed ones are failures."""
    try:
        function(*arguments)
    except TYPED:
        return False
    return True


def read_and_use(bag):
    """Read, trace and verify a bag as the tools do."""
    run = read_run(bag)
    attempt(verify, run)
    one = timeline(run)
    limits(one)
    for quantity in LABELS:
        measured(one, quantity)
        commanded(one, quantity)


def check(bag, folder):
    """Return whether a bag is readable, and whether recovery writes a new one, which then is."""
    readable = attempt(read_and_use, bag)
    new = folder / 'new'
    recovered = attempt(recover, bag, new)
    if recovered:
        read_run(new)
        # The new bag is complete, unless the definition of a type cannot be parsed.
        with suppress(NothingToSaveError):
            assert recover(new, folder / 'again').topics_left_out
            shutil.rmtree(folder / 'again')
        shutil.rmtree(new)
    return readable, recovered


# --- Bags


def places(content, keys=()):
    """Return the path of keys to every value."""
    found = [keys] if keys else []
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        inner = (*keys, key)
        found += places(value, inner) if isinstance(value, (dict, list)) else [inner]
    return found


def mutate(content, chance):
    """Replace, remove or add some values of nested maps and lists."""
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        *keys, last = chance.choice(places(content))
        inner = content
        for key in keys:
            inner = inner[key]
        if chance.random() < 0.15:
            del inner[last]
        elif chance.random() < 0.1 and isinstance(inner, dict):
            inner[chance.choice(('x', 3, None, ''))] = chance.choice(VALUES)
        else:
            inner[last] = chance.choice(VALUES)


@pytest.mark.parametrize('storage', PLUGINS)
def test_metadata(bags, tmp_path, storage):
    chance = random.Random(f'metadata {storage}')
    yaml = YAML(typ='safe')
    text = (bags[storage] / 'metadata.yaml').read_text()
    bag = shutil.copytree(bags[storage], tmp_path / 'bag')
    results = []
    for _ in range(6):
        content = yaml.load(text)
        mutate(content, chance)
        with open(bag / 'metadata.yaml', 'w') as file:
            yaml.dump(content, file)
        results.append(check(bag, tmp_path)[0])
    assert set(results) == {True, False}


TABLES = ('topics', 'messages', 'message_definitions', 'schema', 'metadata')


@pytest.fixture(scope='module')
def untyped(bags, tmp_path_factory):
    """A bag in SQLite whose columns have no types, which would be forced upon the values."""
    bag = shutil.copytree(bags['sqlite3'], tmp_path_factory.mktemp('untyped') / 'bag')
    with closing(sqlite3.connect(data_file(bag))) as database, database:
        for table in TABLES:
            database.execute(f'CREATE TABLE other ({", ".join(columns(database, table))})')
            database.execute(f'INSERT INTO other SELECT * FROM {table}')
            database.execute(f'DROP TABLE {table}')
            database.execute(f'ALTER TABLE other RENAME TO {table}')
    return bag


def columns(database, table):
    return [row[1] for row in database.execute(f'PRAGMA table_info({table})')]


def test_cells_of_sqlite(untyped, tmp_path):
    chance = random.Random('cells')
    cells = [one for one in VALUES if not isinstance(one, (list, dict)) and one not in (2**63, 10**30)]
    cells += [b'', b'\0', b'\0\1\0\0', b'\xff' * 40, chance.randbytes(400)]
    results = []
    for number in range(8):
        bag = shutil.copytree(untyped, tmp_path / f'bag{number}')
        with closing(sqlite3.connect(data_file(bag))) as database, database:
            for _ in range(chance.choice((1, 1, 2, 5))):
                table = chance.choice(('topics', 'messages', *TABLES[:4]))
                column = chance.choice(columns(database, table))
                (row,) = chance.choice(database.execute(f'SELECT rowid FROM {table}').fetchall())
                change = f'UPDATE {table} SET {column} = ? WHERE rowid = ?'
                database.execute(change, (chance.choice(cells), row))
        results.append(check(bag, tmp_path)[0])
        if number % 4 == 0:
            (bag / 'metadata.yaml').unlink()
            assert not check(bag, tmp_path)[0]
            check(data_file(bag), tmp_path)
    assert set(results) == {True, False}


def test_messages(tmp_path):
    """Damaged messages are either used or counted."""
    chance = random.Random('messages')
    for number in range(3):
        bag, channels, records = tmp_path / f'bag{number}', {}, []
        for at, topic, message in sent():
            data = bytearray(serialize_message(message))
            for _ in range(chance.choice((0, 1, 3))):
                data[chance.randrange(4, len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            name = f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'
            known = channels.setdefault(topic, channel(len(channels), topic, name, (LATCHED,)))
            cut = chance.choice((len(data), 12))
            records.append(Message(known.id, round(at * SECOND), bytes(data[:cut])))
        build_bag(channels.values(), records, bag, 'mcap')
        assert sum(read_run(bag).skipped.values()) > 0
        attempt(read_and_use, bag)


# --- Journals


@pytest.fixture(scope='module')
def journal(tmp_path_factory):
    """The records of a journal without their heads: those outside of its chunk, those in it."""
    written = [
        Text('storage', 'mcap'),
        Text('parameters of /go_to_goal', json.dumps({'kp': 3.0})),
        channel(0, '/odom', 'nav_msgs/msg/Odometry', (LATCHED,)),
        channel(1, '/cmd_vel', 'geometry_msgs/msg/Twist', (LATCHED,)),
    ]
    for second in (1, 2, 3):
        pose = serialize_message(odom(second, 0, 0, seconds=second))
        written.append(Message(0, second * SECOND, pose))
        written.append(Message(1, second * SECOND, serialize_message(twist(0.5, 0.0))))
    path = write_records(tmp_path_factory.mktemp('journal') / 'good', *written)
    data = path.read_bytes()
    *outside, (_, start, end) = mcap_records(data)
    # After opcode, length, times, size, checksum, compression and size of a chunk.
    inside = data[start + 49 : end]
    return [[one, data[at + 9 : to]] for one, at, to in outside], [
        [one, inside[at + 9 : to]] for one, at, to in mcap_records(inside, 0)
    ]


def joined(outside, inside):
    """Return a file in which all checksums are right."""
    data, parts = b''.join(mcap.record(*one) for one in inside), [mcap.MAGIC]
    for opcode, payload in outside:
        if opcode == mcap.ATTACHMENT:
            payload = payload[:-4] + struct.pack('<I', zlib.crc32(payload[:-4]))
        parts.append(mcap.record(opcode, payload))
    return b''.join([*parts, chunk('', data, len(data), zlib.crc32(data))])


def test_records_of_journals(journal, tmp_path):
    chance = random.Random('journal')
    path = tmp_path / 'run.journal.mcap'
    results = []
    for _ in range(24):
        outside, inside = ([list(one) for one in part] for part in journal)
        for _ in range(chance.choice((1, 1, 2, 3))):
            records = chance.choice((outside, inside, inside))
            index = chance.randrange(len(records))
            payload = records[index][1]
            what = chance.random()
            if what < 0.2:
                records[index][0] = chance.choice(mcap.OPCODES)
            elif what < 0.3:
                records[index][1] = chance.choice((b'', b'\xff', chance.randbytes(50), payload[:-3]))
            elif what < 0.4:
                records.insert(index, list(chance.choice(records)))
            else:
                place = chance.randrange(len(payload) - 1)
                value = chance.choice((b'\0', b'\xff', b'\xed\xa0\x80', chance.randbytes(2)))
                records[index][1] = payload[:place] + value + payload[place + len(value) :]
        path.write_bytes(joined(outside, inside))
        readable, recovered = check(path, tmp_path)
        assert not readable
        results.append(recovered)
    assert set(results) == {True, False}


@pytest.mark.parametrize('opcode', [mcap.SCHEMA, mcap.CHANNEL, mcap.MESSAGE])
def test_an_invalid_record_with_a_right_checksum_is_reported(journal, tmp_path, opcode):
    outside, inside = journal
    path = tmp_path / 'run.journal.mcap'
    for number, payload in enumerate([b'', b'\xff', b'\1\0', 40 * b'\xff']):
        path.write_bytes(joined(outside, [*inside[:8], [opcode, payload], *inside[8:]]))
        report = recover(path, tmp_path / f'{number}')
        assert any(
            'of a chunk are not complete records' in one or 'no known' in one for one in report.lost
        )
        assert report.summary.messages >= 4
