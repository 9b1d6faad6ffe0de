"""Random damage of bags and journals, of their bytes and of their values, and what is said of it.

The oracle, whatever the damage: in bounded memory, reading and recovery end with a typed error or with
a run that can be used. The old files stay as they are. What was written before the damage is recovered,
in its order. Nothing is called complete that lacks a message. What recovery writes is complete.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing, suppress

import pytest
from mcap.opcode import Opcode
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import CompressionMode
from ruamel.yaml import YAML
from support.bags import SECOND, changed, odom
from support.bags import write_bag as write_sent
from support.raw_bags import (
    LATCHED,
    PLUGINS,
    channel,
    contents,
    data_file,
    make_messages,
    mcap_records,
    names_of,
    read_bag,
    write_bag,
    write_journal,
    write_records,
)
from support.ros_messages import goal, joint_command, twist

from diffdrive_jacobian.bags import BagError, NotABagError, NothingToSaveError, read_run, recover
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.files import MCAP_MAGIC
from diffdrive_jacobian.bags.journal import Message, Text
from diffdrive_jacobian.bags.recovery import Recovery, UncheckedError
from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.plots.run_lines import commanded, limits, measured
from diffdrive_jacobian.plots.run_panels import LABELS

pytestmark = pytest.mark.usefixtures('quick_disk', 'bounded_memory')

TYPED = (BagError, NotABagError, NothingToSaveError, ParameterError)

# --- The oracle


def attempt(function, *arguments):
    """Return what a call returns, or its typed error. Other errors are failures."""
    try:
        return function(*arguments)
    except TYPED as error:
        return error


def trace(run):
    """Trace a run as the tools do."""
    one = timeline(run)
    limits(one)
    for quantity in LABELS:
        measured(one, quantity)
        commanded(one, quantity)


def check(given, new):
    """Read, use and recover what is damaged; return the run and the recovery, or errors instead."""
    run = attempt(read_run, given)
    if isinstance(run, Run):
        attempt(verify, run)
        attempt(trace, run)
    folder = given if given.is_dir() else given.parent
    before = contents(folder)
    recovery = attempt(recover, given, new)
    assert contents(folder) == before
    if isinstance(recovery, Recovery):
        assert len(read_bag(new)) == recovery.summary.messages
    return run, recovery


def check_values(given, new):
    """Check also the new bag: it can be read, and is complete unless a definition cannot be parsed."""
    run, recovery = check(given, new)
    if isinstance(recovery, Recovery):
        read_run(new)
        with suppress(NothingToSaveError):
            assert recover(new, new.with_name(f'{new.name} again')).topics_left_out
    return run, recovery


def is_subset(some, messages):
    """Return whether some of the messages are only such, and in their order."""
    rest = iter(messages)
    return all(one in rest for one in some)


# --- Bytes

PAGE = 4096
"""Size of a page of SQLite (bytes)."""
CASES = 1
"""For each kind of file and of damage."""
SMALL, LARGE = make_messages(40, 400), make_messages(8, 20_000)
"""The large ones are in several pages of SQLite each."""
KINDS = {
    'mcap': ('mcap', CompressionMode.NONE, SMALL),
    'mcap, compressed chunks': ('mcap', CompressionMode.STORAGE, LARGE),
    'mcap, compressed messages': ('mcap', CompressionMode.MESSAGE, SMALL),
    'mcap with checksums': ('ours', None, SMALL),
    'journal': ('journal', None, SMALL),
    'sqlite3': ('sqlite3', CompressionMode.NONE, SMALL),
    'sqlite3, large messages': ('sqlite3', CompressionMode.NONE, LARGE),
    'sqlite3, compressed messages': ('sqlite3', CompressionMode.MESSAGE, LARGE),
}


@pytest.fixture(params=KINDS)
def whole(request, tmp_path):
    """Kind and path of a bag or journal, its messages, and whether their bytes are in the file."""
    storage, mode, messages = KINDS[request.param]
    path = tmp_path / 'whole' / 'run'
    path.parent.mkdir()
    if storage in ('mcap', 'sqlite3'):
        write_bag(path, storage, messages, mode)
    else:
        journal = write_journal(path, messages)
        path = journal if storage == 'journal' else recover(journal).bag
    return request.param, path, messages, mode in (None, CompressionMode.NONE)


def cut(data, at, chance):
    del data[at:]


def erase(data, at, chance):
    end = min(len(data), at + chance.choice((1, 30, 2048, PAGE)))
    data[at:end] = bytes(end - at)


def flip_bits(data, at, chance):
    for place in (at, *chance.sample(range(len(data)), chance.randrange(3))):
        data[place] ^= 1 << chance.randrange(8)


def overwrite(data, at, chance):
    # The first bytes describe the others.
    for place in (at, *chance.sample(range(len(data) // 4), chance.randrange(20))):
        data[place] = chance.randrange(256)


def write_length(data, at, chance):
    size, order = chance.choice((4, 8)), chance.choice(('little', 'big'))
    length = (1 << chance.choice((16, 8 * size - 1, 8 * size))) - chance.randrange(1, 3)
    data[at : at + size] = length.to_bytes(size, order)


def duplicate(data, at, chance):
    data[at:at] = data[at : at + chance.choice((100, PAGE))]


def reorder(data, at, chance):
    size = chance.choice((100, PAGE))
    one, other = (slice(place, place + size) for place in (at, chance.randrange(len(data))))
    data[one], data[other] = data[other], data[one]


DAMAGE = (cut, erase, flip_bits, overwrite, write_length, duplicate, reorder)


def left_by(data, file, messages):
    """Return messages that the damage of a file leaves; `data` was in it before."""
    if not data.startswith(MCAP_MAGIC):
        return [one for one in read_by_sqlite(file) if one in messages]
    damaged = file.read_bytes()
    pairs = enumerate(zip(data, damaged, strict=False))
    first = next((at for at, (one, other) in pairs if one != other), min(len(data), len(damaged)))
    return [one for one in messages if data.index(one[2]) + len(one[2]) <= first]


def read_by_sqlite(file):
    """Return topic, time and bytes of the messages that the library sqlite3 reads up to an error."""
    found = []
    with closing(sqlite3.connect(f'file:{file}?mode=ro', uri=True)) as database, suppress(sqlite3.Error):
        topics = dict(database.execute('SELECT id, name FROM topics'))
        for topic, stamp, content in database.execute('SELECT topic_id, timestamp, data FROM messages'):
            found.append((topics.get(topic), stamp, content))
    return found


def test_damaged_bytes(whole, tmp_path):
    kind, path, messages, plain = whole
    for number, how in enumerate(DAMAGE * CASES):
        chance = random.Random(f'{kind} {number}')
        folder = tmp_path / str(number)
        folder.mkdir()
        old = (shutil.copytree if path.is_dir() else shutil.copyfile)(path, folder / path.name)
        file = data_file(old) if old.is_dir() else old
        data = file.read_bytes()
        damaged = bytearray(data)
        how(damaged, chance.choice((0, 8, len(data) - 1, *chance.sample(range(len(data)), 5))), chance)
        file.write_bytes(damaged)
        if old.is_dir() and chance.random() < 0.5:
            (old / 'metadata.yaml').unlink()
        given = file if chance.random() < 0.3 else old
        run, recovery = check(given, folder / 'new')
        saved = isinstance(recovery, Recovery)
        found = read_bag(folder / 'new') if saved else []
        complete = 'is complete' in str(recovery)
        if how is cut:
            assert isinstance(run, BagError)
            assert is_subset(found, messages)
        if plain and not complete and not isinstance(recovery, UncheckedError):
            assert is_subset(left_by(data, file, messages), found)
        if complete:
            assert read_bag(given) == messages
        elif saved and not recovery.lost and not recovery.unchecked:
            assert found == messages


def test_undamaged_files_without_metadata(whole, tmp_path):
    _, path, messages, _ = whole
    given = tmp_path / path.name
    if path.is_dir():
        given.mkdir()
    shutil.copy(data_file(path) if path.is_dir() else path, given)
    recovery = recover(given, tmp_path / 'new')
    assert read_bag(tmp_path / 'new') == messages
    assert recovery.lost == ()
    assert recovery.unchecked
    if path.is_dir():
        assert any('there is no valid metadata.yaml' in one for one in recovery.unchecked)
        assert names_of(tmp_path / 'new') == names_of(path)


# --- Values

VALUES = (
    *(None, True, 0, -1, 1, 7, 2**31, 2**63 - 1, 2**63, -(2**63), 10**30, 0.5, -0.0, 1e308),
    *(float('nan'), float('inf'), '', 'x', '/odom', '3', '\0', '\x1b[2J', 'a/b/c/d', '../..', 'é' * 300),
    *('nav_msgs/msg/Odometry', 'this/msg/X', 'a.b/msg/C', '{', '[', '- &a [*a]', '{"a": NaN}'),
    *([], {}, [None], [[]], ['x'], {'x': None}, {'nanoseconds': 'x'}, [{'topic_metadata': {}}]),
)
PARAMETERS = {'/virtual_robot': {'wheel_radius': 0.03}, '/go_to_goal': {'xy_goal_tolerance': 0.1}}


def sent():
    """Yield what is in the bags whose values are damaged."""
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
        storage: write_sent(folder / storage, messages, storage=storage, parameters=PARAMETERS)
        for storage in PLUGINS
    }


def mutate(content, chance):
    """Replace or remove a value of nested maps and lists."""
    while True:
        key = chance.choice([*(content if isinstance(content, dict) else range(len(content)))])
        inner = content[key]
        if not isinstance(inner, (dict, list)) or not inner or chance.random() < 0.2:
            break
        content = inner
    if chance.random() < 0.15:
        del content[key]
    else:
        content[key] = chance.choice(VALUES)


def test_values_of_metadata(bags, tmp_path):
    chance, yaml, results = random.Random('metadata'), YAML(typ='safe'), set()
    for number in range(5):
        bag = shutil.copytree(bags[list(PLUGINS)[number % 2]], tmp_path / f'{number}' / 'bag')
        content = yaml.load((bag / 'metadata.yaml').read_text())
        mutate(content, chance)
        with open(bag / 'metadata.yaml', 'w') as file:
            yaml.dump(content, file)
        results.add(type(check_values(bag, bag.with_name('new'))[0]) is Run)
    assert results == {True, False}


TABLES = ('topics', 'topics', 'messages', 'messages', 'message_definitions', 'schema', 'metadata')


def test_cells_of_sqlite(bags, tmp_path):
    chance, results = random.Random('cells'), set()
    cells = [one for one in VALUES if not isinstance(one, (list, dict)) and one not in (2**63, 10**30)]
    cells += [b'', b'\0', b'\0\1\0\0', b'\xff' * 40, chance.randbytes(400)]
    for number in range(5):
        bag = shutil.copytree(bags['sqlite3'], tmp_path / f'{number}' / 'bag')
        with closing(sqlite3.connect(data_file(bag))) as database, database:
            for _ in range(chance.choice((2, 3, 5))):
                table = chance.choice(TABLES)
                column = chance.choice(database.execute(f'PRAGMA table_info({table})').fetchall())[1]
                (row,) = chance.choice(database.execute(f'SELECT rowid FROM {table}').fetchall())
                change = f'UPDATE {table} SET {column} = ? WHERE rowid = ?'
                # Some are refused for the type of the column.
                with suppress(sqlite3.IntegrityError):
                    database.execute(change, (chance.choice(cells), row))
        if number % 4 == 0:
            check_values(data_file(bag), bag.with_name('of the file'))
        results.add(type(check_values(bag, bag.with_name('new'))[0]) is Run)
    assert results == {True, False}


def test_bytes_of_messages(tmp_path):
    """Damaged messages are either used or counted."""
    chance = random.Random('messages')
    channels, records = {}, []
    for _ in range(3):
        for at, topic, message in sent():
            data = bytearray(serialize_message(message))
            for _ in range(chance.choice((0, 1, 3))):
                data[chance.randrange(4, len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            name = f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'
            known = channels.setdefault(topic, channel(len(channels), topic, name, (LATCHED,)))
            cut_at = chance.choice((len(data), 12))
            records.append(Message(known.id, round(at * SECOND), bytes(data[:cut_at])))
    build_bag(channels.values(), records, tmp_path / 'bag')
    run, _ = check_values(tmp_path / 'bag', tmp_path / 'new')
    assert sum(run.skipped.values()) > 0


def test_records_of_journals_with_right_checksums(tmp_path):
    written = [
        Text('storage', 'mcap'),
        Text('parameters of /go_to_goal', '{"kp": 3.0}'),
        channel(0, '/odom', 'nav_msgs/msg/Odometry', (LATCHED,)),
        channel(1, '/cmd_vel', 'geometry_msgs/msg/Twist', (LATCHED,)),
    ]
    for second in (1, 2, 3):
        pose = serialize_message(odom(second, 0, 0, seconds=second))
        written.append(Message(0, second * SECOND, pose))
        written.append(Message(1, second * SECOND, serialize_message(twist(0.5, 0.0))))
    whole = write_records(tmp_path / 'good', *written).read_bytes()
    *outside, (_, chunk, end) = mcap_records(whole)
    # After opcode, length, times, size, checksum, compression and size of a chunk.
    inside = chunk + 49
    chance, results = random.Random('journal'), set()
    for number in range(10):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 2, 3))):
            _, at, to = chance.choice([*outside, *mcap_records(whole, inside) * 2])
            place = chance.choice((at, chance.randrange(at + 9, to)))
            value = chance.choice((b'\0', b'\xff', b'\xed\xa0\x80', chance.randbytes(2)))
            data[place : place + len(value)] = value
        for opcode, at, to in outside:
            if opcode == Opcode.ATTACHMENT:
                data[to - 4 : to] = struct.pack('<I', zlib.crc32(data[at + 9 : to - 4]))
        data[chunk + 33 : chunk + 37] = struct.pack('<I', zlib.crc32(data[inside:end]))
        path = tmp_path / f'{number}' / 'run.journal.mcap'
        path.parent.mkdir()
        path.write_bytes(data)
        run, recovery = check_values(path, path.with_name('new'))
        assert isinstance(run, BagError)
        results.add(isinstance(recovery, Recovery))
    assert results == {True, False}
