"""One contract for all commands: help, version, errors, exit codes, bags, files, signals, closed output.

Each command is started once as a process of its own, as it is installed. Everything else runs in the
process of the test.
"""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
from pathlib import Path

import pytest
from fork_server import forked
from support.bags import REAL
from support.commands import COMMANDS, error_of, interrupted, refused, run, run_each
from support.processes import PROGRAM

from diffdrive_jacobian import __version__
from diffdrive_jacobian.parameters.declaration import specifications
from diffdrive_jacobian.tools import entry_points
from diffdrive_jacobian.tools.run_node import parameters_of

READERS = ('calibrate_run', 'plot_run', 'recover_run', 'replay_run', 'verify_run', 'watch_run')
FAILING = """
import sys, types
from diffdrive_jacobian.tools.entry_points import tools

def fail(*arguments):
    raise OSError('the disk is full')

for name in ('run_node', *tools()):
    module = types.ModuleType(name)
    module.main = module.run_node = fail
    sys.modules['diffdrive_jacobian.tools.' + name] = module
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where the commands work."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_commands_are_the_nodes_and_the_modules_with_a_main():
    listed = (Path(__file__).parents[2] / 'setup.py').read_text().split('COMMANDS = [')[1].split(']')[0]
    assert sorted(re.findall(r"'(\w+)'", listed)) == sorted(COMMANDS)
    assert set(COMMANDS) <= set(dir(entry_points))
    for name in ('nothing', '_cli', 'run_node', 'entry_points', '__init__'):
        with pytest.raises(AttributeError, match=f"has no attribute '{name}'"):
            entry_points.__getattr__(name)


@pytest.mark.parametrize('command', COMMANDS)
def test_help_version_and_wrong_arguments(command, folder):
    helped = run(command, '--help')
    assert (helped.code, helped.err) == (0, '')
    assert helped.out.startswith(f'usage: {command} ')
    if command in entry_points.NODES:
        lines = {line.strip() for line in helped.out.splitlines()}
        assert set(specifications(parameters_of(command))) <= lines
    version = f'{command} (diffdrive_jacobian) {__version__}\n'
    assert run(command, '--version') == (0, version, '')
    assert refused(command, '--bogus')
    assert not list(folder.iterdir())


@pytest.mark.process
def test_installed_commands_start():
    """As new processes, with their imports."""
    started = {
        command: subprocess.Popen(
            [Path(sysconfig.get_path('scripts'), command), '--bogus'],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command in COMMANDS
    }
    for command, process in started.items():
        out, err = process.communicate(timeout=60)
        assert (process.returncode, out) == (2, ''), command
        assert err.splitlines()[-1].startswith(f'{command}: error: ')


@pytest.mark.process
def test_an_error_of_the_system_names_the_command():
    for command, ended in zip(COMMANDS, run_each(zip(COMMANDS), FAILING), strict=True):
        assert ended == (1, '', f'{command}: error: the disk is full\n')


@pytest.mark.parametrize('command', READERS)
def test_what_is_no_bag_is_refused(command, folder):
    (folder / 'an empty folder').mkdir()
    (folder / 'a file').write_text('Dear')
    (folder / 'damaged').mkdir()
    (folder / 'damaged' / 'metadata.yaml').write_text('x')
    before = sorted(folder.rglob('*'))
    for bag in ('missing', 'an empty folder', 'a file', 'damaged'):
        ended = run(command, bag)
        assert ended.code == 2
        assert bag in error_of(command, ended)
    assert sorted(folder.rglob('*')) == before


@pytest.mark.parametrize(
    ('command', 'arguments', 'names'),
    [
        ('calibrate_run', (REAL, '-o', 'a.yaml'), ('a.yaml', 'a.png')),
        ('drive_to', (1, 1, '-o', 'a'), ('a', 'a.png')),
        ('plot_jacobian', ('wheel', '-o', 'a.png'), ('a.png',)),
        ('plot_run', (REAL, '-o', 'a.png', '--csv', 'a.csv'), ('a.png', 'a.csv')),
        ('record_run', ('-o', 'a'), ('a',)),
        ('recover_run', (REAL, '-o', 'a'), ('a',)),
        ('sweep_gains', ('-o', 'a.png', '--csv', 'a.csv'), ('a.png', 'a.csv')),
    ],
)
def test_nothing_is_overwritten(folder, command, arguments, names):
    for name in names:
        (folder / name).write_text('precious')
        ended = run(command, *arguments)
        assert ended.code != 0
        assert f'{name} exists already' in error_of(command, ended)
        assert (folder / name).read_text() == 'precious'
        (folder / name).unlink()
        if command == 'recover_run':
            continue
        # A link that leads nowhere would be followed.
        (folder / name).symlink_to('nowhere')
        assert f'{name} exists already' in error_of(command, run(command, *arguments))
        (folder / name).unlink()
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ('command', 'arguments'),
    [
        ('doctor', ()),
        ('drive_to', (1, 1, '--no-record')),
        ('plot_run', (REAL, '-o', 'a.png')),
        ('recover_run', (REAL, '-o', 'a')),
        ('replay_run', (REAL,)),
        ('send_goal', (1, 1)),
        ('send_path', ('circle:1',)),
        ('sweep_gains', ()),
        ('verify_run', (REAL,)),
    ],
)
def test_a_signal_interrupts_and_nothing_is_written(folder, command, arguments):
    assert run(command, *arguments, signals=interrupted()).code == 130
    assert not list(folder.iterdir())


@pytest.mark.process
@pytest.mark.parametrize(
    ('command', 'arguments', 'unbuffered'),
    [('verify_run', (REAL,), ''), ('plot_run', (REAL, '-o', 'a.png'), '1')],
)
def test_output_that_cannot_be_written(folder, command, arguments, unbuffered):
    """A full disk is an error; a reader that has enough, as `head`, is none that is reported."""
    read, closed = os.pipe()
    os.close(read)
    full = f'{command}: error: the standard output cannot be written: No space left on device\n'
    with open('/dev/full', 'w') as disk, open(closed, 'w') as pipe:
        for stdout, error in ((disk, full), (pipe, '')):
            ended = forked.run(
                PROGRAM.format(command),
                (*arguments, *(('--force',) if command == 'plot_run' else ())),
                env={**os.environ, 'PYTHONUNBUFFERED': unbuffered},
                stdout=stdout,
            )
            assert (ended.returncode, ended.stderr) == (1, error)
            assert [one.name for one in folder.iterdir()] == [*arguments[2:]]
