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

"""Bags with invalid sizes, paths, YAML or names: an error, and nothing is executed or read elsewhere."""

from __future__ import annotations

import io
import os
import shutil
import struct
import zlib
from contextlib import suppress

import pytest
from hostile_bags import (
    MAGIC,
    chunk,
    mcap,
    message,
    record,
    text,
    topic_records,
    write_folder,
)
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import CompressionMode
from support.raw_bags import contents, data_file, make_messages, read_bag, recover, write_bag
from support.ros_messages import odometry

from diffdrive_jacobian.bags import BagError, NotABagError, read_run
from diffdrive_jacobian.bags import recover as write_recovered
from diffdrive_jacobian.bags.bag_reader import find_damage, open_bag
from diffdrive_jacobian.bags.corrected_reader import CorrectedReader
from diffdrive_jacobian.bags.salvage import read_mcap
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


# --- Memory


@pytest.mark.parametrize('indexed', [True, False])
@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
def test_a_chunk_that_claims_to_unpack_to_more_than_a_gigabyte(file, capsys, compression, indexed):
    packed, size = bytes(100), 1 << 40
    first, one = topic_records(), chunk(compression, packed, size)
    entry = (len(first), len(one), compression, len(packed), size)
    file.write_bytes(mcap(first + one, (entry,) if indexed else ()))
    refused = 'it claims to unpack to 1099.5 GB; at most 1.1 GB are read'
    assert refused in find_damage(file)
    code, _, err = recover(capsys, file)
    assert (code, refused in err) == (1, True)


@pytest.mark.parametrize('length', [1 << 40, (1 << 64) - 1])
def test_a_length_beyond_the_end_of_the_file_allocates_nothing(file, capsys, length):
    good = message(serialize_message(odometry(1.0, 0.0, 0.0)))
    end = mcap(b'')[-37:]
    for opcode in (3, 5, 6):
        body = topic_records() + good + struct.pack('<BQ', opcode, length) + bytes(20_000)
        file.write_bytes(mcap(body)[:-37] + end)
        with pytest.raises(BagError, match='is damaged'):
            read_run(file)
        code, out, _ = recover(capsys, file, '--force')
        assert code == 0
        assert 'lost: x.mcap: it is cut off' in out
        assert len(read_bag(file.with_name('x_recovered'))) == 1


@pytest.mark.parametrize('mode', CompressionMode)
def test_compressed_bags_are_read(run, mode):
    messages = make_messages(12, 20_000)
    write_bag(run, 'mcap', messages, mode)
    with CorrectedReader(run) as reader:
        assert [(one.topic, at, bytes(data)) for one, at, data in reader.messages()] == messages


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


# --- Paths


def test_paths_are_no_uris(run, tmp_path, capsys):
    """Of SQLite; of MCAP it is tested with recordings."""
    messages = make_messages(20, 300)
    path = tmp_path / 'a b&c#?x=1%41'
    # rosbags would write the data of such a bag elsewhere.
    write_bag(run, 'sqlite3', messages)
    data_file(run).rename(run / f'{path.name}.db3')
    metadata = run / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('run.db3', f"'{path.name}.db3'").replace("''", "'"))
    run.rename(path)
    for given in (path, path / f'{path.name}.db3'):
        with open_bag(given) as reader:
            assert [(one.topic, at, bytes(data)) for one, at, data in reader.messages()] == messages
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
        write_folder(run, listed, mode=mode)
        before = sorted(tmp_path.rglob('*'))
        with pytest.raises(BagError, match=name):
            read_run(run)
        assert recover(capsys, run)[0] in (1, 2)
        assert sorted(tmp_path.rglob('*')) == before
        assert (other / name).read_bytes() == GOOD


@pytest.mark.parametrize(
    ('make', 'storage'),
    [(os.mkfifo, 'mcap'), (lambda path: path.symlink_to('/dev/zero'), 'sqlite3'), (os.mkdir, 'mcap')],
    ids=['pipe', 'device', 'directory'],
)
def test_files_that_are_not_regular_are_not_read(run, tmp_path, make, storage):
    messages = make_messages(10, 50)
    write_bag(run, storage, messages)
    other = shutil.copytree(run, tmp_path / 'other')
    (run / 'metadata.yaml').unlink()
    make(run / 'metadata.yaml')
    with pytest.raises(BagError, match=r'metadata\.yaml.*(not a reg|Is a dir).*`recover_run'):
        read_run(run)
    recovery = write_recovered(run)
    assert recovery.lost[0] == 'metadata.yaml: metadata.yaml is not a regular file'
    assert read_bag(recovery.bag) == messages
    # As the only data file, and beside one that metadata.yaml does not list.
    file = data_file(other)
    file.unlink()
    make(file)
    with pytest.raises(BagError, match=f'{file.name}.*(not a reg|Is a dir)'):
        read_run(other)
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


@pytest.mark.parametrize(
    'tag',
    [
        '!!python/object/apply:os.system ["touch executed"]',
        '!!python/name:os.system',
        '!!js/function "touch"',
        '!<tag:example.com,2026:x> {a: 1}',
    ],
)
def test_nothing_in_yaml_is_executed(run, tmp_path, monkeypatch, capsys, tag):
    monkeypatch.chdir(tmp_path)
    write_folder(run, 'x.mcap', GOOD, more=f'  custom_data: {{key: {tag}}}\n')
    with suppress(BagError):
        assert len(read_run(run).odometry) == 1
    recover(capsys, run)
    (tmp_path / 'params.yaml').write_text(f'virtual_robot:\n  ros__parameters:\n    x: {tag}\n')
    with suppress(UserError, ValueError):
        robot_parameters('params.yaml')
    assert 'executed' not in os.listdir(tmp_path)


# --- Definitions, and what is printed


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


def test_a_count_of_a_topic_that_is_not_there_is_noticed():
    body = topic_records() + message(b'\0\1\0\0' + bytes(8))
    data = MAGIC + record(1, text('ros2') + text('test')) + chunk('', body, len(body), zlib.crc32(body))
    summary = len(data := data + record(15, bytes(4)))
    for counts, noticed in (
        ({1: 1}, []),
        ({1: 1, 2: 100}, ['its statistics count 101 messages, 1 wer']),
    ):
        pairs = b''.join(struct.pack('<HQ', *one) for one in counts.items())
        statistics = struct.pack('<QHIIIIQQ', sum(counts.values()), 1, 2, 0, 0, 1, 1, 1) + text(pairs)
        end = record(11, statistics) + record(2, struct.pack('<QQI', summary, 0, 0)) + MAGIC
        notes = []
        assert [*read_mcap(io.BytesIO(data + end), notes.append, lambda doubt: None)]
        assert [note[:40] for note in notes] == noticed
