"""What recover_run reads out of broken MCAP and SQLite files: the true messages that are whole."""

from __future__ import annotations

import os
import random
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import pytest
from fork_server import forked
from rosbags.rosbag2 import CompressionMode
from support.raw_bags import TOPICS, contents, make_messages, names_of, read_bag, recover, write_bag

if sys.version_info >= (3, 14):
    from compression.zstd import compress as zstd_compress
else:
    from backports.zstd import compress as zstd_compress

STORAGES = ('mcap', 'sqlite3')
PAGE = 4096
CUTS = 25
"""For each of eight kinds of bags."""


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Save time: no bag needs to survive a power cut."""
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


# --- Cuts


def cut(path, size):
    """Leave a copy of a bag without metadata, its only file cut off."""
    file = next(one for one in path.iterdir() if one.suffix != '.yaml')
    broken = path.with_name(f'{path.name}_cut_{size}')
    broken.mkdir()
    (broken / file.name).write_bytes(file.read_bytes()[:size])
    return broken


def assert_subset(found, messages):
    """It has nothing that was not written, and that in its order."""
    rest = iter(messages)
    assert all(one in rest for one in found)


@pytest.fixture(
    scope='module',
    params=[
        ('mcap', CompressionMode.NONE, 'small'),
        ('mcap', CompressionMode.NONE, 'large'),
        ('mcap', CompressionMode.STORAGE, 'small'),
        ('mcap', CompressionMode.STORAGE, 'large'),
        ('mcap', CompressionMode.MESSAGE, 'small'),
        ('sqlite3', CompressionMode.NONE, 'small'),
        ('sqlite3', CompressionMode.NONE, 'large'),
        ('sqlite3', CompressionMode.MESSAGE, 'large'),
    ],
    ids=lambda param: '-'.join(map(str, param)),
)
def bag(request, tmp_path_factory):
    """A whole bag, what it holds, and its file's bytes."""
    storage, mode, size = request.param
    messages = make_messages(60, 400) if size == 'small' else make_messages(100, 20_000)
    path = tmp_path_factory.mktemp('bag') / 'run'
    write_bag(path, storage, messages, mode)
    return path, messages, (path / f'run.{"mcap" if storage == "mcap" else "db3"}').read_bytes(), mode


def test_cuts_at_random_bytes(bag, capsys):
    path, messages, data, mode = bag
    chance = random.Random(f'{path.name}{len(data)}{mode}')
    ended = ends(data, messages) if mode == CompressionMode.NONE else []
    sizes = {0, 1, 8, 100, len(data) - 1, *(chance.randrange(len(data)) for _ in range(CUTS - 5))}
    for size in sorted(sizes):
        broken = cut(path, size)
        before = contents(broken)
        code, out, err = recover(capsys, broken)
        assert contents(broken) == before
        found = []
        if code == 0:
            found = read_bag(broken.with_name(f'{broken.name}_recovered'))
            assert f'{len(found)} messages' in out
            assert err == ''
        else:
            assert (code, out) == (1, '')
            assert 'holds no message that can be saved' in err
        assert_subset(found, messages)
        if mode == CompressionMode.NONE:
            # In MCAP up to the cut, in SQLite in whole pages.
            last = size if data.startswith(b'\x89MCAP') else size - size % PAGE
            whole = [one for one, end in zip(messages, ended, strict=True) if end <= last]
            assert found == whole


def ends(data, messages):
    """Return where in the file the bytes of each message are complete."""
    if data.startswith(b'\x89MCAP'):
        return [data.index(content) + len(content) for _, _, content in messages]
    # The larger ones are in several pages: the last of these counts.
    return [
        max(data.rindex(content[-64:]), data.rindex(content[:64])) + 64 for _, _, content in messages
    ]


