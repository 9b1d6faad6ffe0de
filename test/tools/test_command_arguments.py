"""Arguments of the commands: what is refused, with which hint, and how they are separated from ROS's."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path

import pytest
from support.commands import refused

from diffdrive_jacobian.tools import _cli

AFTER = 'ROS arguments come after --ros-args'
WRONG = {
    'drive_to': {
        '': 'X Y',
        '1': 'got 1 of them',
        '1 2 3': 'got 3 of them',
        'one two': "'one'",
        "'' 0": "''",
        'nan 0': 'X Y: must be finite, got nan',
        '0 -inf': 'X Y: must be finite, got -inf',
        '1e308 0': 'X Y: must be in [-1e+06, 1e+06] m, got 1e+308',
        '1 1 --tolerance 0': '--tolerance: must be in [1e-06, 100], got 0.0',
        '1 1 --tolerance abc': "--tolerance: must be a number, got 'abc'",
        '1 1 --timeout -1e-3': '--timeout: must be positive and finite, got -0.001',
        '1 1 --timeout inf': '--timeout: must be finite, got inf',
        '1 1 --params-file nowhere.yaml': "no such file: 'nowhere.yaml'",
        '1 1 --kp 2': 'unrecognized arguments: --kp 2 (kp is a ROS parameter: --ros-args -p kp:=2)',
        '1 1 --max-wheel-velocity=-5': '--ros-args -p max_wheel_velocity:=-5)',
        '1 1 --kp': '--ros-args -p kp:=VALUE)',
        '1 1 --lock-step': 'unrecognized arguments: --lock-step (did you mean --lockstep?)',
        '1 1 --heading nan': 'argument --heading: must be finite, got nan',
        '1 1 --heading 90': "from -2 pi to 2 pi, got '90' (90 degrees",
        '1 1 --heading -180': '(-180 degrees are -3.14159 rad)',
        '1 1 --heading 400 --degrees': 'from -360 to 360 degrees',
        '1 1 --degrees': '--degrees needs --heading',
        '1 1 -o x.png': "must name a bag, which is a directory, got 'x.png'",
        '1 1 -o runs/x.CSV': "did you mean 'runs/x'?",
        '1 1 -p kp:=1': AFTER,
        '1 1 kp:=1': AFTER,
        '1 1 --no-record --ros-args -p kp:=2.0 --open': 'come before --ros-args',
        '1 1 --no-record --lockstep --ros-args -p kp:=2.0 -o x': "unknown ROS arguments: ['-o', 'x']",
        '1 1 --no-record --lockstep --ros-args -p wheel_radius:=-1.0': "'wheel_radius' must be in [0",
        '1 1 --lockstep --open': '--lockstep and --open exclude each other',
        '1 1 --controller pid': "'go_to_goal', 'offset_point', 'pose'",
        '1 1 --robot r2d2': "must be one of 'create3', 'turtlebot3_burger', got",
        f'1 1 --robot create3 --params-file {shlex.quote(__file__)}': 'not allowed with argument',
        '1 1 --no-record -o run': '--output has no effect with --no-record',
        '1 1 --no-record --force': '--force has no effect with --no-record',
        '1 1 --force': '--force has no effect without --output',
        '--path circle:1 1 1': '--path excludes X Y and --heading',
        '--path circle:1 --heading 1': '--path excludes X Y and --heading',
        '1 1 --speed 0.3': '--speed has no effect without --path',
        '1 1 --path-controller kanayama': '--path-controller has no effect without',
        '--path circle:1 --path-controller mine': 'kanayama',
        '--path poses.txt': 'the name of a .csv or .yaml file',
        '1 1 --no-browser': 'are options of --live',
        '1 1 --port 8000': 'are options of --live',
        '1 1 --live --lockstep --open': 'exclude each other',
        '--live --timeout 5': '--timeout has no effect with --live',
    },
    'go_to_goal': {
        '1 1': '1 1 (send_goal X Y sends a goal)',
        '-1 1': '-1 1 (send_goal X Y sends a goal)',
        '--kp 2': '--kp 2 (kp is a ROS parameter: --ros-args -p kp:=2)',
        '--robott create3': '--robott create3 (did you mean --robot?)',
    },
    'plot_run': {
        'run --topic odom=/a --topic odom=/b': '--topic can be given once for each name',
        'run --topic odom': 'NAME=TOPIC',
        'run --topic odom=': 'NAME=TOPIC',
        'run --topic =/x': 'NAME=TOPIC',
        'run --topic speed=/x': 'NAME=TOPIC',
        'run --namespace a-b': 'must be a namespace',
    },
    'record_run': {
        '--force': '--force has no effect without --output',
        '--all -e odom': '--regex has no effect with --all',
        'odom --all': 'TOPIC has no effect with --all',
        '--param x:=1': AFTER,
    },
    'replay_run': {
        'run --timeout 1': '--timeout needs -w',
        'run --topics /a --namespace b': '--namespace has no effect with --topics',
        'run --loop --wait-for-all-acked 1': '--wait-for-all-acked has no effect with --loop',
        'run --start-paused': '--start-paused needs a terminal',
        'run --log-level debug': AFTER,
        'run -p x:=1': AFTER,
    },
    'send_goal': {
        '1 1 --no-wait --timeout 5': '--timeout has no effect with --no-wait',
        '1 1 --heading 90': '--degrees accepts them',
        '1 1 --heading 400 --degrees': 'from -360 to 360 degrees',
        '1 1 --degrees': '--degrees needs --heading',
        '1 1 -p x:=1': AFTER,
        '1 1 -r __ns:=/a': AFTER,
    },
    'send_path': {
        'circle:1 --no-wait --timeout 5': '--timeout has no effect with --no-wait',
        'circle:0': 'size of a shape must be a positive number',
        'missing.csv': 'missing.csv: there is no such file',
        'square:1': 'path must be circle:RADIUS, line:LENGTH, eight:SIZE',
    },
    'sweep_gains': {
        '--kp -1e-3 2': 'kp must be in (0, 100], got -0.001',
        '--kv 0 2': 'kv must be in (0, 100], got 0',
        '--kv 1 101': 'kv must be in (0, 100], got 101',
        '--kp 3 2': 'kp must be MIN MAX with MIN < MAX, got (3.0, 2.0)',
        '--kp 2 2': 'kp must be MIN MAX with MIN < MAX, got (2.0, 2.0)',
        '--kp 2 2.0000000001': 'kp must have 59 different values',
        '--kp nan 2': '--kp: must be finite, got nan',
        '--kp 1': 'two gains must be swept, got ranges of none',
        '--grid 1': '--grid: must be an integer from 2 to 1000000, got 1',
        '--grid 2.5': "--grid: must be an integer from 2 to 1000000, got '2.5'",
        '--grid ٣': "--grid: must be an integer from 2 to 1000000, got '٣'",
        '--grid -': "--grid: must be an integer from 2 to 1000000, got '-'",
        f'--grid {"9" * 99}': '--grid: must be an integer from 2 to 1000000, got 9999',
        '--grid 1000': 'grid 1000 with 12 starts gives 12000000 closed loops; at most 1000000',
        '--starts 0': '--starts: must be an integer from 1 to 1000000, got 0',
        '--duration 1e9': 'which may take an hour; choose a smaller grid',
        '--duration 1e300 --rate 1e300': 'which may take an hour',
        '--duration 0': '--duration: must be positive and finite, got 0.0',
        '--rate -50': '--rate: must be positive and finite, got -50.0',
        '--distance 0.01': 'distance must be larger than tolerance, 0.02 m, and less than',
        '--distance 1e6': 'distance must be larger than tolerance',
        '--tolerance 0': '--tolerance: must be in [1e-06, 100], got 0.0',
        '--controller other': "controller must be one of 'go_to_goal', 'offset_point', 'pose'",
        '--controller offset_point --kp 1 2': 'unrecognized arguments: --kp',
        '--max-velocity 0': '--max-velocity: must be positive and finite, got 0.0',
        '--max-velocity 2000': "'linear.x.max_velocity' must be in [0, 1000]",
        '--max-yaw-rate 1e-9': 'limits must be at least 1e-06, got 1e-09',
        '--params-file nowhere.yaml': "no such file: 'nowhere.yaml'",
        '-o a.jpg': "the picture must end in .png, .svg, .pdf, got 'a.jpg'",
        "-o ''": "the picture must end in .png, .svg, .pdf, got ''",
        '--csv a.png': "the table must end in .csv, got 'a.png'",
        '--force': '--force has no effect without --output or --csv',
        '--ros-args -p kp:=1': 'sweep_gains takes no ROS arguments',
        '-p x:=1': 'sweep_gains takes no ROS arguments',
    },
    'virtual_robot': {'1': 'unrecognized arguments: 1', '-p kp:=1': AFTER, 'kp:=1': AFTER},
    'watch_run': {
        '--port 0': 'must be an integer from 1 to 65535, got 0',
        '--port 99999': 'must be an integer from 1 to 65535, got 99999',
        '--rate 2': '--rate needs a BAG',
        'bag --rate -2': 'must be in [0.01, 1000], got -2.0',
        'bag --ros-args -p x:=1': 'a BAG needs no ROS arguments',
    },
}
"""Words of the message, by command and its arguments."""


@pytest.mark.parametrize('command', WRONG)
def test_wrong_arguments_are_refused(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    for arguments, words in WRONG[command].items():
        message = refused(command, *shlex.split(arguments))
        assert words in message, arguments
    assert list(tmp_path.iterdir()) == []


ROS = ['--ros-args', '-p', 'x:=-1', '-r', '__ns:=/a']


@pytest.mark.parametrize(
    ('arguments', 'own', 'ros'),
    [
        ([], [], []),
        (['-1e-1', '-.5', '-1E+3', '-inf'], [' -1e-1', ' -.5', ' -1E+3', ' -inf'], []),
        (['--tolerance', '-1', '--timeout=-1'], ['--tolerance', ' -1', '--timeout=-1'], []),
        (['-h', '--open', '-', '-1m'], ['-h', '--open', '-', '-1m'], []),
        (['1', *ROS, '--', '-1'], ['1', ' -1'], [*ROS, '--']),
        ([*ROS, '--', '1', *ROS, '--', '1'], ['1', '1'], [*ROS, '--', *ROS, '--']),
        (['1', '--', '-1'], ['1', '--', ' -1'], []),
        (['--ros-args', '--ros-args', '-1'], [], ['--ros-args', '--ros-args', '-1']),
    ],
)
def test_arguments_of_tool_and_ros_are_separated(arguments, own, ros):
    assert _cli.split_arguments(arguments) == (own, ros)


def test_headings_are_in_radians_or_degrees():
    parser = _cli.Parser(prog='x')
    parser.add_heading('heading')
    for arguments, expected in (
        ([], None),
        (['--heading', '-6.2'], -6.2),
        (['--heading', '90', '--degrees'], math.pi / 2),
        (['--degrees', '--heading', ' -360'], -math.tau),
    ):
        assert parser.given_heading(parser.parse_args(arguments)) == expected


def test_robot_stands_for_its_parameter_file():
    parser = _cli.Parser(prog='x')
    parser.add_params_file()
    options = parser.parse_args(['--robot', 'turtlebot3_burger'])
    expected = Path(__file__).parents[2] / 'config' / 'turtlebot3_burger.yaml'
    assert Path(options.params_file).read_text() == expected.read_text()
    assert 'create3, turtlebot3_burger' in ' '.join(parser.format_help().split())


def test_namespaces():
    for text, expected in (('robot1', '/robot1'), ('/a/b/', '/a/b'), ('/', '/'), ('', '/')):
        assert _cli.namespace(text) == expected
    for text in ('a b', '1a', 'a//b', 'a-b'):
        with pytest.raises(argparse.ArgumentTypeError):
            _cli.namespace(text)


def test_a_bag_is_not_named_like_a_file():
    for name in ('run.png', 'run.svg/', 'a/run.PDF', 'run.csv', 'run.txt', 'run.yaml'):
        with pytest.raises(argparse.ArgumentTypeError):
            _cli.bag_folder(name)
    for name in ('run', 'run.2', 'runs.png/run', 'run_2026_01_01-10_00_00', '.png'):
        assert _cli.bag_folder(name) == name
