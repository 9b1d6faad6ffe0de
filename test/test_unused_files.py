"""Parameter files for other nodes: recognized as rclpy matches names."""

from __future__ import annotations

import pytest
from rclpy.context import Context
from rclpy.node import Node

from diffdrive_jacobian.ros.runner import ros_context
from diffdrive_jacobian.tools._unused_files import concerns, node_names, warn_of_unused_files

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
        ('{a: {ros__parameters: {x: 1}}, /b: {ros__parameters: {}}}', ['/a', '/b']),
        ('a: &p\n  ros__parameters: {x: 1}\nb: *p\n', ['/a', '/b']),
        ('a: [1, 2]\nb: {c: 1}\n', []),
        ('', []),
        ('a: [1, {', []),
        ('? {a: 1}\n: {ros__parameters: {}}\n', []),
    ],
)
def test_the_names_in_a_file_are_found(tmp_path, text, names):
    assert node_names(written(tmp_path / 'p.yaml', text)) == names


def test_unreadable_and_large_files_have_no_names(tmp_path):
    assert node_names(str(tmp_path / 'missing.yaml')) == []
    (tmp_path / 'binary.yaml').write_bytes(b'\xff\xfe\x00')
    assert node_names(str(tmp_path / 'binary.yaml')) == []
    large = 'a: {ros__parameters: {}}\n' + '#' * 2_000_000
    assert node_names(written(tmp_path / 'large.yaml', large)) == []


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
