"""Files that ask for far more than their size justifies: an error, in bounded memory."""

from __future__ import annotations

import resource
import sqlite3
import textwrap
from functools import partial
from urllib.parse import quote

import pytest
from hostile_bags import (
    CYCLE,
    GIB,
    HOSTILE_SCHEMAS,
    MIB,
    chunk,
    chunk_bomb,
    laughs,
    lz4_zeros,
    mcap,
    merging_laughs,
    message,
    topic_records,
    write_folder,
    write_loop,
    write_sqlite,
    zstd_zeros,
)
from rosbags.rosbag2 import CompressionMode
from ruamel.yaml import YAML
from support.raw_bags import make_messages, read_bag, recover, write_bag

from diffdrive_jacobian import bounded_yaml
from diffdrive_jacobian.bags import limits
from diffdrive_jacobian.bags.bag_reader import find_damage
from diffdrive_jacobian.bags.bounded_reader import BoundedReader, _SqliteReader
from diffdrive_jacobian.bags.damaged_bag import _unpacked
from diffdrive_jacobian.bags.limits import MAX_RECORD
from diffdrive_jacobian.bags.run_reader import BagError, open_bag, read_run
from diffdrive_jacobian.bags.salvage_sqlite import _Pages
from diffdrive_jacobian.bounded_yaml import MAX_DEPTH, MAX_SIZE, TooLargeError, load_yaml
from diffdrive_jacobian.parameters.file import robot_parameters
from diffdrive_jacobian.ros.runner import UserError

GOOD = mcap(topic_records() + message(b'\0\1\0\0' + bytes(100)))
HEADROOM = 700 * MIB


@pytest.fixture(autouse=True)
def bounded_memory():
    """Let this process take a few hundred megabytes more, and no more."""
    with open('/proc/self/statm') as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + HEADROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def refused(path, match):
    with pytest.raises(BagError, match=match):
        read_run(path)


# --- Compression


BOMBS = {
    'lz4': ('lz4', lz4_zeros(GIB), GIB),
    'zstd': ('zstd', zstd_zeros(12 * GIB), 12 * GIB),
    'zstd, size not told': ('zstd', zstd_zeros(12 * GIB, declared=False), 12 * GIB),
}


@pytest.mark.parametrize('indexed', [True, False])
@pytest.mark.parametrize('bomb', BOMBS)
def test_a_chunk_that_unpacks_to_gigabytes(tmp_path, capsys, bomb, indexed):
    path = tmp_path / 'x.mcap'
    path.write_bytes(chunk_bomb(*BOMBS[bomb], indexed=indexed))
    refused(path, r'a chunk unpacks to .* GB; at most 134.2 MB are read')
    code, out, err = recover(capsys, path)
    assert (code, out) == (1, '')
    assert 'GB; at most 134.2 MB are read' in err


@pytest.mark.parametrize('indexed', [True, False])
@pytest.mark.parametrize('bomb', BOMBS)
def test_a_chunk_that_claims_to_be_small(tmp_path, capsys, bomb, indexed):
    compression, packed, _ = BOMBS[bomb]
    path = tmp_path / 'x.mcap'
    path.write_bytes(chunk_bomb(compression, packed, 1000, indexed=indexed))
    refused(path, 'Chunk size mismatch: expected 1000 bytes, got 1001')
    assert recover(capsys, path)[0] == 1


@pytest.mark.parametrize('indexed', [True, False])
def test_many_chunks_that_unpack_to_gigabytes_together(tmp_path, capsys, indexed):
    path = tmp_path / 'x.mcap'
    size = 100 * MIB
    path.write_bytes(chunk_bomb('zstd', zstd_zeros(size), size, indexed=indexed, times=100))
    refused(path, r'it unpacks to more than 3\d\d\.\d MB, the most that is read')
    code, _, err = recover(capsys, path)
    assert code == 1
    assert 'it unpacks to more than 3' in err


