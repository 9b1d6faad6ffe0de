"""Bags and journals with invalid values anywhere: reading them ends in a typed error, or in a run."""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
import zlib
from contextlib import suppress

import pytest
from rclpy.serialization import serialize_message
from ruamel.yaml import YAML
from support.bags import SECOND, changed, odom, write_bag
from support.raw_bags import LATCHED
from support.ros_messages import goal, joint_command, twist

from diffdrive_jacobian.bags import NotABagError, NothingToSaveError, mcap, recover
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.run_reader import BagError, read_run
from diffdrive_jacobian.bags.time_series import commanded, limits, measured
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.plots.run_figure import LABELS

TYPED = (BagError, NotABagError, NothingToSaveError, ParameterError)
VALUES = (
    *(None, True, 0, -1, 1, 7, 2**31, 2**63 - 1, 2**63, -(2**63), 10**30, 0.5, -0.0, 1e308),
    *(float('nan'), float('inf'), '', 'x', '/odom', '3', '\0', '\x1b[2J', 'a/b/c/d', '../..', 'é' * 300),
    *('nav_msgs/msg/Odometry', 'this/msg/X', 'a.b/msg/C', '{', '[', '- &a [*a]', '{"a": NaN}'),
    *([], {}, [None], [[]], ['x'], {'x': None}, {'nanoseconds': 'x'}, [{'topic_metadata': {}}]),
)
PARAMETERS = {'/virtual_robot': {'wheel_radius': 0.03}, '/go_to_goal': {'xy_goal_tolerance': 0.1}}


def sent():
    for index in range(4):
        at = 1.0 + index / 10
        yield at, '/odom', odom(index / 20, 0, 0, 0.5, seconds=at)
        yield at, '/cmd_vel', twist(0.5, 0.0)
        yield at, '/joint_states', joint_command(1.0, 1.0, round(at * SECOND))
    yield 1.2, '/goal_pose', goal(0.3, 0.1)
    yield 1.3, '/parameter_events', changed('/virtual_robot', 'wheel_radius', 0.04)


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch):
    # Hundreds of small bags need not survive a power cut.
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    return {
        storage: write_bag(
            folder / storage,
            sorted(sent(), key=lambda one: one[0]),
            storage=storage,
            parameters=PARAMETERS,
        )
        for storage in ('mcap', 'sqlite3')
    }


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


def check(bag, tmp_path, number):
    """Check that a bag is readable, or that recovery writes a readable one or raises a typed error."""
    readable = attempt(read_and_use, bag)
    new = tmp_path / f'new{number}'
    if attempt(recover, bag, new):
        read_run(new)
        # The new bag is complete, unless the definition of a type cannot be parsed.
        with suppress(NothingToSaveError):
            assert recover(new, tmp_path / 'again').topics_left_out
            shutil.rmtree(tmp_path / 'again')
        shutil.rmtree(new)
    return readable


def places(content, keys=()):
    """Return the path of keys to every value."""
    found = [keys] if keys else []
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        inner = (*keys, key)
        found += places(value, inner) if isinstance(value, (dict, list)) else [inner]
    return found


def mutate(content, chance):
    """Replace, remove or add some values of nested maps and lists."""
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        found = places(content)
        if not found:
            return
        *keys, last = chance.choice(found)
        inner = content
        for key in keys:
            inner = inner[key]
        if chance.random() < 0.15:
            del inner[last]
        elif chance.random() < 0.1 and isinstance(inner, dict):
            inner[chance.choice(('x', 3, None, ''))] = chance.choice(VALUES)
        else:
            inner[last] = chance.choice(VALUES)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_mutated_metadata(bags, tmp_path, storage):
    chance = random.Random(f'metadata {storage}')
    yaml = YAML(typ='safe')
    text = (bags[storage] / 'metadata.yaml').read_text()
    bag = shutil.copytree(bags[storage], tmp_path / 'bag')
    results = []
    for number in range(8):
        content = yaml.load(text)
        mutate(content, chance)
        with open(bag / 'metadata.yaml', 'w') as file:
            yaml.dump(content, file)
        results.append(check(bag, tmp_path, number))
    assert {True, False} <= set(results)


def test_mutated_cells_of_sqlite(bags, tmp_path):
    chance = random.Random('cells')
    cells = [one for one in VALUES if not isinstance(one, (list, dict)) and one not in (2**63, 10**30)]
    cells += [b'', b'\0', b'\0\1\0\0', b'\xff' * 40, chance.randbytes(400)]
    results = []
    for number in range(12):
        bag = shutil.copytree(bags['sqlite3'], tmp_path / f'bag{number}')
        database = sqlite3.connect(bag / 'sqlite3.db3')
        # Types as declared would be forced upon the values: rows of a table without them are not.
        for table in ('topics', 'messages', 'message_definitions', 'schema', 'metadata'):
            columns = [row[1] for row in database.execute(f'PRAGMA table_info({table})')]
            database.execute(f'CREATE TABLE other ({", ".join(columns)})')
            database.execute(f'INSERT INTO other SELECT * FROM {table}')
            database.execute(f'DROP TABLE {table}')
            database.execute(f'ALTER TABLE other RENAME TO {table}')
        for _ in range(chance.choice((1, 1, 2, 5))):
            table = chance.choice(
                ('topics', 'topics', 'messages', 'messages', 'message_definitions', 'schema')
            )
            column = chance.choice([row[1] for row in database.execute(f'PRAGMA table_info({table})')])
            (row,) = chance.choice(database.execute(f'SELECT rowid FROM {table}').fetchall())
            database.execute(
                f'UPDATE {table} SET {column} = ? WHERE rowid = ?', (chance.choice(cells), row)
            )
        database.commit()
        database.close()
        results.append(check(bag, tmp_path, number))
        if number % 4 == 0:
            (bag / 'metadata.yaml').unlink()
            assert not check(bag, tmp_path, number)
            check(bag / 'sqlite3.db3', tmp_path, number)
        shutil.rmtree(bag)
    assert {True, False} <= set(results)


