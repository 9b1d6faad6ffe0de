"""What README.md says holds: its parameters, its topics, its example, its commands."""

from __future__ import annotations

import importlib
import inspect
import math
import re
from dataclasses import fields
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from diffdrive_jacobian import kinematics
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import specifications
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.tools import (
    drive_to,
    entry_points,
    plot_run,
    record_run,
    recover_run,
    replay_run,
    send_goal,
    sweep_gains,
    verify_run,
)

README = (Path(__file__).parent.parent / 'README.md').read_text()
NODES = {
    'virtual_robot': (VirtualRobot, VirtualRobotParameters),
    'go_to_goal': (GoToGoal, GoToGoalParameters),
    'wheel_bridge': (WheelBridge, WheelBridgeParameters),
}


def section(name):
    return re.search(rf'^### {name}\n(.*?)(?=^##)', README, re.MULTILINE | re.DOTALL).group(1)


def table(name, header):
    """The rows of a table of a node's section, as cells."""
    text = section(name).split(f'| {header}', 1)[1].split('\n\n', 1)[0]
    return [[cell.strip() for cell in row.strip('|').split('|')] for row in text.splitlines()[2:]]


def written(value):
    if isinstance(value, bool):
        return str(value).lower()
    return '.nan' if isinstance(value, float) and math.isnan(value) else str(value)


def blocks(language):
    return re.findall(rf'```{language}\n(.*?)```', README, re.DOTALL)


@pytest.mark.parametrize('name', NODES)
def test_parameters_and_their_defaults(name):
    _, parameters = NODES[name]
    told = {}
    for names, defaults, _ in table(name, 'parameter'):
        names, defaults = re.findall(r'`([^`]+)`', names), defaults.split(', ')
        told.update(zip(names, defaults * (len(names) // len(defaults)), strict=True))
    values = {field.name: field.default for field in fields(parameters)}
    assert told == {
        ros_name: written(values[field]) for ros_name, (field, _) in specifications(parameters).items()
    }


@pytest.mark.parametrize('name', NODES)
def test_topics_and_services(lockstep, name):
    node = lockstep.add(NODES[name][0]())
    other = {'cmd_vel': 'joint_command'} if name == 'virtual_robot' else {}
    told = {re.search(r'`/?(\w+)`', row[0]).group(1) for row in table(name, 'topic')}
    if find_spec('tf2_ros') is None:
        told -= {'tf'}
    names = (
        node.get_publisher_names_and_types_by_node(name, '/')
        + node.get_subscriber_names_and_types_by_node(name, '/')
        + node.get_service_names_and_types_by_node(name, '/')
    )
    own = {
        topic.strip('/')
        for topic, _ in names
        if topic.count('/') == 1 and topic not in ('/rosout', '/parameter_events', '/clock')
    }
    assert told == own | {alternative for topic, alternative in other.items() if topic in own}


def test_example_gives_the_numbers_in_its_comments():
    code = next(block for block in blocks('python') if 'q_dot =' in block)
    names = {}
    exec(code, names)
    comments = [
        [float(number) for number in re.findall(r'-?\d+\.\d{3}', line.split('#')[1])]
        for line in code.splitlines()
        if '#' in line
    ]
    got = [[names['v'], names['omega']], [names['omega_R'], names['omega_L']], [*names['q_dot']]]
    for numbers, values in zip(comments, got, strict=False):
        assert numbers == [round(float(value), 3) for value in values]


def test_tested_controller_fails_as_told_and_passes_when_mended(pytester):
    controller, test = (
        next(block for block in blocks('python') if block.startswith(f'# {name}.py'))
        for name in ('face', 'test_face')
    )
    mended = blocks('python')[blocks('python').index(test) + 1]
    told = next(block for block in blocks('text') if 'assert' in block).splitlines()
    plugins = re.search(r'^`(pytest_plugins = .*)`:$', README, re.MULTILINE).group(1)
    pytester.makeconftest(plugins)
    pytester.makepyfile(face=controller, test_face=test)
    result = pytester.runpytest_subprocess()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(told)
    wrong = next(line for line in controller.splitlines() if 'error =' in line)
    pytester.makepyfile(face=controller.replace(wrong, mended.rstrip()))
    pytester.runpytest_subprocess().assert_outcomes(passed=1)


def test_two_commands_of_one_line_each():
    commands = re.findall(r'^python3 -m venv .*$', README, re.MULTILINE)
    assert len(commands) == 2
    assert commands[0].endswith('drive_to 1 1')
    assert commands[1].endswith('pytest')


@pytest.mark.parametrize(
    'tool',
    [drive_to, send_goal, record_run, recover_run, replay_run, verify_run, plot_run, sweep_gains],
    ids=lambda one: one.PROGRAM,
)
def test_options_of_the_tools(tool):
    row = next(line for line in README.splitlines() if line.startswith(f'| `{tool.PROGRAM} '))
    options = {
        option
        for action in tool._parser()._actions
        for option in action.option_strings
        if option not in ('-h', '--help')
    }
    told = {
        word for text in re.findall(r'`(-[^`]+)`', row) for word in re.findall(r'--?[a-z][a-z-]*', text)
    }
    assert told - {'--ros-args'} == options
    assert hasattr(entry_points, tool.PROGRAM)


def examples():
    """The table from the documents to the code: what each row's example says, and what it must give."""
    for row in README.split('| document | function |', 1)[1].split('\n\n', 1)[0].splitlines()[2:]:
        what, functions, _, example = (cell.strip() for cell in row.strip('|').split('|'))
        yield pytest.param(functions, *re.findall(r'`([^`]+)`', example), id=what)


@pytest.mark.parametrize(('functions', 'first', 'second'), list(examples()))
def test_examples_of_the_documents_methods(functions, first, second):
    names = {}
    exec(next(block for block in blocks('python') if 'inverse_velocity' in block), names)
    exec(first, names)
    expression, expected = second.split('  # ')
    np.testing.assert_allclose(eval(expression, names), eval(expected), rtol=0.0, atol=6e-4)
    # What the second column names is there.
    for function in re.findall(r'`([\w.]+)`', functions):
        assert function.split('.')[-1] in library(), function


@lru_cache
def library():
    """Every public name of the numpy half, methods included."""
    names = set()
    for module in (
        *(importlib.import_module(f'diffdrive_jacobian.{layer}') for layer in ('control', 'simulation')),
        *vars(kinematics).values(),
    ):
        for name, value in getattr(module, '__dict__', {}).items():
            names.add(name)
            if inspect.isclass(value):
                names.update(vars(value))
    return names