def test_chunks_that_overlap_in_time_are_not_unpacked_at_once(tmp_path, monkeypatch):
    path = tmp_path / 'x.mcap'
    # A larger file may unpack to that.
    monkeypatch.setattr(limits, 'FREE', GIB)
    size = 100 * MIB
    path.write_bytes(chunk_bomb('zstd', zstd_zeros(size), size, indexed=True, times=9, end=2))
    refused(path, 'its chunks overlap in time and unpack to more than 536.9 MB at once')


@pytest.mark.parametrize('name', ['x.mcap.zstd', 'x.db3.zstd'])
@pytest.mark.parametrize('declared', [True, False])
def test_a_compressed_file_of_zeros(tmp_path, capsys, monkeypatch, name, declared):
    monkeypatch.setattr(limits, 'FREE', 64 * MIB)
    path = write_folder(
        tmp_path / 'run',
        name,
        zstd_zeros(12 * GIB, declared=declared),
        mode='FILE',
        storage='mcap' if 'mcap' in name else 'sqlite3',
    )
    refused(path, rf'{name}.* unpacks to .* MB')
    code, out, err = recover(capsys, path)
    assert (code, out) == (2, '')
    assert f'{name}' in err
    assert 'unpacks to' in err


@pytest.mark.parametrize('statistics', [3, None])
def test_chunks_without_an_index_of_their_messages_are_read(tmp_path, statistics):
    found = message(b'\0\1\0\0' + bytes(100)) * 3
    one = chunk('', found, len(found))
    entry = (len(topic_records()), len(one), '', len(found), len(found))
    path = tmp_path / 'x.mcap'
    path.write_bytes(mcap(topic_records() + one, (entry,), message_index=False, statistics=statistics))
    with open_bag(path) as reader:
        assert reader.message_count == 3
        assert len(list(reader.messages(reader.connections))) == 3
    assert find_damage(path) == ''


def test_compressed_files_have_one_budget_for_all(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, 'FREE', 40 * MIB)
    names = [f'{index}.mcap.zstd' for index in range(3)]
    path = write_folder(tmp_path / 'run', ', '.join(names), mode='FILE')
    for name in names:
        (path / name).write_bytes(zstd_zeros(16 * MIB))
    refused(path, r'2\.mcap\.zstd: it unpacks to more than 41\.9 MB')


def test_a_file_that_is_listed_twice_is_not_unpacked(tmp_path):
    path = write_folder(tmp_path / 'run', 'x.mcap.zstd, x.mcap.zstd', mode='FILE')
    (path / 'x.mcap.zstd').write_bytes(zstd_zeros(MIB))
    refused(path, r"relative_file_paths\[1\] must be a file that is not listed before, got 'x.mcap")


@pytest.mark.parametrize('declared', [True, False])
def test_a_message_that_unpacks_to_gigabytes(tmp_path, capsys, declared):
    bomb = message(zstd_zeros(6 * GIB, declared=declared))
    path = write_folder(tmp_path / 'run', 'x.mcap', mcap(topic_records() + bomb), mode='MESSAGE')
    refused(path, r'a message unpacks to .*134\.2 MB')
    code, _, err = recover(capsys, path)
    assert code == 1
    assert '1 messages are not CDR, are too large' in err


@pytest.mark.parametrize('mode', CompressionMode)
def test_compressed_bags_are_read(tmp_path, mode):
    messages = make_messages(60, 20_000)
    write_bag(tmp_path / 'run', 'mcap', messages, mode)
    with BoundedReader(tmp_path / 'run') as reader:
        found = [(one.topic, stamp, bytes(data)) for one, stamp, data in reader.messages()]
    assert found == messages


def test_highly_compressible_messages_are_read(tmp_path):
    """Black images: far less than a thousandth of their size on the disk."""
    size = 24_000_000
    data = b'\0\1\0\0' + bytes(size)
    inner = topic_records() + message(data)
    path = tmp_path / 'x.mcap'
    packed = limits.zstd.compress(inner)
    assert len(packed) < len(inner) / 5000
    path.write_bytes(mcap(chunk('zstd', packed, len(inner))))
    with open_bag(path) as reader:
        assert [len(found) for _, _, found in reader.messages()] == [len(data)]


