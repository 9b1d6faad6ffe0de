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

"""recover_run: which bags and journals it saves, what it reports, what it refuses and leaves alone.

Random damage is in `test_damage_fuzz`.
"""

from __future__ import annotations

import os
import resource
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
from mcap.opcode import Opcode
from rosbags.rosbag2 import CompressionMode
from support.bags import REAL
from support.raw_bags import (
    PLUGINS,
    START,
    channel,
    contents,
    data_file,
    edit,
    make_messages,
    mcap_records,
    names_of,
    read_bag,
    recover,
    write_bag,
    write_journal,
    write_records,
)

from diffdrive_jacobian.bags.bag_reader import find_damage
from diffdrive_jacobian.bags.corrected_reader import zstd
from diffdrive_jacobian.bags.journal import Message, Text

pytestmark = pytest.mark.usefixtures('quick_disk')
MESSAGES = make_messages(50, 300)


@pytest.fixture
def run(tmp_path):
    return tmp_path / 'run'


@pytest.fixture
def ours(run, capsys):
    """Return a bag as record_run writes it."""
    recover(capsys, write_journal(run, MESSAGES))
    return run


def write_without_metadata(path, storage='mcap', messages=MESSAGES):
    """Write a bag without its metadata; return its file."""
    write_bag(path, storage, messages)
    (path / 'metadata.yaml').unlink()
    return data_file(path)


def saved(capsys, path, *arguments):
    """Recover a bag beside it; return what is reported, and the messages."""
    before = contents(path)
    code, out, err = recover(capsys, path, *arguments)
    assert (code, err) == (0, '')
    assert contents(path) == before
    return out, read_bag(path.with_name(f'{path.name}_recovered'))


# --- Bags of other writers


def test_a_bag_of_ros2_bag_record_without_metadata_and_cut_off(run, tmp_path, capsys):
    true = read_bag(REAL)
    run.mkdir()
    file = Path(shutil.copy(data_file(REAL), run))
    assert recover(capsys, run, '-o', tmp_path / 'whole')[0] == 0
    assert read_bag(tmp_path / 'whole') == true
    assert names_of(tmp_path / 'whole') == names_of(REAL)
    os.truncate(file, 777_777)
    out, found = saved(capsys, run)
    assert f'lost: {file.name}: SQLite refuses the rest: database disk image is malformed' in out
    assert f'it may be had with `sqlite3 {file.name} .recover`' in out
    assert found == true[: len(found)]
    assert len(found) > 900


