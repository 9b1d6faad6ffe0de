"""Bags and YAML made to do harm: to take time or memory, to be executed, to lead elsewhere."""

from __future__ import annotations

import os
import shutil
import sqlite3
import textwrap
from contextlib import suppress
from functools import partial

import pytest
from hostile_bags import (
    CYCLE,
    ENDLESS,
    GENERATED,
    GIB,
    METADATA,
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
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import CompressionMode
from ruamel.yaml import YAML
from support.raw_bags import contents, data_file, make_messages, read_bag, recover, write_bag
from support.ros_messages import odometry

from diffdrive_jacobian import bounded_yaml
from diffdrive_jacobian.bags import BagError, NotABagError, bounded_reader, read_run
from diffdrive_jacobian.bags import recover as write_recovered
from diffdrive_jacobian.bags.bag_reader import find_damage, open_bag
from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bounded_yaml import MAX_DEPTH, MAX_SIZE, TooLargeError, load_yaml
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.file import robot_parameters

pytestmark = pytest.mark.usefixtures('quick_disk', 'bounded_memory')

GOOD = mcap(topic_records() + message(serialize_message(odometry(1.0, 0.0, 0.0))))


@pytest.fixture
def run(tmp_path):
    return tmp_path / 'run'


@pytest.fixture
def file(tmp_path):
    return tmp_path / 'x.mcap'


def assert_refused(path, match):
    with pytest.raises(BagError, match=match):
        read_run(path)


# --- Time and memory


def as_file(data):
    return lambda run: write(run.with_suffix('.mcap'), data)


def as_folder(name, data, **options):
    return lambda run: write_folder(run, name, data, **options)


def as_database(build, *arguments):
    return lambda run: build(write_folder(run, 'x.db3', storage='sqlite3') / 'x.db3', *arguments).parent


def write(path, data):
    path.write_bytes(data)
    return path


def sparse_record(run):
    """Write a file whose second record is 12 GiB of nothing on the disk."""
    path = run.with_suffix('.mcap')
    with open(path, 'wb') as out:
        out.write(mcap(topic_records())[:-37])
        out.write(b'\x03' + (12 * GIB).to_bytes(8, 'little'))
        out.seek(12 * GIB, 1)
        out.write(mcap(b'')[-37:])
    return path


SIZE = 2 * GIB
LZ4, ZSTD, UNDECLARED = lz4_zeros(GIB), zstd_zeros(SIZE), zstd_zeros(SIZE, declared=False)
FIVE = zstd_zeros(5 * MIB)
CHUNK, SMALL = 'at most 134.2 MB are read', 'Chunk size mismatch: expected 1000 bytes, got 1001'
TOTAL, IN_TOTAL = 'unpacks to', r'it unpacks to more than \d+\.\d MB, the most that is read'
QOS = mcap(topic_records(qos=merging_laughs()) + message(b'\0\1\0\0' + bytes(100)))
LIMIT = 'stands for more than 200000 values'
PLAIN = 'must be a plain table, but'
ATTACKS = {
    'lz4': (as_file(chunk_bomb('lz4', LZ4, GIB, indexed=True)), CHUNK, 1, CHUNK),
    'zstd': (as_file(chunk_bomb('zstd', ZSTD, SIZE, indexed=False)), CHUNK, 1, CHUNK),
    'zstd, undeclared': (as_file(chunk_bomb('zstd', UNDECLARED, SIZE, indexed=True)), CHUNK, 1, CHUNK),
    'lz4 that seems small': (as_file(chunk_bomb('lz4', LZ4, 1000, indexed=True)), SMALL, 1, ''),
    'zstd that seems small': (
        as_file(chunk_bomb('zstd', UNDECLARED, 1000, indexed=False)),
        SMALL,
        1,
        '',
    ),
    'many chunks': (
        *(as_file(chunk_bomb('zstd', FIVE, 5 * MIB, indexed=True, times=400)), IN_TOTAL),
        *(1, 'it unpacks to more than'),
    ),
    'many chunks, no index': (
        *(as_file(chunk_bomb('zstd', FIVE, 5 * MIB, indexed=False, times=400)), IN_TOTAL),
        *(1, 'it unpacks to more than'),
    ),
    'file': (as_folder('x.mcap.zstd', ZSTD, mode='FILE'), r'x\.mcap.* unpacks to', 2, TOTAL),
    'file, undeclared': (
        *(as_folder('x.db3.zstd', UNDECLARED, mode='FILE', storage='sqlite3'), r'x\.db3.* unpacks to'),
        *(2, TOTAL),
    ),
    'message': (
        *(as_folder('x.mcap', mcap(topic_records() + message(ZSTD)), mode='MESSAGE'), 'a message'),
        *(1, '1 messages are not CDR, are too large'),
    ),
    'message, undeclared': (
        *(as_folder('x.mcap', mcap(topic_records() + message(UNDECLARED)), mode='MESSAGE'), 'a message'),
        *(1, '1 messages are not CDR, are too large'),
    ),
    'sparse file': (sparse_record, 'a record unpacks to 12.9 GB|a record of 12.9 GB', 1, ''),
    'generated column': (as_database(write_sqlite, *GENERATED), PLAIN, 1, ''),
    'endless view': (as_database(write_sqlite, *ENDLESS), PLAIN, 1, ''),
    'overflow': (as_database(write_loop, 2_000), 'too big|malformed', 1, 'holds no message'),
    'large overflow': (as_database(write_loop, 60_000), 'too big|malformed', 1, 'holds no message'),
    'profiles': (as_file(QOS), LIMIT, 3, ''),
}
"""Each: writes a bag, of which readers say something, and recover_run, with an exit code, another."""


@pytest.mark.parametrize('attack', ATTACKS)
def test_a_bag_that_takes_time_or_memory(run, capsys, monkeypatch, attack):
    monkeypatch.setattr(bounded_reader, 'FREE', 16 * MIB)
    build, refused, code, said = ATTACKS[attack]
    path = build(run)
    assert_refused(path, refused)
    found, out, err = recover(capsys, path)
    assert (found, out) == (code, '')
    assert said in err


def test_chunks_that_overlap_in_time_are_not_unpacked_at_once(file, monkeypatch):
    # A larger file may unpack to that.
    monkeypatch.setattr(bounded_reader, 'FREE', GIB)
    size = 100 * MIB
    file.write_bytes(chunk_bomb('zstd', zstd_zeros(size), size, indexed=True, times=9, end=2))
    assert_refused(file, 'its chunks overlap in time and unpack to more than 536.9 MB at once')


def test_compressed_files_have_one_budget(run, monkeypatch):
    monkeypatch.setattr(bounded_reader, 'FREE', 10 * MIB)
    names = [f'{index}.mcap.zstd' for index in range(3)]
    write_folder(run, ', '.join(names), mode='FILE')
    for name in names:
        (run / name).write_bytes(zstd_zeros(4 * MIB))
    assert_refused(run, r'2\.mcap\.zstd: it unpacks to more than 10\.5 MB')


@pytest.mark.parametrize('mode', CompressionMode)
def test_compressed_bags_are_read(run, mode):
    messages = make_messages(12, 20_000)
    write_bag(run, 'mcap', messages, mode)
    with BoundedReader(run) as reader:
        assert [(one.topic, at, bytes(data)) for one, at, data in reader.messages()] == messages


def test_highly_compressible_messages_are_read(file):
    """Black images: far less than a thousandth of their size on the disk."""
    data = b'\0\1\0\0' + bytes(24_000_000)
    inner = topic_records() + message(data)
    packed = bounded_reader.zstd.compress(inner)
    assert len(packed) < len(inner) / 5000
    file.write_bytes(mcap(chunk('zstd', packed, len(inner))))
    with open_bag(file) as reader:
        assert [len(found) for _, _, found in reader.messages()] == [len(data)]


@pytest.mark.parametrize('statistics', [3, None])
def test_chunks_without_an_index_of_their_messages_are_read(file, statistics):
    found = message(b'\0\1\0\0' + bytes(100)) * 3
    one = chunk('', found, len(found))
    entry = (len(topic_records()), len(one), '', len(found), len(found))
    file.write_bytes(mcap(topic_records() + one, (entry,), message_index=False, statistics=statistics))
    with open_bag(file) as reader:
        assert reader.message_count == 3
        assert len(list(reader.messages(reader.connections))) == 3
    assert find_damage(file) == ''


# --- SQLite


def test_queries_end(run, monkeypatch):
    """Pages that refer to each other could be walked for ever."""
    write_bag(run, 'sqlite3', make_messages(1000, 10))
    monkeypatch.setattr(bounded_reader, '_STEPS', 100)
    monkeypatch.setattr(bounded_reader, '_FREE_STEPS', 1000)
    monkeypatch.setattr(bounded_reader, '_STEPS_PER_BYTE', 0)
    assert_refused(run, 'its queries take more steps')


def test_a_log_that_names_a_page_far_away(run, capsys, monkeypatch):
    """A copy of the database with its log applied could have any number of empty pages."""
    write_bag(run, 'sqlite3', make_messages(10, 50))
    (run / 'metadata.yaml').unlink()
    (run / 'run.db3-wal').write_bytes(b'log')
    connect, enlarged = sqlite3.connect, []

    def enlarge(copy, *arguments, **options):
        if not enlarged:
            os.truncate(copy, GIB)
            enlarged.append(copy)
        return connect(copy, *arguments, **options)

    monkeypatch.setattr(sqlite3, 'connect', enlarge)
    assert recover(capsys, run, '-o', run.with_name('new'))[0] == 0
    assert enlarged
    assert read_bag(run.with_name('new')) == make_messages(10, 50)


# --- Paths


@pytest.mark.parametrize(('storage', 'name'), [('mcap', 'run%41#2'), ('sqlite3', 'a b&c#?x=1%41')])
def test_paths_are_no_uris(run, tmp_path, capsys, storage, name):
    messages = make_messages(20, 300)
    path = tmp_path / name / name
    path.parent.mkdir()
    # rosbags would write the data of such a bag elsewhere.
    write_bag(run, storage, messages)
    file = data_file(run)
    ending = file.suffix
    file.rename(run / f'{name}{ending}')
    metadata = run / 'metadata.yaml'
    text = metadata.read_text().replace(f'run{ending}', f"'{name}{ending}'")
    metadata.write_text(text.replace("''", "'"))
    run.rename(path)
    with open_bag(path) as reader:
        assert [(one.topic, at, bytes(data)) for one, at, data in reader.messages()] == messages
    with open_bag(path / f'{name}{ending}') as reader:
        assert len(list(reader.messages())) == len(messages)
    (path / 'metadata.yaml').unlink()
    assert recover(capsys, path, '-o', tmp_path / 'new')[0] == 0
    assert read_bag(tmp_path / 'new') == messages


@pytest.mark.parametrize('mode', ['', 'FILE'])
def test_files_of_a_bag_are_in_its_folder(run, tmp_path, capsys, mode):
    """Only the names in `relative_file_paths` count, so nothing elsewhere is read or written."""
    name = 'x.mcap.zstd' if mode else 'x.mcap'
    other = tmp_path / 'other'
    other.mkdir()
    (other / name).write_bytes(GOOD)
    run.mkdir()
    (run / 'a').symlink_to('../other')
    for listed in (f'../other/{name}', str(other / name), f'a/{name}'):
        text = METADATA.format(storage='mcap', compression='', mode=mode, file=listed, more='')
        (run / 'metadata.yaml').write_text(text)
        before = sorted(tmp_path.rglob('*'))
        assert_refused(run, name)
        assert recover(capsys, run)[0] in (1, 2)
        assert sorted(tmp_path.rglob('*')) == before
        assert (other / name).read_bytes() == GOOD


def replace(path, kind):
    """Put what is no regular file in the place of a file."""
    path.unlink()
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'device':
        path.symlink_to('/dev/zero')
    else:
        path.mkdir()


@pytest.mark.parametrize(
    ('kind', 'storage'), [('pipe', 'mcap'), ('device', 'sqlite3'), ('directory', 'mcap')]
)
def test_files_that_are_not_regular_are_not_read(run, tmp_path, kind, storage):
    messages = make_messages(10, 50)
    write_bag(run, storage, messages)
    other = shutil.copytree(run, tmp_path / 'other')
    replace(run / 'metadata.yaml', kind)
    assert_refused(run, r'metadata\.yaml is not a regular file \(`recover_run')
    recovery = write_recovered(run)
    assert recovery.lost[0] == 'metadata.yaml: metadata.yaml is not a regular file'
    assert read_bag(recovery.bag) == messages
    # As the only data file, and beside one that metadata.yaml does not list.
    file = data_file(other)
    replace(file, kind)
    assert_refused(other, f'{file.name} is not a regular file')
    with pytest.raises(NotABagError, match=r'neither \.mcap nor \.db3 files'):
        write_recovered(other)
    shutil.copy(data_file(run), file.with_stem('second'))
    recovery = write_recovered(other)
    assert f'{file.name} is not a regular file' in recovery.lost
    assert read_bag(recovery.bag) == messages


def test_a_pipe_in_the_place_of_a_bag_is_not_read(tmp_path):
    for name in ('run', 'run.mcap', 'run.db3', 'run.journal.mcap'):
        os.mkfifo(tmp_path / name)
        for function in (read_run, write_recovered):
            with pytest.raises((BagError, NotABagError), match=f'{name} is not a bag: it is not a reg'):
                function(tmp_path / name)


# --- YAML

TAGS = (
    '!!python/object/apply:os.system ["touch executed"]',
    '!!python/object/new:os.system ["touch executed"]',
    '!!python/name:os.system',
    '!!python/module:os',
    '!!js/function "touch"',
    '!!binary aGVsbG8=',
    '!<tag:example.com,2026:x> {a: 1}',
)
PARAMS = 'virtual_robot:\n  ros__parameters:\n'


def test_nothing_in_yaml_is_executed(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for tag in TAGS:
        write_folder(run, 'x.mcap', GOOD, more=f'  custom_data: {{key: {tag}}}\n')
        with suppress(BagError):
            assert len(read_run(run).odometry) == 1
        recover(capsys, run)
        (tmp_path / 'params.yaml').write_text(f'{PARAMS}    x: {tag}\n')
        with suppress(UserError, ValueError):
            robot_parameters('params.yaml')
        assert 'executed' not in os.listdir(tmp_path)


@pytest.mark.parametrize('text', [laughs(), merging_laughs(), CYCLE], ids=['lists', 'maps', 'a cycle'])
def test_aliases_of_aliases(run, tmp_path, capsys, text):
    indented = textwrap.indent(text, ' ' * 4)
    write_folder(run, 'x.mcap', GOOD, more=f'  custom_data:\n{indented}')
    match = f'{LIMIT}|part of its own value'
    assert_refused(run, match)
    code, out, _ = recover(capsys, run)
    assert code == 0
    assert 'lost: metadata.yaml: the YAML' in out
    (tmp_path / 'params.yaml').write_text(PARAMS + indented)
    with pytest.raises(UserError, match=match):
        robot_parameters(tmp_path / 'params.yaml')


@pytest.mark.parametrize('pure', [False, True], ids=['parser in C', 'parser in Python'])
def test_yaml_of_moderate_size_is_read(monkeypatch, pure):
    """By the parser that is there if ruamel.yaml.clib is, and by the other one."""
    monkeypatch.setattr(bounded_yaml, 'YAML', partial(YAML, pure=pure))
    bounded_yaml._check_text.cache_clear()
    bounded_yaml._pickled.cache_clear()
    text = 'a: &x [1, 2]\nb: *x\nc: {<<: &y {d: *x}, e: *y}\n'
    loaded = load_yaml(text)
    assert loaded == {'a': [1, 2], 'b': [1, 2], 'c': {'d': [1, 2], 'e': {'d': [1, 2]}}}
    loaded['a'].append(3)
    assert loaded['b'] == [1, 2, 3]
    # What the caller has changed is not loaded again.
    assert load_yaml(text)['a'] == [1, 2]
    for text, match in (
        ('[' * (MAX_DEPTH + 1), 'nested more than'),
        ('- ' * 1000 + 'x', 'nested more than'),
        ('a: ' + '1' * 5000, 'number has more than'),
        ('%YAML 1.1\n---\n' + '1:' * 5000 + '1', 'number has more than'),
        ('a: !!int "' + '1:' * 5000 + '1"', 'number has more than'),
        ('#' * (MAX_SIZE + 1), 'at most 2.0 MB are read'),
    ):
        with pytest.raises(TooLargeError, match=match):
            load_yaml(text)


# --- Definitions, and what is printed


def test_a_definition_of_any_length_is_not_parsed(file, capsys):
    data = topic_records('/x', 'my_msgs/msg/Mine', definition='int32 x\n' * 30_000)
    file.write_bytes(mcap(data + message(b'\0\1\0\0' + bytes(9))))
    code, _, err = recover(capsys, file)
    assert code == 1
    assert 'its definition has 240000 characters; at most 200000 are parsed' in err


def test_terminal_escapes_of_a_bag_are_not_printed(tmp_path, capsys):
    evil = '/odom\x1b[2J\x1b]0;title\x07\n'
    path = tmp_path / 'run\x1b[31m'
    path.mkdir()
    data = topic_records(evil, 'evil\x1b/msg/X') + message(b'\0\1\0\0' + bytes(9))
    (path / 'x.mcap').write_bytes(mcap(data))
    _, out, err = recover(capsys, path)
    assert r'\x1b[2J' in out + err
    assert r'run\x1b[31m' in out + err
    assert (out + err).replace('\n', '').isprintable()
    with pytest.raises(BagError) as caught:
        read_run(path / 'nothing')
    assert str(caught.value).isprintable()


def test_many_losses_are_counted(file, capsys):
    bad = chunk('zstd', b'nonsense', 10)
    file.write_bytes(mcap(topic_records() + bad * 200))
    before = contents(file.parent)
    code, _, err = recover(capsys, file)
    assert (code, contents(file.parent)) == (1, before)
    assert len(err.splitlines()) < 60
    assert err.splitlines()[-1].startswith('... and 1')