# --- Journals

CHUNK_HEAD = 40
"""Length of the fields of a chunk before its records."""


def channel(number, topic, name):
    known = definition(name)
    return Channel(
        id=number,
        topic=topic,
        type_name=name,
        definition=known.text,
        type_hash=known.type_hash,
        qos=(LATCHED,),
    )


def write_journal(path, records):
    writer = JournalWriter(path)
    for record in records:
        writer.add(record)
    writer.flush()
    writer.close()


def journal_records(path):
    """Return the records of a journal, without their heads: those outside of its chunk, those in it."""
    records = [
        Text('storage', 'mcap'),
        Text('parameters of /go_to_goal', json.dumps({'kp': 3.0})),
        channel(0, '/odom', 'nav_msgs/msg/Odometry'),
        channel(1, '/cmd_vel', 'geometry_msgs/msg/Twist'),
    ]
    for index in range(3):
        stamp = (1 + index) * SECOND
        records.append(Message(0, stamp, serialize_message(odom(index, 0, 0, seconds=1 + index))))
        records.append(Message(1, stamp, serialize_message(twist(0.5, 0.0))))
    write_journal(path, records)
    *outside, (_, chunk) = records_of(path.read_bytes()[len(mcap.MAGIC) :])
    return outside, records_of(chunk[CHUNK_HEAD:])


def records_of(data):
    found = []
    while data:
        opcode, length = mcap.HEAD.unpack_from(data)
        end = mcap.HEAD.size + length
        found.append([opcode, data[mcap.HEAD.size : end]])
        data = data[end:]
    return found


def joined(outside, inside):
    """Return a file in which all checksums are right."""
    data = b''.join(mcap.record(*one) for one in inside)
    size, crc = mcap.number(len(data), 8), mcap.number(zlib.crc32(data), 4)
    chunk = (bytes(16), size, crc, mcap.text(''), size, data)
    whole = [mcap.MAGIC]
    for opcode, payload in outside:
        right = mcap.number(zlib.crc32(payload[:-4]), 4)
        payload = payload[:-4] + right if opcode == mcap.ATTACHMENT else payload
        whole.append(mcap.record(opcode, payload))
    return b''.join([*whole, mcap.record(mcap.CHUNK, *chunk)])


def test_mutated_records_of_journals(tmp_path):
    chance = random.Random('journal')
    good = journal_records(tmp_path / 'good.journal.mcap')
    path = tmp_path / 'run.journal.mcap'
    results = []
    for number in range(30):
        outside, inside = ([list(one) for one in part] for part in good)
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
        assert not check(path, tmp_path, number)
        results.append(attempt(recover, path, tmp_path / f'recovered{number}'))
    assert {True, False} <= set(results)


@pytest.mark.parametrize('opcode', [mcap.SCHEMA, mcap.CHANNEL, mcap.MESSAGE])
@pytest.mark.parametrize('payload', [b'', b'\xff', b'\1\0', 40 * b'\xff'])
def test_an_invalid_record_with_a_right_checksum_is_reported(tmp_path, opcode, payload):
    outside, inside = journal_records(tmp_path / 'good.journal.mcap')
    path = tmp_path / 'run.journal.mcap'
    path.write_bytes(joined(outside, [*inside[:8], [opcode, payload], *inside[8:]]))
    report = recover(path)
    assert any('of a chunk are not complete records' in one or 'no known' in one for one in report.lost)
    assert report.summary.messages >= 4


def test_mutated_messages(tmp_path):
    """Damaged messages are either used or counted."""
    chance = random.Random('messages')
    for number in range(4):
        damaged = []
        for at, topic, message in sent():
            data = bytearray(serialize_message(message))
            for _ in range(chance.choice((0, 1, 3))):
                data[chance.randrange(4, len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            damaged.append((topic, round(at * SECOND), bytes(data[: chance.choice((len(data), 12))])))
        bag = write_raw(tmp_path / f'bag{number}', damaged)
        run = read_run(bag)
        assert sum(run.skipped.values()) > 0
        attempt(read_and_use, bag)
        shutil.rmtree(bag)


def write_raw(path, messages):
    names = {topic: type(message) for _, topic, message in sent()}
    journal = path.with_name(f'{path.name}.journal.mcap')
    channels = {
        topic: channel(number, topic, f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}')
        for number, (topic, kind) in enumerate(names.items())
    }
    data = [Message(channels[topic].id, stamp, data) for topic, stamp, data in messages]
    write_journal(journal, [*channels.values(), *data])
    recover(journal, path)
    return path