def test_a_bag_in_parts_of_which_the_last_is_cut_off(run, tmp_path, capsys):
    """As `ros2 bag record --max-bag-size` writes it; part 10 comes after part 9."""
    run.mkdir()
    for number, part in enumerate((2, 9, 10)):
        file = write_without_metadata(tmp_path / 'part', messages=MESSAGES[4 * number : 4 * number + 4])
        data = file.read_bytes()
        (run / f'run_{part}.mcap').write_bytes(data if part < 10 else data[: len(data) // 2])
        shutil.rmtree(tmp_path / 'part')
    out, found = saved(capsys, run)
    assert 'lost: run_10.mcap' in out
    assert 'begins before' not in out
    assert found[:8] == MESSAGES[:8]
    assert found[8:] == MESSAGES[8 : len(found)]


def test_files_that_are_copied_or_missing_are_reported(run, tmp_path, capsys):
    file = write_without_metadata(run)
    shutil.copy(file, run / 'copy.mcap')
    out, found = saved(capsys, run)
    assert len(found) == 2 * len(MESSAGES)
    assert 'loss cannot be excluded: run.mcap begins before copy.mcap ends' in out
    write_bag(tmp_path / 'other', 'mcap', MESSAGES)
    metadata = tmp_path / 'other' / 'metadata.yaml'
    text = metadata.read_text().replace('message_count: 50', 'message_count: 70')
    metadata.write_text(text.replace('  - other.mcap', '  - other.mcap\n  - other_1.mcap'))
    out, _ = saved(capsys, tmp_path / 'other')
    assert 'lost: other_1.mcap is missing' in out
    assert 'lost: metadata.yaml counts 70 messages, 50 were found' in out


def test_logs_of_sqlite_are_applied_or_rolled_back(run, tmp_path, capsys):
    file = write_without_metadata(run, 'sqlite3')
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA cache_size = 1')
        database.execute("UPDATE messages SET data = X'00010000' || zeroblob(5000)")
        shutil.copytree(run, tmp_path / 'broken')
    assert data_file(tmp_path / 'broken').read_bytes() != file.read_bytes()
    assert (tmp_path / 'broken' / 'run.db3-journal').stat().st_size > 0
    assert saved(capsys, tmp_path / 'broken')[1] == MESSAGES
    more = (START + 10**9, b'\0\1\0\0more of it')
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)', more)
        database.commit()
        shutil.copytree(run, tmp_path / 'logged')
    assert saved(capsys, tmp_path / 'logged')[1] == [*MESSAGES, ('/odom', *more)]


def test_compressed_files_are_unpacked(run, capsys):
    write_bag(run, 'mcap', MESSAGES, CompressionMode.FILE)
    (run / 'metadata.yaml').unlink()
    assert saved(capsys, run)[1] == MESSAGES


# --- Damage with a name


@pytest.mark.parametrize(('name', 'compress'), [('lz4', lz4.frame.compress), ('zstd', zstd.compress)])
def test_cuts_in_a_compressed_chunk(run, tmp_path, capsys, name, compress):
    """As rosbag2 writes chunks: what comes before the cut can be unpacked, as far as whole blocks go."""
    messages = make_messages(400, 1900)
    data = write_without_metadata(run, messages=messages).read_bytes()
    head = next(start for opcode, start, _ in mcap_records(data) if opcode == Opcode.CHUNK)
    _, _, start, end, size, _, _, _ = struct.unpack_from('<BQQQQIIQ', data, head)
    content = data[head + 49 : head + 49 + size]
    packed = compress(content)
    chunk = struct.pack('<QQQII', start, end, size, zlib.crc32(content), len(name)) + name.encode()
    chunk += struct.pack('<Q', len(packed)) + packed
    for part in (0.7, 1.0):
        left = int(part * len(packed)) + len(chunk) - len(packed)
        broken = tmp_path / f'{part}.mcap'
        broken.write_bytes(data[:head] + struct.pack('<BQ', 6, len(chunk)) + chunk[:left])
        assert recover(capsys, broken, '-o', tmp_path / f'{part}')[0] == 0
        found = read_bag(tmp_path / f'{part}')
        assert found == messages[: len(found)]
        assert len(found) >= (part * size - 150_000) / 1500


# --- Journals


@pytest.mark.parametrize('given', ['run', 'run.journal.mcap'])
def test_a_journal(tmp_path, capsys, given):
    journal = write_journal(tmp_path / 'run', MESSAGES)
    edit(journal, lambda data: data.extend(b'M12'))
    before = contents(tmp_path)
    code, out, err = recover(capsys, tmp_path / given)
    assert (code, err) == (0, '')
    assert 'lost: run.journal.mcap: it is cut off: the last 3 of its ' in out
    assert read_bag(tmp_path / 'run') == MESSAGES
    assert contents(tmp_path) == before


def test_an_empty_journal_can_be_deleted(run, tmp_path, capsys):
    write_journal(run, [])
    code, out, err = recover(capsys, run)
    assert (code, out) == (1, '')
    assert 'the recording ended before one was received, so it can be deleted' in err
    assert os.listdir(tmp_path) == ['run.journal.mcap']


def test_losses_that_the_recorder_noted_are_reported(run, capsys):
    """They are in the custom data, and a bag with them is not one without losses."""
    write_records(
        run,
        Text('messages lost', '{"/odom": 12}'),
        channel(0, '/a', 'geometry_msgs/msg/Twist'),
        Message(0, START, b'\0\1\0\0' + bytes(48)),
        Text('messages lost', '{"/odom": 12, "/cmd_vel": 3}'),
    )
    code, out, _ = recover(capsys, run)
    assert code == 0
    assert 'lost: 3 messages on /cmd_vel while it was recorded\n' in out
    assert 'lost: 12 messages on /odom while it was recorded\n' in out
    assert 'no loss was found' not in out


def test_without_room_for_the_new_bag_the_journal_stays(run, tmp_path, capsys):
    write_journal(run, MESSAGES)
    before, limits = contents(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        code, out, err = recover(capsys, run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (code, out) == (1, '')
    assert err.startswith('recover_run: error: no bag was written: ')
    assert contents(tmp_path) == before
    assert recover(capsys, run)[0] == 0
    assert read_bag(run) == MESSAGES


# --- What is checked


def test_written_checksums(ours):
    """As the specification defines them."""
    data = (ours / 'run.mcap').read_bytes()
    places = {opcode: (start, end) for opcode, start, end in mcap_records(data)}
    chunk, _ = places[Opcode.CHUNK]
    size, checksum, _, length = struct.unpack_from('<QIIQ', data, chunk + 25)
    assert zlib.crc32(data[chunk + 49 : chunk + 49 + length]) == checksum
    assert size == length
    end, after = places[Opcode.DATA_END]
    assert struct.unpack_from('<I', data, after - 4) == (zlib.crc32(data[:end]),)
    footer, _ = places[Opcode.FOOTER]
    summary, _, checksum = struct.unpack_from('<QQI', data, footer + 9)
    assert summary == after
    assert checksum == zlib.crc32(data[summary : footer + 25])


def test_what_a_complete_bag_needs(ours, capsys):
    """Checksums of its chunks and counts, as `ros2 bag record` writes them."""
    file = ours / 'run.mcap'
    before = contents(ours)
    for what in (ours, file):
        code, out, err = recover(capsys, what)
        assert (code, out) == (1, '')
        assert f'{what} is complete: nothing to recover' in err
    assert contents(ours) == before
    end = next(end for opcode, _, end in mcap_records(file.read_bytes()) if opcode == Opcode.DATA_END)
    edit(file, lambda data: data.__setitem__(slice(end - 4, end), bytes(4)))
    assert recover(capsys, ours)[0] == 1
    footer = struct.pack('<BQQQI', Opcode.FOOTER, 20, 0, 0, 0)
    edit(file, lambda data: data.__setitem__(slice(end, None), footer + data[:8]))
    code, _, err = recover(capsys, ours)
    assert (code, 'it has no count of its messages' in err) == (3, True)


@pytest.mark.parametrize('storage', PLUGINS)
def test_a_bag_without_checksums_cannot_be_called_complete(run, capsys, storage):
    write_bag(run, storage, MESSAGES)
    for what in (run, data_file(run)):
        code, out, err = recover(capsys, what)
        assert (code, out) == (3, '')
        assert 'nothing was found missing' in err
        assert 'has no checksums' in err


@pytest.mark.parametrize(
    ('opcode', 'place', 'words'),
    [
        (Opcode.STATISTICS, 9 + 46 + 2, 'its statistics count '),
        (Opcode.STATISTICS, 9 + 46 + 2, 'the checksum of its summary is wrong'),
        (Opcode.METADATA, 30, 'the checksum of its data section is wrong'),
        (Opcode.CHUNK, 200, 'a chunk of '),
    ],
)
def test_one_byte_is_noticed(ours, capsys, opcode, place, words):
    def alter(data):
        data[next(start for one, start, _ in mcap_records(data) if one == opcode) + place] ^= 1

    edit(ours / 'run.mcap', alter)
    for what in (ours, ours / 'run.mcap'):
        _, out, err = recover(capsys, what, '-o', ours.parent / f'new{what.suffix}')
        assert f'lost: run.mcap: {words}' in out or words in err
    # Readers refuse the index: another name of a topic in it would hide the messages of that topic.
    if opcode == Opcode.STATISTICS:
        assert 'the checksum of its summary is wrong' in find_damage(ours / 'run.mcap')


def test_wrong_counts_are_noticed_without_checksums(run, tmp_path, capsys):
    write_bag(run, 'sqlite3', MESSAGES)
    with closing(sqlite3.connect(data_file(run))) as database, database:
        database.execute('UPDATE messages SET topic_id = 3 - topic_id WHERE id = 1')
    assert 'lost: metadata.yaml counts ' in saved(capsys, run)[0]
    (run / 'metadata.yaml').unlink()
    _, out, _ = recover(capsys, run, '-o', tmp_path / 'new')
    assert 'lost: the copy of metadata.yaml counts ' in out


# --- What is refused


def test_what_is_no_bag_or_cannot_be_written_is_refused(run, tmp_path, capsys):
    for name in ('other', 'others'):
        (tmp_path / name).mkdir()
    (tmp_path / 'other' / 'notes.txt').write_text('no bag')
    write_journal(tmp_path / 'others' / 'run', [])
    write_without_metadata(run)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*')}
    for arguments, words in (
        (['nothing'], 'nothing.journal.mcap'),
        (['others'], 'holds no files of a bag but journals (*.journal.mcap)'),
        (['other'], 'holds neither .mcap nor .db3 files'),
        (['run', '-o', tmp_path / 'other' / 'notes.txt' / 'new'], 'no bag was written'),
        (['run', '-o', tmp_path / 'other'], 'other exists already'),
    ):
        code, out, err = recover(capsys, tmp_path / arguments[0], *arguments[1:])
        assert (code, out) == (2, '')
        assert words in err
        assert len(err.splitlines()) == 1
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*')} == before


def test_topics_of_unknown_types_are_left_out(run, capsys):
    """The known ones are saved; the exit code reports that not all are."""
    file = write_without_metadata(run, 'sqlite3')
    with closing(sqlite3.connect(file)) as database, database:
        database.execute('DROP TABLE message_definitions')
        database.execute("UPDATE topics SET type = 'my_msgs/msg/Mine' WHERE name = '/cmd_vel'")
    before = contents(run)
    code, out, _ = recover(capsys, run)
    assert code == 1
    assert 'lost: /cmd_vel is left out: no installed package defines my_msgs/msg/Mine' in out
    assert read_bag(run.with_name('run_recovered')) == [one for one in MESSAGES if one[0] == '/odom']
    assert contents(run) == before
