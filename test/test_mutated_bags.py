"""Bags and journals with invalid values anywhere: reading them ends in a typed error, or in a run."""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
import struct
import zlib
from contextlib import suppress

import pytest
from rclpy.serialization import serialize_message
from ros_messages import goal, joint_command, twist
from ruamel.yaml import YAML
from test_reading import SECOND, changed, odom, write_bag

from diffdrive_jacobian.bags import NotABagError, NothingToSaveError, recover
from diffdrive_jacobian.bags.journal import MAGIC, JournalError, read_journal
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.run_reader import BagError, read_run
from diffdrive_jacobian.bags.time_series import commanded, limits, measured
from diffdrive_jacobian.bags.timeline import trace
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.plots.run_figure import LABELS

TYPED = (BagError, JournalError, NotABagError, NothingToSaveError, ParameterError)
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
    one = trace(run)
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


def frame(kind, payload):
    return struct.pack('<cII', kind, len(payload), zlib.crc32(payload, ord(kind))) + payload


def channel(number, topic, name):
    known = definition(name)
    return {
        **{'id': number, 'topic': topic, 'type_name': name},
        **{'definition': known.text, 'type_hash': known.type_hash},
        'qos': [
            {
                **{'history': 1, 'depth': 10, 'reliability': 1, 'durability': 2, 'deadline': 0},
                **{'lifespan': 0, 'liveliness': 1, 'liveliness_lease_duration': 0},
            }
        ],
    }


def journal_records():
    """Return the records of a journal: kind, and content (JSON) or channel, time and data."""
    yield b'T', {'key': 'storage', 'value': 'mcap'}
    yield b'T', {'key': 'parameters of /go_to_goal', 'value': json.dumps({'kp': 3.0})}
    yield b'C', channel(0, '/odom', 'nav_msgs/msg/Odometry')
    yield b'C', channel(1, '/cmd_vel', 'geometry_msgs/msg/Twist')
    for index in range(3):
        stamp = (1 + index) * SECOND
        yield b'M', [0, stamp, serialize_message(odom(index, 0, 0, seconds=1 + index))]
        yield b'M', [1, stamp, serialize_message(twist(0.5, 0.0))]


COUNT = len(list(journal_records()))


def packed(kind, content):
    if kind != b'M':
        return json.dumps(content).encode()
    number, stamp, data = content
    return struct.pack('<Hq', number, stamp) + data


def test_mutated_records_of_journals(tmp_path):
    chance = random.Random('journal')
    path = tmp_path / 'run.journal'
    results = []
    for number in range(14):
        records = [[kind, packed(kind, content)] for kind, content in journal_records()]
        for _ in range(chance.choice((1, 1, 2, 3))):
            index = chance.randrange(len(records))
            kind, content = list(journal_records())[index % COUNT]
            what = chance.random()
            if what < 0.1:
                records[index][0] = chance.choice((b'C', b'T', b'M'))
            elif what < 0.2:
                records[index][1] = chance.choice(
                    (b'', b'{', b'[' * 5000, b'null', b'3', b'"\\ud800"', b'\xff', chance.randbytes(50))
                )
            elif what < 0.3:
                records.insert(index, list(chance.choice(records)))
            elif kind == b'M':
                content[0] = chance.choice((0, 1, 2, 65535))
                content[1] = chance.choice((0, -1, 2**63 - 1, -(2**63), content[1]))
                content[2] = chance.choice((b'', b'\0', b'\0\1\0\0', chance.randbytes(300), content[2]))
                records[index] = [kind, packed(kind, content)]
            else:
                whole = [content]
                mutate(whole, chance)
                if chance.random() < 0.2 and isinstance(content, dict):
                    content[chance.choice(list(content) or ['x'])] = '\ud800'
                records[index] = [kind, json.dumps(whole[0] if whole else None).encode()]
        path.write_bytes(MAGIC + b''.join(frame(*one) for one in records))
        results.append(attempt(lambda: list(read_journal(path))))
        check(path, tmp_path, number)
    assert {True, False} <= set(results)


@pytest.mark.parametrize('kind', [b'C', b'T'])
@pytest.mark.parametrize(
    'payload', [b'', b'{', b'null', b'[1]', b'{}', b'{"key": 3, "value": "x"}', b'[' * 5000, b'\xff']
)
def test_an_invalid_record_with_a_right_checksum_is_left_out(tmp_path, kind, payload):
    good = [frame(one, packed(one, content)) for one, content in journal_records()]
    path = tmp_path / 'run.journal'
    path.write_bytes(MAGIC + b''.join([*good[:6], frame(kind, payload), *good[6:]]))
    with pytest.raises(JournalError, match=r'run\.journal is damaged at byte \d+: '):
        list(read_journal(path))
    report = recover(path)
    assert report.lost[0].startswith('run.journal: 1 records are invalid, the first: the record at byte')
    assert report.summary.topics == {'/odom': 3, '/cmd_vel': 3}


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
    journal = path.with_name(f'{path.name}.journal')
    with open(journal, 'wb') as file:
        file.write(MAGIC)
        for number, (topic, kind) in enumerate(names.items()):
            name = f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
            file.write(frame(b'C', json.dumps(channel(number, topic, name)).encode()))
        for topic, stamp, data in messages:
            file.write(frame(b'M', packed(b'M', [list(names).index(topic), stamp, data])))
    recover(journal, path)
    return path
