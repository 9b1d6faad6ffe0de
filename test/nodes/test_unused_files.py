"""Parameter files for other nodes: recognized as rclpy matches names."""

from __future__ import annotations

import re

import pytest
from rclpy.node import Node

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.parameters.file import concerns, robot_parameters, sections
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.runner import ros_context
from diffdrive_jacobian.tools._cli import warn_of_unused_files

NAMESPACES = ('', '/a', '/a/b')
KEYS = (
    *('virtual_robot', '/virtual_robot', '/**', '**', '/*', '*', '/**/virtual_robot'),
    *('/*/virtual_robot', 'a/virtual_robot', '/a/virtual_robot', '/a/*', '/a/**'),
    *('/a/b/virtual_robot', '/a/**/virtual_robot', '/other', '/virtual_robot2', '/b/virtual_robot'),
)


@pytest.fixture
def written(tmp_path):
    """A function that writes a file of parameters and returns its path."""

    def write(text):
        path = tmp_path / 'p.yaml'
        path.write_text(text)
        return str(path)

    return write


def node_names(path):
    return [name for name, _ in sections(path)]


def test_a_name_concerns_the_nodes_to_which_rclpy_gives_the_parameters(written):
    for key in KEYS:
        file = written(f'"{key}":\n  ros__parameters:\n    given: 1.0\n')
        (name,) = node_names(file)
        with ros_context(['test', '--ros-args', '--params-file', file]) as context:
            for namespace in NAMESPACES:
                lean = {'start_parameter_services': False, 'enable_rosout': False}
                node = Node('virtual_robot', namespace=namespace, context=context, **lean)
                given = 'given' in node._parameter_overrides
                assert concerns(name, node.get_fully_qualified_name()) == given, (key, namespace)
                node.destroy_node()


def test_the_names_in_a_file_are_found(written):
    for text, names in (
        ('a:\n  b:\n    ros__parameters: {x: {y: 1}, z: [1, {q: 2}]}\n', ['/a/b']),
        ('{a: {ros__parameters: {x: 1}}, /b: {ros__parameters: {}}}', ['/a']),
        ('a: &p\n  ros__parameters: {x: 1}\nb: *p\n', ['/a', '/b']),
        ('a: [1, 2]\nb: {c: 1}\n', []),
        ('', []),
        ('text', []),
        ('a: {ros__parameters: }', []),
    ):
        assert node_names(written(text)) == names, text


def test_a_file_that_cannot_be_read_is_refused_and_not_called_empty(tmp_path, capsys):
    path = tmp_path / 'p.yaml'
    for content in (None, b'a: [1, {', b'? {a: 1}\n: 1', b'\xff\xfe\0', b'#' * 2_000_001):
        if content is not None:
            path.write_bytes(content)
        for read in (sections, robot_parameters):
            with pytest.raises(UserError, match=f'must be a file of ROS parameters, got {path}'):
                read(str(path))
        warn_of_unused_files('drive_to', ['--ros-args', '--params-file', str(path)], ['/virtual_robot'])
        assert capsys.readouterr().err == ''


def test_a_file_without_parameters_is_reported(written, capsys):
    """All of these rcl accepts without a word."""
    for text in ('', '# nothing\n', '{}', 'text', 'virtual_robot: {ros__parameters: {}}'):
        file = written(text)
        ros = ['--ros-args', '--params-file', file]
        with ros_context(['test', *ros]):
            warn_of_unused_files('virtual_robot', ros, ['/virtual_robot'])
        words = f'virtual_robot: warning: --params-file {file} has no parameters: '
        assert words in capsys.readouterr().err
        with pytest.raises(UserError, match='it has none of virtual_robot'):
            robot_parameters(file)


def test_a_tool_without_nodes_refuses_a_file_for_others(written):
    text = '/**/wheel_bridge: {ros__parameters: {wheel_radius: 0.1}}'
    with pytest.raises(UserError, match='none of virtual_robot, but of '):
        robot_parameters(written(text))
    for name in ('/a/virtual_robot', 'a: {b: {virtual_robot', '/**', '"*"'):
        text = f'{name}: {{ros__parameters: {{linear: {{x: 1.0}}}}' + '}' * (name.count('{') + 1)
        assert robot_parameters(written(text)) == {'linear.x': 1.0}


SHARED = """
/**: {ros__parameters: {wheel_radius: 0.1, left_wheel_name: l, own: 1, another.name: 2, kpp: 1.0}}
/**/go_to_goal: {ros__parameters: {colour: red}}
"""


def test_a_parameter_for_all_nodes_need_not_be_of_each(written, capfd):
    """A misspelt one is reported, and so is one that is only for this node."""
    arguments = ['--params-file', written(SHARED), '-p', 'shape:=1']
    with ros_context(['go_to_goal', '--ros-args', *arguments]) as context:
        node = GoToGoal(context=context)
        report_unknown([node])
        node.destroy_node()
    reported = re.findall("unknown parameter '([^']*)'", capfd.readouterr().err)
    assert reported == ['colour', 'kpp', 'shape']


def test_a_file_for_other_nodes_is_reported_with_the_names(written, capsys):
    file = written('/robot1/virtual_robot:\n  ros__parameters:\n    x: 1.0\n')
    ros = ['--ros-args', '--params-file', file, '--']
    warn_of_unused_files('drive_to', ros, ['/robot1/virtual_robot', '/go_to_goal'])
    assert capsys.readouterr().err == ''
    warn_of_unused_files('drive_to', ros, ['/virtual_robot', '/go_to_goal'])
    assert capsys.readouterr().err == (
        f'drive_to: warning: --params-file {file} has no parameters of these nodes: '
        'it is for /robot1/virtual_robot, the nodes are /virtual_robot, /go_to_goal\n'
    )
