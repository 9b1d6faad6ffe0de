"""Recordings: complete whatever the path, however slow the disk, or else reported as partial."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import stat
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from support.raw_bags import read_journal

from diffdrive_jacobian import bounded_yaml
from diffdrive_jacobian.bags import bag_reader, bounded_reader, journal, limits
from diffdrive_jacobian.bags import bag_writer as building
from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import (
    LEFT_OUT,
    PARAMETERS,
    Channel,
    Message,
    Text,
)
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.storage import BagWriter, StoragePlugin
from diffdrive_jacobian.recording import recording as recordings
from diffdrive_jacobian.recording.journal_thread import JournalThread
from diffdrive_jacobian.recording.recording import LOST, MAX_LEFT_OUT, Recording, RecordingError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.recover_run import main as recover_run

PATIENCE = 20.0
NEVER = threading.Event()
STORAGES = ('mcap', 'sqlite3')
STRANGE_NAMES = ('run#2', 'run?mode=memory', 'run%41', '%', 'file:x', ':memory:', 'a b', "it's", 'ü')


def channel(topic='/cmd_vel'):
    found = definition('geometry_msgs/msg/Twist')
    return Channel(
        id=len(topic),
        topic=topic,
        type_name=found.name,
        definition=found.text,
        type_hash=found.type_hash,
    )


def messages(count, size=40, topic='/cmd_vel'):
    """Numbered messages."""
    head = b'\0\1\0\0'
    return [
        Message(len(topic), 1_000 + index, head + index.to_bytes(size, 'little'))
        for index in range(count)
    ]


def add_all(recording, *records):
    for record in records:
        recording.add(record)


def content(bag):
    """The messages of a bag in their order."""
    reader = BoundedReader(bag)
    reader.open()
    try:
        return [bytes(data) for _, _, data in reader.messages(reader.connections)]
    finally:
        reader.close()


def custom_data(bag):
    reader = BoundedReader(bag)
    reader.open()
    try:
        return dict(reader.storage.metadata.custom)
    finally:
        reader.close()


def until(condition, what):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f'not within {PATIENCE} s: {what}'
        # Let the thread that writes have its turn.
        NEVER.wait(0.001)


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


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('name', STRANGE_NAMES)
@pytest.mark.parametrize('inside', [True, False])
def test_a_bag_can_have_any_path(tmp_path, monkeypatch, name, storage, inside):
    folder = tmp_path / name if inside else tmp_path
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    bag = Path('run' if inside else name)
    recording = Recording(bag, storage)
    add_all(recording, channel(), *messages(20))
    assert recording.finish().messages == 20
    assert os.listdir(folder) == [str(bag)]
    file = f'{bag}.{"mcap" if storage == "mcap" else "db3"}'
    assert sorted(os.listdir(bag)) == sorted([file, 'metadata.yaml'])
    described = YAML(typ='safe').load(bag / 'metadata.yaml')['rosbag2_bagfile_information']
    assert described['relative_file_paths'] == [file]
    assert content(bag) == [one.data for one in messages(20)]
    if storage == 'sqlite3':
        with sqlite3.connect(folder / bag / file) as database:
            assert database.execute('SELECT count(*) FROM messages').fetchone() == (20,)
        database.close()


@pytest.mark.parametrize('storage', STORAGES)
def test_a_bag_can_lie_behind_a_symbolic_link(tmp_path, storage):
    (tmp_path / 'real#').mkdir()
    (tmp_path / 'link?').symlink_to('real#')
    recording = Recording(tmp_path / 'link?' / 'run', storage)
    add_all(recording, channel(), *messages(3))
    recording.finish()
    assert len(content(tmp_path / 'real#' / 'run')) == 3


def test_names_that_no_bag_can_have_are_refused_before_recording(tmp_path):
    (tmp_path / 'dangling').symlink_to('nowhere')
    with pytest.raises(FileExistsError):
        Recording(tmp_path / 'dangling', 'mcap')
    with pytest.raises(OSError, match='must be UTF-8'):
        Recording(tmp_path / os.fsdecode(b'run\xff'), 'mcap')
    assert os.listdir(tmp_path) == ['dangling']


@pytest.mark.parametrize('storage', STORAGES)
def test_the_journal_stays_if_the_bag_reads_back_otherwise(tmp_path, monkeypatch, storage):
    write = building.BagWriter.write
    skipped = messages(20)[7]

    def lossy(self, connection, stamp, data):
        write(self, connection, stamp, data[:-1] + b'!' if stamp == skipped.stamp else data)

    monkeypatch.setattr(building.BagWriter, 'write', lossy)
    recording = Recording(tmp_path / 'run', storage)
    add_all(recording, channel(), *messages(20))
    with pytest.raises(
        RecordingError, match=r'what was read back .* recover_run .*run\.journal\.mcap'
    ) as caught:
        recording.finish()
    assert caught.value.summary is None
    assert os.listdir(tmp_path) == ['run.journal.mcap']


def test_the_journal_stays_if_it_was_altered_on_the_disk(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(20))
    until(lambda: recording.journal.waiting == 0, 'all is written')
    path = journal_of(tmp_path / 'run')
    place = path.read_bytes().index(messages(20)[7].data)
    with open(path, 'r+b') as file:
        file.seek(place + 10)
        file.write(b'!')
    with pytest.raises(
        RecordingError, match=r'is damaged: its messages may be altered.* is kept'
    ) as caught:
        recording.finish()
    assert caught.value.summary.messages == 20
    assert path.exists()


def test_a_folder_of_the_user_stays(tmp_path):
    (tmp_path / '.run.building').mkdir()
    (tmp_path / '.run.building' / 'thesis').write_text('precious')
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(1))
    recording.finish()
    assert (tmp_path / '.run.building' / 'thesis').read_text() == 'precious'
    assert sorted(os.listdir(tmp_path)) == ['.run.building', 'run']


# --- A slow disk


def test_a_slow_disk_loses_no_message_and_delays_no_caller(tmp_path, disk):
    recording = Recording(tmp_path / 'run', 'mcap')
    disk.ready.clear()
    add_all(recording, channel(), *messages(1))
    until(lambda: disk.writes, 'the thread writes')
    # All of these are taken while one write lasts.
    add_all(recording, *messages(5_000))
    assert recording.lost == {}
    disk.ready.set()
    assert recording.finish().messages == 5_001
    assert len(content(tmp_path / 'run')) == 5_001


def test_many_small_messages_are_few_writes(tmp_path, disk):
    """Each may take a second, on a disk that is slow."""
    recording = Recording(tmp_path / 'run', 'mcap')
    disk.ready.clear()
    add_all(recording, channel(), *messages(1))
    until(lambda: disk.writes, 'the thread writes')
    add_all(recording, *messages(20_000))
    disk.ready.set()
    recording.finish()
    assert disk.writes <= 4


def test_memory_is_bounded_by_bytes_and_what_is_dropped_is_counted(tmp_path, disk):
    recording = Recording(tmp_path / 'run', 'mcap', capacity=10_000_000)
    disk.ready.clear()
    add_all(recording, channel(), *messages(1))
    until(lambda: disk.writes, 'the thread writes')
    for record in messages(30, size=1_000_000):
        recording.add(record)
        assert recording.journal.waiting <= 10_000_000
    assert recording.lost == {'/cmd_vel': 21}
    disk.ready.set()
    with pytest.raises(
        RecordingError, match=r'21 were received faster than the disk .*/cmd_vel 21'
    ) as caught:
        recording.finish()
    summary = caught.value.summary
    assert (summary.messages, summary.lost) == (10, {'/cmd_vel': 21})
    assert len(content(tmp_path / 'run')) == 10
    assert json.loads(custom_data(tmp_path / 'run')[LOST]) == {'/cmd_vel': 21}
    assert os.listdir(tmp_path) == ['run']


def test_small_messages_are_bounded_too(tmp_path, disk):
    recording = Recording(tmp_path / 'run', 'mcap', capacity=100_000)
    disk.ready.clear()
    add_all(recording, channel(), *messages(1))
    until(lambda: disk.writes, 'the thread writes')
    add_all(recording, *messages(1_000, size=2))
    assert recording.lost['/cmd_vel'] > 500
    disk.ready.set()
    with pytest.raises(RecordingError) as caught:
        recording.finish()
    assert caught.value.summary.messages + caught.value.summary.lost['/cmd_vel'] == 1_001


def test_a_message_larger_than_the_memory_is_taken_alone(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap', capacity=1_000)
    add_all(recording, channel())
    until(lambda: recording.journal.waiting == 0, 'all is written')
    add_all(recording, *messages(1, size=100_000))
    assert recording.finish().messages == 1


def test_a_lossless_recording_waits_for_the_disk(tmp_path, disk):
    recording = Recording(tmp_path / 'run', 'mcap', lossless=True, capacity=2_000)
    add_all(recording, channel())
    disk.ready.clear()
    release = threading.Timer(0.2, disk.ready.set)
    release.start()
    add_all(recording, *messages(500))
    assert disk.ready.is_set()
    assert recording.finish().messages == 500


def test_losses_are_in_the_journal_while_it_is_recorded(tmp_path):
    """A crash must not make them unknown."""
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(1))
    recording.set_missed('/cmd_vel', 12)
    path = journal_of(tmp_path / 'run')
    until(lambda: LOST.encode() in path.read_bytes(), 'they are noted')
    with pytest.raises(RecordingError, match='12 were not received by the recorder'):
        recording.finish()
    assert json.loads(custom_data(tmp_path / 'run')[LOST]) == {'/cmd_vel': 12}


def test_records_are_written_without_anybody_asking(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(1))
    until(
        lambda: any(isinstance(one, Message) for one in read_journal(recording.journal.path)), 'written'
    )
    recording.discard()
    assert os.listdir(tmp_path) == []


def test_nothing_is_recorded_after_the_end(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(1))
    recording.finish()
    add_all(recording, *messages(1))
    assert recording.lost == {}


# --- Disks that fail, journals that go


def test_a_database_that_cannot_be_created_is_closed(tmp_path, monkeypatch):
    opened = []

    class Connection(sqlite3.Connection):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            opened.append(self)

        def executescript(self, _):
            raise sqlite3.OperationalError('disk I/O error')

    monkeypatch.setattr(sqlite3, 'connect', Connection)
    writer = BagWriter(tmp_path / 'run', version=9, storage_plugin=StoragePlugin.SQLITE3)
    with pytest.raises(sqlite3.OperationalError, match='disk'):
        writer.open()
    with pytest.raises(sqlite3.ProgrammingError, match='closed'):
        opened[0].execute('SELECT 1')


@pytest.mark.parametrize('lossless', [True, False])
def test_a_full_disk_is_raised_by_finish(tmp_path, disk, lossless):
    recording = Recording(tmp_path / 'run', 'mcap', lossless=lossless)
    add_all(recording, channel(), *messages(10))
    until(lambda: recording.journal.waiting == 0, 'these are written')
    disk.error = errno.ENOSPC
    add_all(recording, *messages(20))
    until(lambda: recording.error is not None, 'the thread notices')
    add_all(recording, *messages(5))
    with pytest.raises(RecordingError, match='aborted: No space left on device') as caught:
        recording.finish()
    assert str(caught.value).endswith(f'{journal_of(tmp_path / "run")}. 25 messages are missing')
    summary = caught.value.summary
    assert (summary.messages, summary.lost) == (10, {'/cmd_vel': 25})
    assert json.loads(custom_data(tmp_path / 'run')[LOST]) == {'/cmd_vel': 25}
    assert journal_of(tmp_path / 'run').exists()


def test_finish_raises_if_the_bag_cannot_be_written(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(10))
    (tmp_path / 'run').write_text('somebody else came first')
    with pytest.raises(
        RecordingError, match=r'run exists already.*recover_run .*run\.journal\.mcap'
    ) as caught:
        recording.finish()
    assert caught.value.summary is None
    assert (tmp_path / 'run').read_text() == 'somebody else came first'


def _remove(folder):
    journal_of(folder / 'run').unlink()


def _replace(folder):
    _remove(folder)
    journal_of(folder / 'run').write_text('of somebody else')


def _rename(folder):
    journal_of(folder / 'run').rename(folder / 'elsewhere.journal.mcap')


def _remove_folder(folder):
    shutil.rmtree(folder)


def _rename_folder(folder):
    folder.rename(folder.with_name('other'))


@pytest.mark.parametrize('change', [_remove, _replace, _rename, _remove_folder, _rename_folder])
def test_a_journal_that_goes_is_noticed_and_saved(tmp_path, capsys, change):
    folder = tmp_path / 'runs'
    folder.mkdir()
    recording = Recording(folder / 'run', 'mcap')
    add_all(recording, channel(), *messages(50))
    change(folder)
    until(lambda: recording.error is not None, 'it is noticed')
    with pytest.raises(RecordingError, match='was removed, renamed or replaced') as caught:
        recording.finish()
    assert caught.value.summary is None
    saved = str(caught.value).split('The recorded messages are in ')[1].split(': recover_run')[0]
    assert recover_run([saved, '-o', str(tmp_path / 'new')], Signals()) == 0
    assert content(tmp_path / 'new') == [one.data for one in messages(50)]
    if change is _replace:
        assert journal_of(folder / 'run').read_text() == 'of somebody else'


def test_a_journal_that_went_and_cannot_be_saved_is_reported(tmp_path, monkeypatch):
    recording = Recording(tmp_path / 'run', 'mcap')
    _remove(tmp_path)
    until(lambda: recording.error is not None, 'it is noticed')

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recording.journal, 'rescue', full)
    with pytest.raises(RecordingError, match=r'content cannot be saved: .*No space left'):
        recording.finish()


def test_discarding_keeps_a_file_of_another_process(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    _replace(tmp_path)
    recording.discard()
    assert journal_of(tmp_path / 'run').read_text() == 'of somebody else'


def test_the_thread_syncs(tmp_path, monkeypatch):
    synced, sync = [], os.fsync
    monkeypatch.setattr(journal.os, 'fsync', lambda descriptor: synced.append(sync(descriptor)))
    writer = journal.JournalWriter(tmp_path / 'x.journal.mcap')
    thread = JournalThread(writer)
    thread.add(channel())
    until(lambda: synced, 'it is synced')
    thread.close()
    writer.close()


def test_a_topic_that_is_left_out_is_reported_and_noted(tmp_path):
    bag = tmp_path / 'run'
    recording = Recording(bag, 'mcap')
    add_all(recording, channel(), *messages(3))
    recording.set_left_out('/odom', 'it has several types')
    with pytest.raises(RecordingError, match='/odom was not recorded: it has several types') as caught:
        recording.finish()
    assert caught.value.summary.messages == 3
    assert json.loads(custom_data(bag)[LEFT_OUT]) == {'/odom': 'it has several types'}
    assert not journal_of(bag).exists()


def test_of_many_topics_that_are_left_out_some_are_noted(tmp_path):
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(3))
    for number in range(MAX_LEFT_OUT + 5):
        recording.set_left_out(f'/topic_{number}', 'it has several types')
    with pytest.raises(
        RecordingError, match=f'others was not recorded: more than {MAX_LEFT_OUT} topics'
    ):
        recording.finish()
    assert len(json.loads(custom_data(tmp_path / 'run')[LEFT_OUT])) == MAX_LEFT_OUT + 1


def test_a_topic_that_is_left_out_is_reported_after_a_crash(tmp_path, capsys):
    bag = tmp_path / 'run'
    recording = Recording(bag, 'mcap')
    add_all(recording, channel(), *messages(3))
    recording.set_left_out('/odom', 'it has several types')
    noted = journal_of(bag)
    until(
        lambda: any(isinstance(one, Text) and one.key == LEFT_OUT for one in read_journal(noted)),
        'noted',
    )
    shutil.copy(noted, tmp_path / 'crashed.journal.mcap')
    recording.discard()
    recover_run([str(tmp_path / 'crashed.journal.mcap')], Signals())
    assert 'lost: /odom was not recorded: it has several types' in capsys.readouterr().out


# --- What readers would refuse


@pytest.mark.parametrize('storage', STORAGES)
def test_custom_data_that_readers_would_refuse_stays_in_the_journal(
    tmp_path, monkeypatch, storage, capsys
):
    for module in (bounded_yaml, building):
        monkeypatch.setattr(module, 'MAX_SIZE', 60_000, raising=False)
    recording = Recording(tmp_path / 'run', storage)
    large = {
        f'{PARAMETERS}/robot_{index}': json.dumps({'text': "it's " * 2_000 * (index + 1)})
        for index in range(4)
    }
    add_all(recording, channel(), *messages(3), *(Text(*one) for one in large.items()))
    with pytest.raises(
        RecordingError, match=r'robot_3.*too large.*run\.journal\.mcap is kept'
    ) as caught:
        recording.finish()
    assert caught.value.summary.messages == 3
    with open_bag(tmp_path / 'run') as reader:
        kept = bag_reader.custom_data(reader)
        assert len(list(bag_reader.messages(reader, reader.connections))) == 3
    assert kept['storage'] == storage
    assert f'{PARAMETERS}/robot_0' in kept
    assert len(large) > sum(key in kept for key in large)
    arguments = [str(journal_of(tmp_path / 'run')), '-o', str(tmp_path / 'again')]
    assert recover_run(arguments, Signals()) == 1
    assert 'robot_3: metadata.yaml would be too large' in capsys.readouterr().out


@pytest.mark.parametrize('storage', STORAGES)
def test_a_message_that_readers_would_refuse_stays_in_the_journal(
    tmp_path, monkeypatch, storage, capsys
):
    for module in (bounded_reader, limits):
        monkeypatch.setattr(module, 'MAX_RECORD', 5_000_000)
    for module in (building, recordings):
        monkeypatch.setattr(module, 'MAX_MESSAGE', 3_000_000)
    monkeypatch.setattr(journal, 'BLOCK', 1_000_000)
    recording = Recording(tmp_path / 'run', storage)
    add_all(
        recording,
        channel(),
        *messages(1),
        *messages(1, size=4_000_000),
        *messages(1, size=6_000_000),
        *messages(1),
    )
    with pytest.raises(RecordingError, match=r'/cmd_vel: 2 messages larger than 3\.0 MB') as caught:
        recording.finish()
    summary = caught.value.summary
    assert (summary.messages, summary.lost) == (2, {'/cmd_vel': 2})
    assert json.loads(custom_data(tmp_path / 'run')[LOST]) == {'/cmd_vel': 2}
    with open_bag(tmp_path / 'run') as reader:
        assert len(list(bag_reader.messages(reader, reader.connections))) == 2
    arguments = [str(journal_of(tmp_path / 'run')), '-o', str(tmp_path / 'again')]
    assert recover_run(arguments, Signals()) == 1
    out = capsys.readouterr().out
    assert '/cmd_vel: 1 messages larger than 3.0 MB' in out
    assert 'it unpacks to 6.0 MB; at most 5.0 MB are read' in out


@pytest.mark.parametrize('storage', STORAGES)
def test_more_than_the_readers_unpack_at_once_can_be_recorded_at_one_time(
    tmp_path, monkeypatch, storage
):
    monkeypatch.setattr(bounded_reader, 'MAX_OVERLAP', 4_000_000)
    recording = Recording(tmp_path / 'run', storage)
    records = [replace(one, stamp=7) for one in messages(12, size=1_000_000)]
    add_all(recording, channel(), *records)
    assert recording.finish().messages == 12
    with open_bag(tmp_path / 'run') as reader:
        found = [data for _, _, data in bag_reader.messages(reader, reader.connections)]
    assert found == [one.data for one in records]


# --- File systems that lack something


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_all_files_are_synchronized_before_the_bag_gets_its_name(tmp_path, monkeypatch, storage):
    synced, rename = [], os.rename
    before: list[list[str]] = []
    monkeypatch.setattr(
        os, 'fsync', lambda descriptor: synced.append(os.readlink(f'/proc/self/fd/{descriptor}'))
    )
    monkeypatch.setattr(os, 'rename', lambda *paths: before.append(list(synced)) or rename(*paths))
    recording = Recording(tmp_path / 'run', storage)
    add_all(recording, channel(), *messages(3))
    recording.finish()
    assert len(before) == 1
    names = {Path(path).name for path in before[0] if Path(path).parent.name == 'run'}
    assert names == {path.name for path in (tmp_path / 'run').iterdir()}
    assert len(names) == 2


def test_a_directory_that_cannot_be_synchronized_does_not_matter(tmp_path, monkeypatch):
    fsync = os.fsync

    def refuse_directories(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(descriptor)

    monkeypatch.setattr(os, 'fsync', refuse_directories)
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(3))
    assert recording.finish().messages == 3
    assert os.listdir(tmp_path) == ['run']


@pytest.mark.parametrize('code', [errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP])
def test_a_file_system_without_locks_is_recorded_to(tmp_path, monkeypatch, code):
    def refuse(descriptor, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(journal.fcntl, 'flock', refuse)
    recording = Recording(tmp_path / 'run', 'mcap')
    add_all(recording, channel(), *messages(3))
    assert not journal.is_being_written(journal_of(tmp_path / 'run'))
    assert recording.finish().messages == 3
    assert os.listdir(tmp_path) == ['run']


def nested(folder, length):
    """Create a directory whose path has this length (bytes)."""
    while (missing := length - len(os.fsencode(folder)) - 1) > 0:
        # Not a name that leaves just the separator of the next one.
        folder = folder / ('d' * (missing if missing <= 100 else 98))
    folder.mkdir(parents=True)
    return folder


def test_a_path_too_long_for_sqlite_is_refused_before_recording(tmp_path):
    # Below it: .run.building-xxxxxxxx/run/run.db3
    longest = 504 - len('/.run.building-xxxxxxxx/run/run.db3')
    fits = nested(tmp_path / 'fits', longest)
    recording = Recording(fits / 'run', 'sqlite3')
    add_all(recording, channel(), *messages(3))
    assert recording.finish().messages == 3
    too_long = nested(tmp_path / 'long', longest + 1)
    with pytest.raises(OSError, match='too long for SQLite: at most 504 bytes, got 505'):
        Recording(too_long / 'run', 'sqlite3')
    assert os.listdir(too_long) == []
    Recording(too_long / 'run', 'mcap').discard()
