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

"""One contract for all commands: help, version, errors, exit codes, bags, files, signals, closed output.

Each command is started once as a process of its own, as it is installed. Everything else runs in the
process of the test.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shlex
import subprocess
import sys
import sysconfig
from importlib.metadata import distribution
from pathlib import Path

import pytest
from support.bags import REAL
from support.commands import COMMANDS, error_of, interrupted, refused, run, run_each
from support.processes import PROGRAM, run_python

from diffdrive_jacobian import __version__
from diffdrive_jacobian.tools import _cli, entry_points
from diffdrive_jacobian.tools.run_node import parameters_of

READERS = ('calibrate_run', 'plot_run', 'recover_run', 'replay_run', 'verify_run', 'watch_run')
QUICK = ('--grid', 2, '--starts', 1, '--duration', 1, '--rate', 10)
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


AFTER = 'ROS arguments come after --ros-args'
WRONG = {
    'drive_to': {
        '': 'X Y',
        '1': 'got 1 of them',
        "'' 0": "''",
        'nan 0': 'X Y: must be finite, got nan',
        '1e308 0': 'X Y: must be in [-1e+06, 1e+06] m, got 1e+308',
        '1 1 --tolerance 0': '--tolerance: must be in [1e-06, 100], got 0.0',
        '1 1 --timeout -1e-3': '--timeout: must be positive and finite, got -0.001',
        '1 1 --params-file nowhere.yaml': "no such file: 'nowhere.yaml'",
        '1 1 --kp 2': 'unrecognized arguments: --kp 2 (kp is a ROS parameter: --ros-args -p kp:=2)',
        '1 1 --max-wheel-velocity=-5': '--ros-args -p max_wheel_velocity:=-5)',
        '1 1 --lock-step': 'unrecognized arguments: --lock-step (did you mean --lockstep?)',
        '1 1 --heading 90': "from -2 pi to 2 pi, got '90' (90 degrees",
        '1 1 -o x.png': "must name a bag, which is a directory, got 'x.png'",
        '1 1 -p kp:=1': AFTER,
        '1 1 --no-record --ros-args -p kp:=2.0 --open': 'come before --ros-args',
        '1 1 --no-record --lockstep --ros-args -p kp:=2.0 -o x': "unknown ROS arguments: ['-o', 'x']",
        '1 1 --no-record --lockstep --ros-args -p wheel_radius:=-1.0': "'wheel_radius' must be in [0",
        '1 1 --lockstep --open': '--lockstep and --open exclude each other',
        '1 1 --controller pid': "invalid choice: 'pid' (choose from '",
        '1 1 --robot r2d2': "must be one of 'create3', 'turtlebot3_burger', got",
        f'1 1 --robot create3 --params-file {shlex.quote(__file__)}': 'not allowed with argument',
        '1 1 --no-record -o run': '--output has no effect with --no-record',
        '1 1 --no-record --no-plot': '--no-plot has no effect with --no-record',
        '1 1 --force': '--force has no effect without --output',
        '--path circle:1 1 1': '--path excludes X Y and --heading',
        '1 1 --speed 0.3': '--speed has no effect without --path',
        '1 1 --trajectory 0.3': '--trajectory has no effect without --path',
        '1 1 --path-controller kanayama': '--path-controller has no effect without',
        '--path circle:1 --speed 0.3 --trajectory 0.3': '--speed has no effect with --trajectory',
        '1 1 --no-record --lockstep --ros-args -p Kp:=3.0': "parameter 'Kp'; did you mean 'kp'?",
        '--path poses.txt': 'the name of a .csv or .yaml file',
        '1 1 --no-browser': 'are options of --live',
        '--live --timeout 5': '--timeout has no effect with --live',
    },
    'go_to_goal': {
        '1 1': '1 1 (send_goal X Y sends a goal)',
        '--ros-args -p Kp:=3.0': "no node of this program has the parameter 'Kp'; did you mean 'kp'?",
        '--ros-args -p kp:=fast': "'kp' must be a double (as 1.0), got 'fast'",
        '--ros-args -p qos_overrides./odom.subscription.reliability:=often': 'often',
        '--ros-args --params-file malformed.yaml': 'malformed.yaml',
        '--ros-args -- --bogus': '--bogus',
    },
    'plot_run': {
        'run --topic odom=/a --topic odom=/b': '--topic can be given once for each name',
        'run --topic odom': 'NAME=TOPIC',
        'run --namespace a-b': 'must be a namespace',
    },
    'record_run': {
        '--force': '--force has no effect without --output',
        '--all -e odom': '--regex has no effect with --all',
        '\udcff': r"TOPIC: must be the name of a topic, got '\udcff'",
        'odom --all': 'TOPIC has no effect with --all',
    },
    'replay_run': {
        'run --timeout 1': '--timeout needs -w',
        'run --topics /a --namespace b': '--namespace has no effect with --topics',
        'run --loop --wait-for-all-acked 1': '--wait-for-all-acked has no effect with --loop',
        'run --start-paused': '--start-paused needs a terminal',
    },
    'send_goal': {
        '1 1 --heading 90': '--degrees accepts them',
        '1 1 --heading 400 --degrees': 'from -360 to 360 degrees',
        '1 1 --degrees': '--degrees needs --heading',
    },
    'send_path': {
        'circle:1 --no-wait --timeout 5': '--timeout has no effect with --no-wait',
        'circle:0': 'size of a shape must be in [0.001, 100000] m',
        'circle:1 --speed 0.3': 'path_speed of the controller, or that of --trajectory, got',
        'missing.csv': 'missing.csv: there is no such file',
        'square:1': 'path must be circle:RADIUS, line:LENGTH, eight:SIZE',
    },
    'sweep_gains': {
        '--kp -1e-3 2': 'kp must be in (0, 100], got -0.001',
        '--kp 3 2': 'kp must be MIN MAX with MIN < MAX, got (3.0, 2.0)',
        '--kp 2 2.0000000001': 'kp must have 59 different values',
        '--kp 1': 'two gains must be swept, got ranges of none',
        '--grid 2.5': "--grid: must be an integer from 2 to 1000000, got '2.5'",
        '--grid ٣': "--grid: must be an integer from 2 to 1000000, got '٣'",
        '--grid 1000': 'grid 1000 with 12 starts gives 12000000 closed loops; at most 1000000',
        '--duration 1e9': 'which may take an hour; choose a smaller grid',
        '--distance 0.01': 'distance must be larger than tolerance, 0.02 m, and less than',
        '--controller other': "controller must be one of '",
        '--controller offset_point --kp 1 2': 'unrecognized arguments: --kp',
        '--max-velocity 2000': "'linear.x.max_velocity' must be in [0, 1000]",
        '--max-yaw-rate 1e-9': 'limits must be at least 1e-06, got 1e-09',
        '--params-file other.yaml': 'it has none of virtual_robot, but of /go_to_goal',
        '--csv a.png': "the table must end in .csv, got 'a.png'",
        '--ros-args -p kp:=1': 'sweep_gains takes no ROS arguments',
    },
    'watch_run': {
        '--port 0': 'must be an integer from 1 to 65535, got 0',
        '--rate 2': '--rate needs a BAG',
        'bag --ros-args -p x:=1': 'a BAG needs no ROS arguments',
    },
    'wheel_bridge': {'--ros-args -p left_wheel_name:=right_wheel_joint': "'left_wheel_name' "},
}
"""Words of the message, by command and its arguments."""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where the commands work."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_are_no_other_commands():
    assert set(COMMANDS) <= set(dir(entry_points))
    for name in ('nothing', '_cli', 'run_node'):
        with pytest.raises(AttributeError, match=f"has no attribute '{name}'"):
            entry_points.__getattr__(name)


@pytest.mark.parametrize('command', COMMANDS)
def test_help_version_and_wrong_arguments(command, folder):
    helped = run(command, '--help')
    assert (helped.code, helped.err) == (0, '')
    assert helped.out.startswith(f'usage: {command} ')
    if command in entry_points.NODES:
        lines = {line.strip() for line in helped.out.splitlines()}
        assert set(parameters_of(command).declared()) <= lines
    version = f'{command} (diffdrive_jacobian) {__version__}\n'
    assert run(command, '--version') == (0, version, '')
    assert refused(command, '--bogus')
    files = {
        'malformed': 'go_to_goal: [1, 2\n  b: }',
        'other': 'go_to_goal: {ros__parameters: {kp: 1.0}}',
    }
    for name, content in files.items():
        (folder / f'{name}.yaml').write_text(content)
    for arguments, words in WRONG.get(command, {}).items():
        assert words in refused(command, *shlex.split(arguments)), arguments
    assert {one.name for one in folder.iterdir()} == {f'{name}.yaml' for name in files}


@pytest.mark.process
def test_installed_commands_start():
    """All have a script; one is started as a new process, with its imports."""
    installed = distribution('diffdrive_jacobian').entry_points.select(group='console_scripts')
    assert {one.name: one.value for one in installed} == {
        **{command: f'{entry_points.__name__}:{command}' for command in COMMANDS},
        # Others have a doctor, too.
        'diffdrive_doctor': f'{entry_points.__name__}:doctor',
    }
    scripts = [Path(sysconfig.get_path('scripts'), command) for command in COMMANDS]
    assert all(os.access(script, os.X_OK) for script in scripts)
    ended = subprocess.run(
        [scripts[COMMANDS.index('drive_to')], '--bogus'], capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout) == (2, '')
    assert ended.stderr.splitlines()[-1].startswith('drive_to: error: ')


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
    for one, other in ('ab', 'ba'):
        (folder / one).symlink_to(other)
    before = sorted(folder.rglob('*'))
    for bag in ('missing', 'an empty folder', 'a file', 'damaged', 'a'):
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
        assert f'{name} exists already' in refused(command, *arguments, code=2)
        assert (folder / name).read_text() == 'precious'
        (folder / name).unlink()
        if command == 'recover_run':
            # Nothing is missing in its bag, so nothing would be written.
            continue
        # A link that leads nowhere would be followed.
        (folder / name).symlink_to('nowhere')
        assert f'{name} exists already' in refused(command, *arguments, code=2)
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
@pytest.mark.parametrize('unbuffered', ['', '1'])
def test_output_that_cannot_be_written_is_an_error(unbuffered):
    with open('/dev/full', 'w') as disk:
        ended = verify(disk, unbuffered)
    words = 'verify_run: error: the standard output cannot be written: No space left on device\n'
    assert (ended.returncode, ended.stderr) == (1, words)


@pytest.mark.process
def test_a_reader_that_has_enough_is_no_error_that_is_reported():
    """As `head`."""
    read, closed = os.pipe()
    os.close(read)
    with open(closed, 'w') as pipe:
        ended = verify(pipe)
    assert (ended.returncode, ended.stderr) == (1, '')


def verify(stdout, unbuffered=''):
    """Run verify_run in a process of its own."""
    environment = {**os.environ, 'PYTHONUNBUFFERED': unbuffered}
    return run_python(PROGRAM.format('verify_run'), REAL, env=environment, stdout=stdout)


def test_a_file_that_cannot_be_finished_is_removed_and_does_not_keep_the_other(folder, monkeypatch):
    monkeypatch.setattr('diffdrive_jacobian.tools._output.drawn', lambda *_: b'picture')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))
    try:
        ended = run('sweep_gains', *QUICK, '-o', 'a.png', '--csv', 'a.csv')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (ended.code, ended.out.splitlines()[0]) == (1, 'a.png')
    assert ended.err == 'sweep_gains: error: a.csv cannot be written: File too large\n'
    assert [one.name for one in folder.iterdir()] == ['a.png']


@pytest.mark.parametrize(
    'command',
    [
        ('plot_run', REAL, '-o', 'a.png'),
        ('plot_jacobian', 'geometry'),
    ],
)
def test_without_matplotlib_the_remedy_is_reported(folder, monkeypatch, command):
    for name in [name for name in sys.modules if name.split('.')[0] == 'matplotlib']:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    message = refused(*command)
    assert "matplotlib is not installed: pip install 'diffdrive_jacobian[plot]'" in message
    assert not list(folder.iterdir())


# --- Types of arguments


def test_arguments_of_tool_and_ros_are_separated():
    ros = ['--ros-args', '-p', 'x:=-1', '-r', '__ns:=/a']
    for arguments, own, of_ros in (
        # Negative numbers are no options.
        (['-1e-1', '-.5', '-1E+3', '-inf'], [' -1e-1', ' -.5', ' -1E+3', ' -inf'], []),
        (['--tolerance', '-1', '--timeout=-1'], ['--tolerance', ' -1', '--timeout=-1'], []),
        (['-h', '--open', '-', '-1m'], ['-h', '--open', '-', '-1m'], []),
        ([*ros, '--', '1', *ros, '--', '-1'], ['1', ' -1'], [*ros, '--', *ros, '--']),
        (['1', '--', '-1'], ['1', '--', ' -1'], []),
        (['--ros-args', '--ros-args', '-1'], [], ['--ros-args', '--ros-args', '-1']),
    ):
        assert _cli.split_arguments(arguments) == (own, of_ros)


def test_values_of_arguments():
    parser = _cli.Parser(prog='x')
    parser.add_heading('heading')
    for arguments, expected in (
        ([], None),
        (['--heading', '-6.2'], -6.2),
        (['--heading', '90', '--degrees'], math.pi / 2),
        (['--degrees', '--heading', ' -360'], -math.tau),
    ):
        assert parser.given_heading(parser.parse_args(arguments)) == expected
    for text, expected in (('robot1', '/robot1'), ('/a/b/', '/a/b'), ('/', '/'), ('', '/')):
        assert _cli.namespace(text) == expected
    for name in ('run', 'run.2', 'runs.png/run', 'run_2026_01_01-10_00_00', '.png'):
        assert _cli.bag_folder(name) == name
    for kind, wrong in (
        (_cli.namespace, ('a b', '1a', 'a//b')),
        (_cli.bag_folder, ('run.png', 'run.svg/', 'a/run.PDF', 'run.yaml')),
    ):
        for text in wrong:
            with pytest.raises(argparse.ArgumentTypeError):
                kind(text)


def test_robots_stand_for_their_parameter_files():
    parser = _cli.Parser(prog='x')
    parser.add_params_file()
    files = sorted((Path(__file__).parents[2] / 'config').glob('*.yaml'))
    names = [file.stem for file in files]
    found = [Path(parser.parse_args(['--robot', name]).params_file).read_text() for name in names]
    assert found == [file.read_text() for file in files]
    assert f'of a robot: {", ".join(names)}' in ' '.join(parser.format_help().split())