def test_a_record_of_a_sparse_file_is_not_read_whole(tmp_path, capsys):
    path = tmp_path / 'x.mcap'
    with open(path, 'wb') as file:
        file.write(mcap(topic_records())[:-37])
        file.write(b'\x03' + (12 * GIB).to_bytes(8, 'little'))
        file.seek(12 * GIB, 1)
        file.write(mcap(b'')[-37:])
    refused(path, 'a record unpacks to 12.9 GB|a record of 12.9 GB')
    assert recover(capsys, path)[0] == 1


# --- SQLite


@pytest.mark.parametrize('kind', HOSTILE_SCHEMAS)
def test_schemas_that_compute(tmp_path, capsys, kind):
    path = tmp_path / 'run'
    path.mkdir()
    write_sqlite(path / 'x.db3', *HOSTILE_SCHEMAS[kind])
    write_folder(path, 'x.db3', storage='sqlite3')
    refused(path, 'must be a plain table, but|malformed database schema')
    assert recover(capsys, path)[0] == 1


def test_an_overflow_page_that_follows_itself(tmp_path, capsys):
    path = tmp_path / 'run'
    path.mkdir()
    for length in (900_000_000, 10_000_000):
        (path / 'x.db3').unlink(missing_ok=True)
        write_loop(path / 'x.db3', length)
        write_folder(path, 'x.db3', storage='sqlite3')
        code, _, err = recover(capsys, path)
        assert code == 1
        assert 'holds no message that can be saved' in err
    (path / 'x.db3').unlink()
    write_loop(path / 'x.db3', 900_000_000)
    refused(path, 'too big')


def test_queries_end(tmp_path, monkeypatch):
    """Pages that refer to each other could be walked for ever."""
    write_bag(tmp_path / 'run', 'sqlite3', make_messages(3000, 10))
    monkeypatch.setattr('diffdrive_jacobian.bags.bounded_reader._STEPS', 100)
    monkeypatch.setattr('diffdrive_jacobian.bags.bounded_reader._FREE_STEPS', 1000)
    monkeypatch.setattr('diffdrive_jacobian.bags.bounded_reader._STEPS_PER_BYTE', 0)
    refused(tmp_path / 'run', 'its queries take more steps')


def test_a_log_that_names_a_page_far_away(tmp_path, monkeypatch):
    """A copy of the database with its log applied could have any number of empty pages."""
    file = write_sqlite(tmp_path / 'x.db3')
    file.with_name('x.db3-wal').write_bytes(b'log')
    connect = sqlite3.connect

    def enlarge(copy):
        with open(copy, 'r+b') as out:
            out.truncate(GIB)
        return connect(copy)

    monkeypatch.setattr(sqlite3, 'connect', enlarge)
    assert _unpacked(file, tmp_path) == file


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('name', ['run#2', 'run?x=1', 'run%41', 'a b&c', 'run%', '#'])
def test_paths_are_no_uris(tmp_path, capsys, storage, name):
    messages = make_messages(20, 300)
    path = tmp_path / name / name
    path.parent.mkdir()
    # rosbags would write the data of such a bag elsewhere.
    write_bag(tmp_path / 'run', storage, messages)
    ending = 'mcap' if storage == 'mcap' else 'db3'
    (tmp_path / 'run' / f'run.{ending}').rename(tmp_path / 'run' / f'{name}.{ending}')
    metadata = tmp_path / 'run' / 'metadata.yaml'
    metadata.write_text(
        metadata.read_text().replace(f'run.{ending}', f"'{name}.{ending}'").replace("''", "'")
    )
    (tmp_path / 'run').rename(path)
    with open_bag(path) as reader:
        found = [(one.topic, stamp, bytes(data)) for one, stamp, data in reader.messages()]
    assert found == messages
    with open_bag(path / f'{name}.{ending}') as reader:
        assert len(list(reader.messages())) == len(messages)
    (path / 'metadata.yaml').unlink()
    code, _, _ = recover(capsys, path, '-o', tmp_path / 'new')
    assert code == 0
    assert read_bag(tmp_path / 'new') == messages


