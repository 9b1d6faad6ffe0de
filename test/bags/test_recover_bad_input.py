"""recover_run on bad input: a clear line, an exit status that is not 0, and nothing lost."""

from __future__ import annotations

import os
import sqlite3

import pytest
from support.raw_bags import (
    PLUGINS,
    contents,
    make_messages,
    read_bag,
    recover,
    write_bag,
    write_journal,
)

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.recover_run import main


@pytest.fixture
def messages():
    return make_messages(50, 300)


def assert_refused(capsys, folder, arguments, code, *words):
    before = {path.name: contents(path) for path in folder.iterdir() if path.is_dir()}
    before[''] = contents(folder)
    found, out, err = recover(capsys, *arguments)
    assert (found, out) == (code, '')
    assert len(err.splitlines()) == 1
    for word in ('recover_run: ', *words):
        assert word in err
    after = {path.name: contents(path) for path in folder.iterdir() if path.is_dir()}
    after[''] = contents(folder)
    assert after == before


def test_what_is_no_bag(tmp_path, capsys):
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'notes.txt').write_text('no bag')
    (tmp_path / 'others').mkdir()
    write_journal(tmp_path / 'others' / 'run', [])
    for name, words in {
        'nothing': ('there is no bag', 'nothing.journal.mcap'),
        'others': ('holds no files of a bag but journals (*.journal.mcap)',),
        'empty': ('is an empty folder',),
        'other': ('holds neither .mcap nor .db3 files',),
        'other/notes.txt': ('is neither MCAP nor SQLite',),
    }.items():
        assert_refused(capsys, tmp_path, [tmp_path / name], 2, *words)


def test_a_journal_without_the_name_of_a_bag(tmp_path, capsys, messages):
    write_journal(tmp_path / 'run', messages).rename(tmp_path / '.journal.mcap')
    code, out, _ = recover(capsys, tmp_path / '.journal.mcap')
    assert code == 0
    assert '.journal_recovered is written' in out


@pytest.mark.parametrize('storage', PLUGINS)
def test_a_bag_without_damage_or_checksums(tmp_path, capsys, messages, storage):
    write_bag(tmp_path / 'run', storage, messages)
    file = next(one for one in (tmp_path / 'run').iterdir() if one.suffix != '.yaml')
    before = contents(tmp_path / 'run')
    for what in (tmp_path / 'run', file):
        code, out, err = recover(capsys, what)
        assert (code, out) == (3, '')
        assert 'nothing was found missing' in err
        assert 'has no checksums' in err
    assert contents(tmp_path / 'run') == before


def test_a_complete_bag(tmp_path, capsys, messages):
    recover(capsys, write_journal(tmp_path / 'run', messages))
    file = tmp_path / 'run' / 'run.mcap'
    for what in (tmp_path / 'run', file):
        assert_refused(capsys, tmp_path, [what], 1, f'{what} is complete: nothing to recover')


def test_output_that_exists(tmp_path, capsys, messages):
    write_bag(tmp_path / 'run', 'mcap', messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    (tmp_path / 'file').write_text('dear')
    (tmp_path / 'run_recovered').mkdir()
    for options in ((), ('-o', tmp_path / 'file')):
        assert_refused(capsys, tmp_path, [tmp_path / 'run', *options], 2, 'exists already')


def test_output_that_cannot_be_written(tmp_path, capsys, messages):
    write_bag(tmp_path / 'run', 'mcap', messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    (tmp_path / 'file').write_text('dear')
    # Nobody may make a directory there, not even root.
    for place in ('/sys/new', tmp_path / 'file' / 'new'):
        assert_refused(capsys, tmp_path, [tmp_path / 'run', '-o', place], 2, 'no bag was written')


def test_wrong_arguments(tmp_path, capsys):
    for arguments in ((), ('run', '-s', 'ros1'), ('run', '--nonsense')):
        code, out, err = recover(capsys, *arguments)
        assert (code, out) == (2, '')
        assert 'recover_run: error: ' in err


def test_unknown_types(tmp_path, capsys, messages):
    """The known ones are saved; the exit status tells that not all are."""
    write_bag(tmp_path / 'run', 'sqlite3', messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    with sqlite3.connect(tmp_path / 'run' / 'run.db3') as database:
        database.execute('DROP TABLE message_definitions')
        database.execute("UPDATE topics SET type = 'my_msgs/msg/Mine' WHERE name = '/cmd_vel'")
    database.close()
    before = contents(tmp_path / 'run')
    code, out, _ = recover(capsys, tmp_path / 'run')
    assert code == 1
    assert 'lost: /cmd_vel is left out: no installed package defines my_msgs/msg/Mine' in out
    assert read_bag(tmp_path / 'run_recovered') == [one for one in messages if one[0] == '/odom']
    assert contents(tmp_path / 'run') == before


def test_a_signal_leaves_no_bag(tmp_path, capsys, messages):
    write_bag(tmp_path / 'run', 'mcap', messages)
    (tmp_path / 'run' / 'metadata.yaml').unlink()
    signals = Signals()
    signals.count = 1
    assert main([str(tmp_path / 'run')], signals) == 130
    assert capsys.readouterr().err == 'recover_run: interrupted: no bag was written\n'
    assert os.listdir(tmp_path) == ['run']
