"""recover_run calls nothing complete that it cannot check: checksums, counts and damaged bags."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing

import pytest
from support.raw_bags import TOPICS, make_messages, read_bag, recover, write_bag, write_journal

from diffdrive_jacobian.bags.bag_reader import find_damage

DATA_END, FOOTER, STATISTICS = 0x0F, 0x02, 0x0B


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


@pytest.fixture(scope='module')
def messages():
    return make_messages(60, 300)


@pytest.fixture
def ours(tmp_path, capsys, messages):
    """Return a bag as record_run writes it."""
    recover(capsys, write_journal(tmp_path / 'run', messages))
    return tmp_path / 'run'


def records(data):
    """Return opcode, place and end of the records of an MCAP file."""
    found, place = [], 8
    while place < len(data) - 8:
        opcode, length = struct.unpack_from('<BQ', data, place)
        found.append((opcode, place, place + 9 + length))
        place += 9 + length
    return found


def edit(file, change):
    """Change the bytes of a file in place."""
    data = bytearray(file.read_bytes())
    change(data)
    file.write_bytes(data)


# --- The checksums that are written


def test_written_checksums(ours):
    """As the specification defines them."""
    data = (ours / 'run.mcap').read_bytes()
    places = {opcode: (place, end) for opcode, place, end in records(data)}
    chunk, _ = places[0x06]
    size, checksum, _, length = struct.unpack_from('<QIIQ', data, chunk + 25)
    assert zlib.crc32(data[chunk + 49 : chunk + 49 + length]) == checksum
    assert size == length
    end, after = places[DATA_END]
    assert struct.unpack_from('<I', data, after - 4) == (zlib.crc32(data[:end]),)
    footer, _ = places[FOOTER]
    summary, _, checksum = struct.unpack_from('<QQI', data, footer + 9)
    assert summary == after
    assert checksum == zlib.crc32(data[summary : footer + 25])


def test_the_mcap_library_accepts_the_checksums(ours):
    reader = pytest.importorskip('mcap.stream_reader').StreamReader
    with open(ours / 'run.mcap', 'rb') as file:
        names = [type(one).__name__ for one in reader(file, validate_crcs=True).records]
    assert names.count('Message') == 60
    edit(ours / 'run.mcap', lambda data: data.__setitem__(len(data) // 2, data[len(data) // 2] ^ 1))
    with open(ours / 'run.mcap', 'rb') as file, pytest.raises(Exception, match='crc'):
        list(reader(file, validate_crcs=True).records)


# --- What is checked


def test_checksums_of_chunks_and_counts_suffice(ours, capsys):
    """As `ros2 bag record` writes them, without a checksum of the data section."""

    def remove_checksum(data):
        (end,) = (end for opcode, _, end in records(data) if opcode == DATA_END)
        data[end - 4 : end] = bytes(4)

    edit(ours / 'run.mcap', remove_checksum)
    code, _, err = recover(capsys, ours)
    assert (code, 'is complete' in err) == (1, True)


def test_chunks_without_counts_do_not(ours, capsys):
    def remove_counts(data):
        (end,) = (end for opcode, _, end in records(data) if opcode == DATA_END)
        data[end - 4 :] = bytes(4) + struct.pack('<BQQQI', FOOTER, 20, 0, 0, 0) + data[:8]

    edit(ours / 'run.mcap', remove_counts)
    code, _, err = recover(capsys, ours)
    assert code == 3
    assert 'it has no count of its messages' in err


@pytest.mark.parametrize(
    ('opcode', 'place', 'said'),
    [
        (STATISTICS, 9 + 46 + 2, 'its statistics count '),
        (STATISTICS, 9 + 46 + 2, 'the checksum of its summary is wrong'),
        (0x0C, 30, 'the checksum of its data section is wrong'),
        (0x06, 60, 'the checksum of its data section is wrong'),
        (0x06, 200, 'a chunk of '),
    ],
)
def test_one_byte_is_noticed(ours, capsys, opcode, place, said):
    def alter(data):
        at = next(start for one, start, _ in records(data) if one == opcode)
        data[at + place] ^= 1

    edit(ours / 'run.mcap', alter)
    for what in (ours, ours / 'run.mcap'):
        _, out, err = recover(capsys, what, '-o', ours.parent / f'new{what.suffix}')
        assert f'lost: run.mcap: {said}' in out or said in err


@pytest.mark.parametrize('topic', TOPICS)
def test_readers_refuse_an_index_with_a_wrong_checksum(ours, topic):
    """Another name of a topic in it would hide the messages of that topic."""
    file = ours / 'run.mcap'
    assert find_damage(file) == ''
    name = struct.pack('<I', len(topic)) + topic.encode()

    def rename(data):
        assert data.count(name) == 2  # In the chunk and in the index.
        data[data.rindex(name) + len(name) - 1] ^= 1

    edit(file, rename)
    assert 'the checksum of its summary is wrong' in find_damage(file)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_middle_of_a_bag_without_metadata(tmp_path, capsys, messages, storage):
    """2 kB of zeros: an opcode that does not exist, and a page without its rows."""
    write_bag(tmp_path / 'run', storage, messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    (file,) = (tmp_path / 'run').iterdir()
    half = file.read_bytes().index(messages[30][2]) // 4096 * 4096
    edit(file, lambda data: data.__setitem__(slice(half, half + 2048), bytes(2048)))
    code, out, _ = recover(capsys, tmp_path / 'run')
    assert code == 0
    assert 'lost: ' in out
    assert 'is complete' not in out
    assert len(read_bag(tmp_path / 'run_recovered')) < len(messages)


def test_a_file_of_which_only_the_counts_are_wrong(tmp_path, capsys, messages):
    """Of a bag of another writer, whose messages have no checksums."""
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    with closing(sqlite3.connect(tmp_path / 'run' / 'run.db3')) as database, database:
        database.execute('UPDATE messages SET topic_id = 3 - topic_id WHERE id = 1')
    code, out, _ = recover(capsys, tmp_path / 'run')
    assert code == 0
    assert 'lost: metadata.yaml counts ' in out
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    _, out, _ = recover(capsys, tmp_path / 'run', '-o', tmp_path / 'new')
    assert 'lost: the copy of metadata.yaml counts ' in out


# --- Random damage


def damage(data, chance):
    """Set some bytes to zero, cut the file off, or flip up to 3 bits."""
    at = chance.randrange(len(data))
    kind = chance.choice(('zeros', 'cut', 'flips'))
    if kind == 'zeros':
        size = min(chance.choice((1, 30, 2048)), len(data) - at)
        data[at : at + size] = bytes(size)
    elif kind == 'cut':
        del data[at:]
    else:
        for _ in range(chance.randrange(1, 4)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


@pytest.mark.parametrize('writer', ['ours', 'mcap', 'sqlite3'])
def test_nothing_is_called_complete_that_lacks_a_message(tmp_path, capsys, messages, writer):
    if writer == 'ours':
        recover(capsys, write_journal(tmp_path / 'run', messages))
    else:
        write_bag(tmp_path / 'run', writer, messages)
    chance = random.Random(writer)
    for number in range(24):
        bag = shutil.copytree(tmp_path / 'run', tmp_path / str(number))
        (file,) = (one for one in bag.iterdir() if one.suffix != '.yaml')
        edit(file, lambda data: damage(data, chance))
        if number % 2:
            (bag / 'metadata.yaml').unlink()
        new = tmp_path / f'{number}_new'
        code, out, err = recover(capsys, file if number % 3 == 0 else bag, '-o', new)
        if 'is complete' in err:
            assert read_bag(bag if (bag / 'metadata.yaml').exists() else file) == messages
        elif code == 0 and 'lost: ' not in out and 'loss cannot be excluded: ' not in out:
            assert read_bag(new) == messages
        else:
            assert (code, new.exists()) in ((0, True), (1, False), (1, True), (3, False))
        assert writer == 'ours' or 'is complete' not in err