def test_an_error_names_the_path_as_it_is(tmp_path):
    path = tmp_path / 'a#b%20'
    path.mkdir()
    (path / 'x.db3').write_bytes(b'SQLite format 3\0' + bytes(5000))
    write_folder(path, 'x.db3', storage='sqlite3')
    with pytest.raises(BagError) as caught:
        read_run(path)
    assert quote(str(path)) not in str(caught.value)
    assert str(path / 'x.db3') in str(caught.value)


# --- YAML

TEXTS = {'aliases': laughs(), 'merged aliases': merging_laughs(), 'a cycle': CYCLE}


@pytest.mark.parametrize('text', TEXTS)
def test_aliases_in_metadata(tmp_path, capsys, text):
    more = '  custom_data:\n' + textwrap.indent(TEXTS[text], ' ' * 4)
    path = write_folder(tmp_path / 'run', 'x.mcap', GOOD, more=more)
    match = 'stands for more than 200000 values|part of its own value'
    refused(path, match)
    code, out, _ = recover(capsys, path)
    assert code == 0
    assert 'lost: metadata.yaml: the YAML' in out


@pytest.mark.parametrize('text', TEXTS)
def test_aliases_in_a_params_file(tmp_path, text):
    path = tmp_path / 'params.yaml'
    path.write_text('virtual_robot:\n  ros__parameters:\n' + textwrap.indent(TEXTS[text], ' ' * 4))
    match = r'stands for more than 200000 values|part of its own value'
    with pytest.raises(UserError, match=match):
        robot_parameters(str(path))


def test_aliases_in_the_profiles_of_a_topic(tmp_path):
    data = mcap(topic_records(qos=merging_laughs()) + message(b'\0\1\0\0' + bytes(100)))
    (tmp_path / 'x.mcap').write_bytes(data)
    refused(tmp_path / 'x.mcap', 'stands for more than 200000 values')
    path = write_sqlite(
        tmp_path / 'x.db3',
        f"INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr', '{merging_laughs()}')",
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)',
    )
    refused(path, 'stands for more than 200000 values')


@pytest.fixture(params=[False, True], ids=['parser in C', 'parser in Python'])
def parser(request, monkeypatch):
    """Load YAML by the parser that is there if ruamel.yaml.clib is, and by the other one."""
    monkeypatch.setattr(bounded_yaml, 'YAML', partial(YAML, pure=request.param))
    bounded_yaml._check_text.cache_clear()
    bounded_yaml._pickled.cache_clear()


@pytest.mark.usefixtures('parser')
def test_a_few_aliases_are_read():
    assert load_yaml('a: &x [1, 2]\nb: *x\nc: {<<: &y {d: *x}, e: *y}\n') == {
        'a': [1, 2],
        'b': [1, 2],
        'c': {'d': [1, 2], 'e': {'d': [1, 2]}},
    }


def test_values_that_were_changed_are_not_loaded_again():
    loaded = load_yaml('a: &x [1, 2]\nb: *x\n')
    loaded['a'].append(3)
    assert loaded['b'] == [1, 2, 3]
    assert load_yaml('a: &x [1, 2]\nb: *x\n') == {'a': [1, 2], 'b': [1, 2]}


def test_metadata_is_parsed_once_to_open_a_bag_again_and_again(tmp_path, monkeypatch):
    write_bag(tmp_path / 'run', 'mcap', make_messages(5, 30))
    parsed = []

    class Counting(YAML):
        def load(self, stream):
            parsed.append(stream)
            return super().load(stream)

    monkeypatch.setattr(bounded_yaml, 'YAML', Counting)
    bounded_yaml._pickled.cache_clear()
    for _ in range(3):
        with open_bag(tmp_path / 'run'):
            pass
    assert parsed.count((tmp_path / 'run' / 'metadata.yaml').read_text()) == 1


