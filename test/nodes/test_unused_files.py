"""Parameter files for other nodes: recognized as rclpy matches names."""

from __future__ import annotations

import re

import pytest
from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.parameters.file import concerns, robot_parameters, sections
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.runner import ros_context
from diffdrive_jacobian.tools._options import warn_of_unused_files

NAMESPACES = ('', '/a', '/a/b')
KEYS = (
    *(
        'virtual_robot',
        '/virtual_robot',
        '/**',
        '**',
        '/*',
        '*',
        '/**/virtual_robot',
        '/*/virtual_robot',
    ),
    *(
        'a/virtual_robot',
        '/a/virtual_robot',
        '/a/*',
        '/a/**',
        '/a/b/virtual_robot',
        '/a/**/virtual_robot',
    ),
    *('/other', '/virtual_robot2', '/b/virtual_robot'),
)


def written(path, text):
    path.write_text(text)
    return str(path)


def node_names(path):
    return [name for name, _ in sections(path)]


@pytest.mark.parametrize('key', KEYS)
def test_a_name_concerns_the_nodes_to_which_rclpy_gives_the_parameters(tmp_path, key):
    file = written(tmp_path / 'p.yaml', f'"{key}":\n  ros__parameters:\n    given: 1.0\n')
    names = node_names(file)
    assert len(names) == 1
    with ros_context(['test', '--ros-args', '--params-file', file]) as context:
        for namespace in NAMESPACES:
            node = _node(namespace, context)
            given = 'given' in node._parameter_overrides
            assert concerns(names[0], node.get_fully_qualified_name()) == given
            node.destroy_node()


def _node(namespace: str, context: Context) -> Node:
    return Node('virtual_robot', namespace=namespace, context=context)


@pytest.mark.parametrize(
    ('text', 'names'),
    [
        ('a:\n  b:\n    ros__parameters: {x: {y: 1}, z: [1, {q: 2}]}\n', ['/a/b']),
        ('{a: {ros__parameters: {x: 1}}, /b: {ros__parameters: {}}}', ['/a']),
        ('a: &p\n  ros__parameters: {x: 1}\nb: *p\n', ['/a', '/b']),
        ('a: [1, 2]\nb: {c: 1}\n', []),
        ('', []),
        ('text', []),
        ('a: {ros__parameters: }', []),
    ],
)
def test_the_names_in_a_file_are_found(tmp_path, text, names):
    assert node_names(written(tmp_path / 'p.yaml', text)) == names


@pytest.mark.parametrize(
    'content', [b'a: [1, {', b'? {a: 1}\n: 1', b'\xff\xfe\0', b'#' * 2_000_001, None]
)
def test_a_file_that_cannot_be_read_is_refused_and_not_called_empty(tmp_path, capsys, content):
    path = tmp_path / 'p.yaml'
    if content is not None:
        path.write_bytes(content)
    for read in (sections, robot_parameters):
        with pytest.raises(UserError, match=f'must be a file of ROS parameters, got {path}'):
            read(str(path))
    warn_of_unused_files('drive_to', ['--ros-args', '--params-file', str(path)], ['/virtual_robot'])
    assert capsys.readouterr().err == ''


EMPTY = ['', '# nothing\n', '{}', 'text', 'virtual_robot: {ros__parameters: {}}']


@pytest.mark.parametrize('text', EMPTY)
def test_a_file_without_parameters_is_reported(tmp_path, capsys, text):
    """All of these rcl accepts without a word."""
    file = written(tmp_path / 'p.yaml', text)
    ros = ['--ros-args', '--params-file', file]
    with ros_context(['test', *ros]):
        warn_of_unused_files('virtual_robot', ros, ['/virtual_robot'])
    assert f'virtual_robot: warning: --params-file {file} has no parameters: ' in capsys.readouterr().err
    with pytest.raises(UserError, match='it has none of virtual_robot'):
        robot_parameters(file)


def test_a_tool_without_nodes_refuses_a_file_for_others(tmp_path):
    text = '/**/wheel_bridge: {ros__parameters: {wheel_radius: 0.1}}'
    with pytest.raises(UserError, match='none of virtual_robot, but of '):
        robot_parameters(written(tmp_path / 'p.yaml', text))
    for name in ('/a/virtual_robot', 'a: {b: {virtual_robot', '/**', '"*"'):
        text = f'{name}: {{ros__parameters: {{linear: {{x: 1.0}}}}' + '}' * (name.count('{') + 1)
        assert robot_parameters(written(tmp_path / 'p.yaml', text)) == {'linear.x': 1.0}


SHARED = """
/**: {ros__parameters: {wheel_radius: 0.1, left_wheel_name: l, own: 1, another.name: 2, kpp: 1.0}}
/**/go_to_goal: {ros__parameters: {colour: red}}
"""


def test_a_parameter_for_all_nodes_need_not_be_of_each(tmp_path, capfd):
    """A misspelt one is reported, and so is one that is only for this node."""
    file = written(tmp_path / 'p.yaml', SHARED)
    with ros_context(['go_to_goal', '--ros-args', '--params-file', file, '-p', 'shape:=1']) as context:
        node = GoToGoal(context=context)
        report_unknown([node])
        node.destroy_node()
    reported = re.findall("unknown parameter '([^']*)'", capfd.readouterr().err)
    assert reported == ['colour', 'kpp', 'shape']


def test_a_file_for_other_nodes_is_reported_with_the_names(tmp_path, capsys):
    file = written(tmp_path / 'p.yaml', '/robot1/virtual_robot:\n  ros__parameters:\n    x: 1.0\n')
    ros = ['--ros-args', '--params-file', file, '--']
    warn_of_unused_files('drive_to', ros, ['/robot1/virtual_robot', '/go_to_goal'])
    assert capsys.readouterr().err == ''
    warn_of_unused_files('drive_to', ros, ['/virtual_robot', '/go_to_goal'])
    assert capsys.readouterr().err == (
        f'drive_to: warning: --params-file {file} has no parameters of these nodes: '
        'it is for /robot1/virtual_robot, the nodes are /virtual_robot, /go_to_goal\n'
    )