def test_complete_files_without_metadata(bag, capsys):
    path, messages, data, _ = bag
    broken = cut(path, len(data))
    code, out, _ = recover(capsys, broken)
    assert code == 0
    assert 'lost: ' not in out
    assert 'loss cannot be excluded: there is no valid metadata.yaml' in out
    recovered = broken.with_name(f'{broken.name}_recovered')
    assert read_bag(recovered) == messages
    assert names_of(recovered) == names_of(path)


# --- Damage that can be seen


def add_checksums(data):
    """Give the chunks of MCAP checksums: rosbags writes none, rosbag2 does."""
    data, place = bytearray(data), 8
    while place < len(data) - 8:
        opcode, length = struct.unpack_from('<BQ', data, place)
        if opcode == 0x06:
            (size,) = struct.unpack_from('<Q', data, place + 25)
            content = data[place + 49 : place + 49 + size]
            struct.pack_into('<I', data, place + 33, zlib.crc32(content))
        place += 9 + length
    return data


def test_a_chunk_with_a_wrong_checksum_is_saved_and_reported(tmp_path, capsys):
    """Its size is 1 MiB: a run of a minute."""
    messages = make_messages(400, 20_000)
    write_bag(tmp_path / 'run', 'mcap', messages)
    broken = cut(tmp_path / 'run', None)
    data = add_checksums((broken / 'run.mcap').read_bytes())
    data[len(data) // 2] ^= 0x55
    (broken / 'run.mcap').write_bytes(data)
    code, out, _ = recover(capsys, broken)
    assert code == 0
    assert 'lost: run.mcap: a chunk of' in out
    assert 'its messages may be altered' in out
    found = read_bag(broken.with_name(f'{broken.name}_recovered'))
    assert sum(one != other for one, other in zip(found, messages, strict=True)) == 1


def test_a_damaged_page_costs_no_other(tmp_path, capsys):
    messages = make_messages(400, 1000)
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    broken = cut(tmp_path / 'run', None)
    file = next(broken.iterdir())
    data = bytearray(file.read_bytes())
    page = len(data) // PAGE // 2 * PAGE
    data[page : page + PAGE] = b'\xa5' * PAGE
    file.write_bytes(data)
    code, out, _ = recover(capsys, broken)
    assert code == 0
    assert 'messages cannot be read' in out
    found = read_bag(broken.with_name(f'{broken.name}_recovered'))
    assert_subset(found, messages)
    assert len(messages) > len(found) > 380


def test_a_length_beyond_all_positions(tmp_path, capsys):
    """Of an attachment, which is skipped, so that the length becomes a position in the file."""
    messages = make_messages(60, 400)
    write_bag(tmp_path / 'run', 'mcap', messages)
    broken = cut(tmp_path / 'run', None)
    data = bytearray((broken / 'run.mcap').read_bytes())
    struct.pack_into('<BQ', data, data.index(messages[30][2]) - 22 - 9, 0x09, 2**64 - 1)
    (broken / 'run.mcap').write_bytes(data)
    code, out, _ = recover(capsys, broken)
    assert code == 0
    assert 'bytes of a chunk are not complete records' in out
    assert read_bag(broken.with_name(f'{broken.name}_recovered')) == messages[:30]


def test_the_end_of_an_sqlite_file_that_became_zeros(tmp_path, capsys):
    messages = make_messages(400, 1000)
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    broken = cut(tmp_path / 'run', None)
    file = next(broken.iterdir())
    data = file.read_bytes()
    left, pages = 2 * len(data) // 3 // PAGE, len(data) // PAGE
    file.write_bytes(data[: left * PAGE].ljust(len(data), b'\0'))
    code, out, _ = recover(capsys, broken)
    assert code == 0
    assert f'lost: run.db3: {pages - left} of its {pages} pages are empty' in out
    found = read_bag(broken.with_name(f'{broken.name}_recovered'))
    assert found == messages[: len(found)]


def test_messages_of_zeros_are_no_empty_pages(tmp_path, capsys):
    """A black picture fills whole pages with zeros."""
    topic = next(iter(TOPICS))
    messages = [(topic, 1000 + index, b'\0\1\0\0' + bytes(20_000)) for index in range(10)]
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    data = (tmp_path / 'run' / 'run.db3').read_bytes()
    assert bytes(PAGE) in {data[at : at + PAGE] for at in range(0, len(data), PAGE)}
    _, out, _ = recover(capsys, cut(tmp_path / 'run', None))
    assert '10 messages' in out
    assert 'lost: ' not in out


@pytest.mark.parametrize('storage', STORAGES)
def test_random_bytes_never_make_a_traceback(tmp_path, capsys, storage):
    # Bytes of a message itself may be wrong then, for neither format checks them.
    write_bag(tmp_path / 'run', storage, make_messages(60, 400))
    file = next((tmp_path / 'run').glob(f'run.{"mcap" if storage == "mcap" else "db3"}'))
    chance = random.Random(storage)
    for number in range(60):
        data = bytearray(file.read_bytes())
        for _ in range(chance.randrange(1, 40)):
            data[chance.randrange(len(data) // (1 + number % 4))] = chance.randrange(256)
        broken = tmp_path / f'broken_{number}'
        broken.mkdir()
        (broken / file.name).write_bytes(data)
        code, _, _ = recover(capsys, broken)
        assert code in (0, 1)


@pytest.mark.parametrize(('name', 'compress'), [('lz4', lz4.frame.compress), ('zstd', zstd_compress)])
def test_cuts_in_a_compressed_chunk(tmp_path, capsys, name, compress):
    """As rosbag2 writes chunks: what comes before the cut can be unpacked, as far as whole blocks go."""
    messages = make_messages(1000, 1900)
    write_bag(tmp_path / 'run', 'mcap', messages)
    data = (tmp_path / 'run' / 'run.mcap').read_bytes()
    head = 8 + 9 + struct.unpack_from('<Q', data, 9)[0]
    _, _, start, end, size, _, _, _ = struct.unpack_from('<BQQQQIIQ', data, head)
    content = data[head + 49 : head + 49 + size]
    packed = compress(content)
    chunk = struct.pack('<QQQII', start, end, size, zlib.crc32(content), len(name)) + name.encode()
    chunk += struct.pack('<Q', len(packed)) + packed
    for number, part in enumerate((0.0, 0.3, 0.8, 1.0)):
        left = int(part * len(packed)) + len(chunk) - len(packed)
        broken = tmp_path / f'broken_{number}.mcap'
        broken.write_bytes(data[:head] + struct.pack('<BQ', 6, len(chunk)) + chunk[:left])
        code, _, _ = recover(capsys, broken)
        found = read_bag(broken.with_name(f'{broken.stem}_recovered')) if code == 0 else []
        assert found == messages[: len(found)]
        least = (part * size - 150_000) / 1500
        assert len(found) >= least


# --- rosbags' writer, killed

WRITER = """
import sys
sys.path.insert(0, sys.argv[3])
from support.raw_bags import make_messages, write_bag
def report(count):
    if count % 10 == 0:
        print(count, flush=True)
write_bag(sys.argv[1], sys.argv[2], make_messages(4_000, 3_500), told=report)
"""


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('killed_at', [1_000, 1_940, 3_980])
def test_a_killed_writer(tmp_path, capsys, storage, killed_at):
    path = tmp_path / 'run'
    arguments = (path, storage, Path(__file__).parents[1])
    child = forked.Popen(WRITER, arguments, stdout=subprocess.PIPE)
    with child.stdout:
        for line in child.stdout:
            if int(line) >= killed_at:
                break
        child.kill()
    assert child.wait() == -signal.SIGKILL
    before = contents(path)
    code, _, err = recover(capsys, path)
    assert (code, err) == (0, '')
    assert contents(path) == before
    found = read_bag(tmp_path / 'run_recovered')
    assert_subset(found, make_messages(4_000, 3_500))
    # A chunk of MCAP is written per MiB, and SQLite holds back 2 MB of pages.
    assert len(found) >= killed_at - 1_600
    assert {topic for topic, _, _ in found} == set(TOPICS)