@pytest.mark.usefixtures('parser')
@pytest.mark.parametrize(
    ('text', 'match'),
    [
        ('[' * (MAX_DEPTH + 1), 'nested more than'),
        ('- ' * 1000 + 'x', 'nested more than'),
        ('a: ' + '1' * 5000, 'number has more than'),
        ('%YAML 1.1\n---\n' + '1:' * 5000 + '1', 'number has more than'),
        ('a: !!int "' + '1:' * 5000 + '1"', 'number has more than'),
        ('#' * (MAX_SIZE + 1), 'at most 2.0 MB are read'),
    ],
)
def test_yaml_that_is_too_large(text, match):
    with pytest.raises(TooLargeError, match=match):
        load_yaml(text)


def test_a_definition_of_any_length_is_not_parsed(tmp_path, capsys):
    data = topic_records('/x', 'my_msgs/msg/Mine', definition='int32 x\n' * 30_000)
    (tmp_path / 'x.mcap').write_bytes(mcap(data + message(b'\0\1\0\0' + bytes(9))))
    code, _, err = recover(capsys, tmp_path / 'x.mcap')
    assert code == 1
    assert 'its definition has 240000 characters; at most 200000 are parsed' in err


# --- What is printed


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_terminal_escapes_of_a_bag_are_not_printed(tmp_path, capsys, storage):
    evil = '/odom\x1b[2J\x1b]0;title\x07\n'
    path = tmp_path / 'run\x1b[31m'
    path.mkdir()
    if storage == 'mcap':
        (path / 'x.mcap').write_bytes(
            mcap(topic_records(evil, 'evil\x1b/msg/X') + message(b'\0\1\0\0' + bytes(9)))
        )
    else:
        write_sqlite(
            path / 'x.db3',
            f"INSERT INTO topics VALUES (1, '{evil}', 'evil\x1b/msg/X', 'c\x1bdr', '')",
            'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)',
            "INSERT INTO messages VALUES (1, 1, 1, X'000100000000')",
        )
    _, out, err = recover(capsys, path)
    assert r'\x1b[2J' in out + err
    assert r'run\x1b[31m' in out + err
    assert (out + err).replace('\n', '').isprintable()
    with pytest.raises(BagError) as caught:
        read_run(path / 'nothing')
    assert str(caught.value).isprintable()


def test_many_losses_are_counted(tmp_path, capsys):
    bad = chunk('zstd', b'nonsense', 10)
    (tmp_path / 'x.mcap').write_bytes(mcap(topic_records() + bad * 200))
    code, _, err = recover(capsys, tmp_path / 'x.mcap')
    assert code == 1
    assert len(err.splitlines()) < 60
    assert err.splitlines()[-1].startswith('... and 1')


# --- Time


def test_large_messages_of_sqlite_are_read_in_linear_time(tmp_path):
    """Pages of a chain are joined once: nothing is copied for each page."""

    path = write_sqlite(
        tmp_path / 'x.db3',
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)',
        'INSERT INTO messages VALUES (1, 1, 1, zeroblob(24000000))',
    )
    read = 0

    class Counted(_Pages):
        def page(self, number):
            nonlocal read
            read += 1
            return Page(super().page(number))

    class Page(bytes):
        def __radd__(self, other):
            raise AssertionError('what was read so far is copied')

        def __getitem__(self, key):
            found = super().__getitem__(key)
            return Page(found) if isinstance(key, slice) else found

    with open(path, 'rb') as file:
        pages = Counted(file)
        rows = [
            row
            for number in range(1, pages.count + 1)
            for row in pages.rows(number)
            if row[1] is not None
        ]
    assert len(rows[-1][1][-1]) == 24_000_000
    assert read < 2.1 * pages.count


def test_the_limit_of_a_reader_is_that_of_a_record(tmp_path):
    path = write_sqlite(
        tmp_path / 'x.db3',
        "INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr', '')",
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)',
    )
    reader = _SqliteReader(path)
    reader.open()
    try:
        (size,) = reader.dbconn.execute(f'SELECT length(zeroblob({MAX_RECORD}))').fetchone()
        assert size == MAX_RECORD
        with pytest.raises(Exception, match='too big'):
            reader.dbconn.execute(f'SELECT hex(zeroblob({MAX_RECORD}))').fetchall()
    finally:
        reader.close()
