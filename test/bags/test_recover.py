"""The tool recover_run on bags without metadata, in parts, and on journals."""

from __future__ import annotations

import os
import shutil
import sqlite3
from itertools import product

import pytest
from rosbags.rosbag2 import CompressionMode
from support.bags import REAL as FOREIGN
from support.raw_bags import (
    PLUGINS,
    START,
    contents,
    make_messages,
    names_of,
    read_bag,
    recover,
    write_bag,
    write_journal,
)

from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.message_definitions import definition


@pytest.fixture
def messages():
    return make_messages(50, 300)


# --- Without metadata


@pytest.mark.parametrize(
    ('storage', 'mode'),
    # All that rosbags writes.
    [one for one in product(PLUGINS, CompressionMode) if one != ('sqlite3', CompressionMode.STORAGE)],
)
def test_a_bag_without_metadata(tmp_path, capsys, messages, storage, mode):
    path = tmp_path / 'run'
    write_bag(path, storage, messages, mode)
    expected = names_of(path) if mode in (CompressionMode.NONE, CompressionMode.STORAGE) else None
    (path / 'metadata.yaml').unlink()
    before = contents(path)
    code, out, err = recover(capsys, path)
    assert (code, err) == (0, '')
    recovered = tmp_path / 'run_recovered'
    assert out.splitlines()[0].startswith(f'{recovered} is written: 50 messages in 0.0 s')
    assert read_bag(recovered) == messages
    assert expected in (None, names_of(recovered))
    assert contents(path) == before


@pytest.mark.parametrize(
    'damage', ['', 'a: [', 'rosbag2_bagfile_information: 3', '- 1', '\0', 'x: !!y z']
)
def test_damaged_metadata(tmp_path, capsys, messages, damage):
    write_bag(tmp_path / 'run', 'mcap', messages)
    (tmp_path / 'run' / 'metadata.yaml').write_text(damage)
    assert recover(capsys, tmp_path / 'run')[0] == 0
    assert read_bag(tmp_path / 'run_recovered') == messages


