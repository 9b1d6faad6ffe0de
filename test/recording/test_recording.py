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

"""Recordings: complete whatever the path, however slow the disk, or else reported as partial."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import threading
import time
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from support.raw_bags import channel, read_journal

from diffdrive_jacobian import locks
from diffdrive_jacobian.bags import bag_reader, journal, recover
from diffdrive_jacobian.bags import bag_writer as building
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import (
    LEFT_OUT,
    Message,
    Text,
)
from diffdrive_jacobian.recording import recording as recordings
from diffdrive_jacobian.recording.recording import (
    LOST,
    MAX_LEFT_OUT,
    Recording,
    RecordingError,
)

pytestmark = pytest.mark.usefixtures('quick_disk')

PATIENCE = 20.0
NEVER = threading.Event()
CHANNEL = channel(8, '/cmd_vel', 'geometry_msgs/msg/Twist')


def messages(count, size=40):
    """Numbered messages."""
    head = b'\0\1\0\0'
    return [
        Message(CHANNEL.id, 1_000 + index, head + index.to_bytes(size, 'little'))
        for index in range(count)
    ]


def add(recording, *records):
    for record in records:
        recording.add(record)


def recorded(path, *records, **options):
    """Return a recording of these records of the topic /cmd_vel."""
    recording = Recording(path, **options)
    add(recording, CHANNEL, *records)
    return recording


def content(bag):
    """Return the messages of a bag in their order."""
    with open_bag(bag) as reader:
        return [data for _, _, data in bag_reader.messages(reader, reader.connections)]


def losses(bag, key=LOST):
    """Return the losses that a bag notes."""
    with open_bag(bag) as reader:
        return json.loads(bag_reader.custom_data(reader)[key])


def failed(recording, match):
    """Finish a recording, which must fail; return the error."""
    with pytest.raises(RecordingError, match=match) as caught:
        recording.finish()
    return caught.value


def until(condition, what):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f'not within {PATIENCE} s: {what}'
        # Let the thread that writes have its turn.
        NEVER.wait(0.001)


@pytest.fixture(autouse=True)
def short_periods(monkeypatch):
    """Write and sync the journal more often, so that nobody waits for that."""
    monkeypatch.setattr(recordings, 'FLUSH_PERIOD', 0.02)
    monkeypatch.setattr(recordings, 'SYNC_PERIOD', 0.02)


@pytest.fixture
def disk(monkeypatch):
    """A disk for journals that can be stopped, and can fail."""

    class Disk:
        def __init__(self):
            self.ready = threading.Event()
            self.ready.set()
            self.error = None
            self.writes = 0

    made, write = Disk(), os.write

    def slow(descriptor, data):
        if threading.current_thread().name != 'journal':
            return write(descriptor, data)
        made.writes += 1
        made.ready.wait(PATIENCE)
        if made.error is not None:
            raise OSError(made.error, os.strerror(made.error))
        return write(descriptor, data)

    monkeypatch.setattr(journal.os, 'write', slow)
    yield made
    made.ready.set()


# --- Paths


@pytest.mark.parametrize('name', ['run#2', 'run?mode=memory', 'run%41', 'file:x', ':memory:', "it's ü"])
def test_a_bag_can_have_any_path_also_behind_a_symbolic_link(tmp_path, monkeypatch, name):
    (tmp_path / 'link?').symlink_to('real#')
    (tmp_path / 'real#').mkdir()
    monkeypatch.chdir(tmp_path / 'link?')
    assert recorded(Path(name), *messages(3)).finish().messages == 3
    assert os.listdir(tmp_path / 'real#') == [name]
    assert sorted(os.listdir(name)) == sorted([f'{name}.mcap', 'metadata.yaml'])
    described = YAML(typ='safe').load(Path(name) / 'metadata.yaml')['rosbag2_bagfile_information']
    assert described['relative_file_paths'] == [f'{name}.mcap']
    assert content(tmp_path / 'real#' / name) == [one.data for one in messages(3)]


def test_a_name_that_no_bag_can_have_is_refused(tmp_path):
    with pytest.raises(OSError, match='must be UTF-8'):
        Recording(tmp_path / os.fsdecode(b'run\xff'))
    assert os.listdir(tmp_path) == []


def test_the_journal_stays_if_the_bag_reads_back_otherwise(tmp_path, monkeypatch):
    write = building.BagWriter.write
    skipped = messages(20)[7]

    def lossy(self, connection, stamp, data):
        write(self, connection, stamp, data[:-1] + b'!' if stamp == skipped.stamp else data)

    monkeypatch.setattr(building.BagWriter, 'write', lossy)
    recording = recorded(tmp_path / 'run', *messages(20))
    error = failed(recording, r'what was read back .* recover_run .*run\.journal\.mcap')
    assert error.summary is None
    assert os.listdir(tmp_path) == ['run.journal.mcap']


def test_the_journal_stays_if_it_was_altered_on_the_disk(tmp_path):
    recording = recorded(tmp_path / 'run', *messages(20))
    until(lambda: recording.journal.waiting == 0, 'all is written')
    path = journal_of(tmp_path / 'run')
    place = path.read_bytes().index(messages(20)[7].data)
    with open(path, 'r+b') as file:
        file.seek(place + 10)
        file.write(b'!')
    error = failed(recording, r'is damaged: its messages may be altered.* is kept')
    assert error.summary.messages == 20
    assert path.exists()


def test_the_journal_stays_if_the_bag_has_fewer_messages_than_were_recorded(tmp_path, monkeypatch):
    read, left_out = Recording._read, messages(20)[7]
    monkeypatch.setattr(Recording, '_read', lambda self: (one for one in read(self) if one != left_out))
    recording = recorded(tmp_path / 'run', *messages(20))
    error = failed(recording, r'20 messages were recorded, but .*run contains 19')
    assert error.summary.messages == 19
    assert journal_of(tmp_path / 'run').exists()


def test_a_folder_of_the_user_stays(tmp_path):
    (tmp_path / '.run.building').mkdir()
    (tmp_path / '.run.building' / 'thesis').write_text('precious')
    recording = recorded(tmp_path / 'run', *messages(1))
    recording.finish()
    # Nothing is recorded after the end.
    add(recording, *messages(1))
    assert recording.lost == {}
    assert (tmp_path / '.run.building' / 'thesis').read_text() == 'precious'
    assert sorted(os.listdir(tmp_path)) == ['.run.building', 'run']


# --- A slow disk


def busy(path, disk):
    """Return a recording whose thread waits for the disk, with one message."""
    recording = Recording(path)
    disk.ready.clear()
    add(recording, CHANNEL, *messages(1))
    until(lambda: disk.writes, 'the thread writes')
    return recording


def test_a_slow_disk_loses_nothing_and_gets_few_writes(tmp_path, disk):
    """Each write may take a second."""
    recording = busy(tmp_path / 'run', disk)
    # All of these are taken while one write lasts.
    add(recording, *messages(1_000))
    assert recording.lost == {}
    disk.ready.set()
    assert recording.finish().messages == 1_001
    assert len(content(tmp_path / 'run')) == 1_001
    assert disk.writes <= 4


@pytest.mark.parametrize('size', [2, 100_000])
def test_memory_is_bounded_and_what_is_dropped_is_counted(tmp_path, disk, monkeypatch, size):
    capacity = max(100_000, 10 * size)
    monkeypatch.setattr(recordings, 'CAPACITY', capacity)
    recording = busy(tmp_path / 'run', disk)
    count = 3 * capacity // (size + 300)
    for record in messages(count, size=size):
        recording.add(record)
        assert recording.journal.waiting <= capacity
    (dropped,) = recording.lost.values()
    assert dropped == count - 9 if size == 100_000 else 0 < dropped < count
    disk.ready.set()
    error = failed(recording, rf'{dropped} were received faster than the disk .*/cmd_vel {dropped}')
    summary = error.summary
    assert (summary.messages, summary.lost) == (1 + count - dropped, {'/cmd_vel': dropped})
    assert len(content(tmp_path / 'run')) == summary.messages
    assert losses(tmp_path / 'run') == {'/cmd_vel': dropped}
    assert os.listdir(tmp_path) == ['run']


def test_a_lossless_recording_waits_for_the_disk(tmp_path, disk, monkeypatch):
    monkeypatch.setattr(recordings, 'CAPACITY', 2_000)
    recording = Recording(tmp_path / 'run', lossless=True)
    add(recording, CHANNEL)
    disk.ready.clear()
    release = threading.Timer(0.05, disk.ready.set)
    release.start()
    add(recording, *messages(60))
    assert disk.ready.is_set()
    assert recording.finish().messages == 60


# --- Disks that fail, journals that go


@pytest.mark.parametrize('lossless', [True, False])
def test_a_full_disk_is_raised_by_finish(tmp_path, disk, lossless):
    recording = recorded(tmp_path / 'run', *messages(10), lossless=lossless)
    until(lambda: recording.journal.waiting == 0, 'these are written')
    disk.error = errno.ENOSPC
    add(recording, *messages(20))
    until(lambda: recording.error is not None, 'the thread notices')
    add(recording, *messages(5))
    error = failed(recording, 'aborted: No space left on device')
    assert str(error).endswith(f'{journal_of(tmp_path / "run")}. 25 messages are missing')
    summary = error.summary
    assert (summary.messages, summary.lost) == (10, {'/cmd_vel': 25})
    assert losses(tmp_path / 'run') == {'/cmd_vel': 25}
    assert journal_of(tmp_path / 'run').exists()


def test_finish_raises_if_the_bag_cannot_be_written(tmp_path):
    recording = recorded(tmp_path / 'run', *messages(10))
    (tmp_path / 'run').write_text('somebody else came first')
    error = failed(recording, r'run exists already.*recover_run .*run\.journal\.mcap')
    assert error.summary is None
    assert (tmp_path / 'run').read_text() == 'somebody else came first'


@pytest.mark.parametrize('change', ['replace', 'rename', 'remove the folder'])
def test_a_journal_that_goes_is_noticed(tmp_path, change):
    folder = tmp_path / 'runs'
    folder.mkdir()
    journal, elsewhere = journal_of(folder / 'run'), journal_of(folder / 'elsewhere')
    recording = recorded(folder / 'run', *messages(50))
    if change == 'remove the folder':
        shutil.rmtree(folder)
    else:
        journal.rename(elsewhere)
    if change == 'replace':
        journal.write_text('of somebody else')
    until(lambda: recording.error is not None, 'it is noticed')
    assert failed(recording, 'was removed, renamed or replaced').summary is None
    assert not (folder / 'run').exists()
    if change == 'replace':
        assert journal.read_text() == 'of somebody else'
    elif change == 'rename':
        recover(elsewhere)
        assert content(folder / 'elsewhere') == [one.data for one in messages(50)]


def test_losses_are_reported_also_after_a_crash(tmp_path):
    bag = tmp_path / 'run'
    recording = recorded(bag, *messages(3))
    recording.set_missed('/cmd_vel', 12)
    for number in range(MAX_LEFT_OUT + 5):
        recording.set_left_out(f'/topic_{number}', 'it has several types')

    def noted():
        records = read_journal(journal_of(bag))
        keys = {one.key for one in records if isinstance(one, Text)}
        # The messages are written after them.
        return {LOST, LEFT_OUT} <= keys and sum(isinstance(one, Message) for one in records) == 3

    until(noted, 'both are noted')
    shutil.copy(journal_of(bag), tmp_path / 'crashed.journal.mcap')
    error = failed(recording, '12 were not received .*; /topic_0 was not recorded: it has several')
    assert f'others was not recorded: more than {MAX_LEFT_OUT} topics' in str(error)
    assert error.summary.messages == 3
    assert losses(bag) == {'/cmd_vel': 12}
    assert losses(bag, LEFT_OUT)['/topic_0'] == 'it has several types'
    assert len(losses(bag, LEFT_OUT)) == MAX_LEFT_OUT + 1
    assert not journal_of(bag).exists()
    recovery = recover(tmp_path / 'crashed.journal.mcap')
    assert '/topic_0 was not recorded: it has several types' in recovery.lost_before


# --- File systems that lack something


def test_all_files_are_synchronized_before_the_bag_gets_its_name(tmp_path, monkeypatch):
    synced, rename = [], os.rename
    before: list[list[str]] = []
    monkeypatch.setattr(
        os, 'fsync', lambda descriptor: synced.append(os.readlink(f'/proc/self/fd/{descriptor}'))
    )
    monkeypatch.setattr(os, 'rename', lambda *paths: before.append(list(synced)) or rename(*paths))
    recording = recorded(tmp_path / 'run', *messages(3))
    until(lambda: str(journal_of(tmp_path / 'run')) in synced, 'the thread syncs the journal')
    recording.finish()
    assert len(before) == 1
    names = {Path(path).name for path in before[0] if Path(path).parent.name == 'run'}
    assert names == {path.name for path in (tmp_path / 'run').iterdir()}
    assert len(names) == 2


def test_discarding_keeps_a_file_of_another_process(tmp_path):
    recording, journal = Recording(tmp_path / 'run'), journal_of(tmp_path / 'run')
    journal.unlink()
    journal.write_text('of somebody else')
    recording.discard()
    assert journal.read_text() == 'of somebody else'


def test_a_file_system_may_lack_locks_and_syncs_of_directories(tmp_path, monkeypatch):
    fsync = os.fsync

    def refuse_directories(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(descriptor)

    def refuse(descriptor, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, 'fsync', refuse_directories)
    monkeypatch.setattr(locks.fcntl, 'flock', refuse)
    for code in (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP):
        bag = tmp_path / str(code)
        recording = recorded(bag, *messages(3))
        assert not journal.is_being_written(journal_of(bag))
        assert recording.finish().messages == 3
        assert not journal_of(bag).exists()