@pytest.mark.parametrize('storage', PLUGINS)
def test_the_other_format_and_place(tmp_path, capsys, messages, storage):
    write_bag(tmp_path / 'run', storage, messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    (other,) = set(PLUGINS) - {storage}
    assert recover(capsys, tmp_path / 'run', '-o', tmp_path / 'new', '-s', other)[0] == 0
    assert read_bag(tmp_path / 'new') == messages
    assert (tmp_path / 'new' / ('new.mcap' if other == 'mcap' else 'new.db3')).exists()


def test_a_bag_of_ros2_bag_record(tmp_path, capsys):
    """Without metadata, and then cut off in the middle."""
    true = read_bag(FOREIGN)
    bag = tmp_path / 'run'
    bag.mkdir()
    file = bag / 'tb3_sqlite_0.db3'
    file.write_bytes((FOREIGN / file.name).read_bytes())
    assert recover(capsys, bag, '-o', tmp_path / 'whole')[0] == 0
    assert read_bag(tmp_path / 'whole') == true
    assert names_of(tmp_path / 'whole') == names_of(FOREIGN)
    os.truncate(file, 777_777)
    code, out, _ = recover(capsys, bag, '-s', 'mcap')
    assert code == 0
    assert 'lost: tb3_sqlite_0.db3: it is cut off: 365007 bytes are missing' in out
    found = read_bag(tmp_path / 'run_recovered')
    assert found == true[: len(found)]
    assert len(found) > 900


@pytest.mark.parametrize('storage', PLUGINS)
def test_a_bag_in_parts(tmp_path, capsys, storage):
    """As `ros2 bag record --max-bag-size` writes it; the last part has been cut off."""
    messages = make_messages(120, 300)
    bag = tmp_path / 'run'
    bag.mkdir()
    for part in range(12):
        write_bag(tmp_path / 'part', storage, messages[10 * part : 10 * part + 10])
        file = next(one for one in (tmp_path / 'part').iterdir() if one.suffix != '.yaml')
        data = file.read_bytes()
        (bag / f'run_{part}{file.suffix}').write_bytes(data if part < 11 else data[: len(data) // 2])
        shutil.rmtree(tmp_path / 'part')
    code, out, _ = recover(capsys, bag)
    assert code == 0
    assert f'lost: run_11.{"mcap" if storage == "mcap" else "db3"}' in out
    assert 'begins before' not in out
    found = read_bag(tmp_path / 'run_recovered')
    assert found[:110] == messages[:110]
    assert all(one in messages[110:] for one in found[110:])


def test_a_copy_of_a_file_is_reported(tmp_path, capsys, messages):
    """All of its messages are written twice."""
    write_bag(tmp_path / 'run', 'mcap', messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    shutil.copy(tmp_path / 'run' / 'run.mcap', tmp_path / 'run' / 'copy.mcap')
    code, out, _ = recover(capsys, tmp_path / 'run')
    assert code == 0
    assert f'{2 * len(messages)} messages' in out
    assert 'loss cannot be excluded: run.mcap begins before copy.mcap ends' in out


def test_a_part_that_is_missing(tmp_path, capsys, messages):
    write_bag(tmp_path / 'run', 'mcap', messages)
    metadata = tmp_path / 'run' / 'metadata.yaml'
    text = metadata.read_text().replace('message_count: 50', 'message_count: 70')
    metadata.write_text(text.replace('  - run.mcap', '  - run.mcap\n  - run_1.mcap'))
    code, out, _ = recover(capsys, tmp_path / 'run')
    assert code == 0
    assert 'lost: run_1.mcap is missing' in out
    assert 'lost: metadata.yaml counts 70 messages, 50 were found' in out


def test_a_write_ahead_log(tmp_path, capsys, messages):
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    file = tmp_path / 'run' / 'run.db3'
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    broken = tmp_path / 'broken'
    broken.mkdir()
    database = sqlite3.connect(file)
    database.execute('PRAGMA journal_mode=WAL')
    more = (START + 10**9, b'\0\1\0\0more of it')
    database.execute('INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)', more)
    database.commit()
    for path in (tmp_path / 'run').iterdir():
        shutil.copyfile(path, broken / path.name)
    database.close()
    before = contents(broken)
    assert recover(capsys, broken)[0] == 0
    assert read_bag(tmp_path / 'broken_recovered') == [*messages, ('/odom', *more)]
    assert contents(broken) == before


# --- The journal of record_run


@pytest.mark.parametrize('given', ['run', 'run.journal.mcap'])
@pytest.mark.parametrize('storage', PLUGINS)
def test_a_journal(tmp_path, capsys, messages, storage, given):
    journal = write_journal(tmp_path / 'run', messages, storage)
    with journal.open('ab') as file:
        file.write(b'M12')
    before = contents(tmp_path)
    code, out, err = recover(capsys, tmp_path / given)
    assert (code, err) == (0, '')
    assert 'lost: run.journal.mcap: it is cut off: the last 3 of its ' in out
    assert read_bag(tmp_path / 'run') == messages
    assert (tmp_path / 'run' / ('run.mcap' if storage == 'mcap' else 'run.db3')).exists()
    assert contents(tmp_path) == before


def test_an_empty_journal(tmp_path, capsys):
    write_journal(tmp_path / 'run', [])
    code, out, err = recover(capsys, tmp_path / 'run')
    assert (code, out) == (1, '')
    assert err == (
        f'recover_run: {tmp_path}/run.journal.mcap holds no message that can be saved: the recording '
        'ended before one was received, so it can be deleted\n'
    )
    assert os.listdir(tmp_path) == ['run.journal.mcap']


def test_losses_that_the_recorder_noted_are_reported(tmp_path, capsys):
    """They are in the custom data, and a bag with them is not one without losses."""
    writer = JournalWriter(tmp_path / 'run.journal.mcap')
    known = definition('geometry_msgs/msg/Twist')
    writer.add(Text('messages lost', '{"/odom": 12}'))
    writer.add(
        Channel(
            id=0,
            topic='/cmd_vel',
            type_name=known.name,
            definition=known.text,
            type_hash=known.type_hash,
        )
    )
    writer.add(Message(0, START, b'\0\1\0\0' + bytes(48)))
    writer.add(Text('messages lost', '{"/odom": 12, "/cmd_vel": 3}'))
    writer.flush()
    writer.close()
    code, out, _ = recover(capsys, tmp_path / 'run.journal.mcap')
    assert code == 0
    assert 'lost: 3 messages on /cmd_vel while it was recorded\n' in out
    assert 'lost: 12 messages on /odom while it was recorded\n' in out
    assert 'no loss was found' not in out
