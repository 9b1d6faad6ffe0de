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

"""Parameters: declared once, compared with the files in config/, refused with the reason, and files that
are for other nodes."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import yaml
from rcl_interfaces.msg import ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter
from support.lockstep_nodes import LEAN, change

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.file import concerns, robot_parameters, sections
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.runner import ros_context
from diffdrive_jacobian.tools._cli import warn_of_unused_files

NODES = {
    'virtual_robot': (VirtualRobot, VirtualRobotParameters),
    'go_to_goal': (GoToGoal, GoToGoalParameters),
    'wheel_bridge': (WheelBridge, WheelBridgeParameters),
}
FILES = sorted((Path(__file__).parents[2] / 'config').glob('*.yaml'))
TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)
def test_config_files_name_only_what_exists_agree_and_run(path):
    sections = yaml.safe_load(path.read_text())
    assert set(sections) == {f'/**/{name}' for name in NODES}
    robot, goal, bridge = (sections[f'/**/{name}']['ros__parameters'] for name in NODES)
    for shared in ('wheel_radius', 'wheel_separation', 'left_wheel_name', 'right_wheel_name'):
        assert robot[shared] == bridge[shared]
    assert {key: robot[key] for key in goal} == goal
    with ros_context(['test', '--ros-args', '--params-file', str(path)]) as context:
        for (node_class, parameters), given in zip(NODES.values(), (robot, goal, bridge), strict=True):
            known = parameters().declared()
            assert set(given) <= set(known)
            node = node_class(context=context, namespace='any/where')
            for ros_name, value in given.items():
                assert getattr(node.parameters, known[ros_name].field) == value
            node.destroy_node()


@pytest.mark.parametrize('name', NODES)
def test_every_parameter_is_described_as_declared(add, name):
    node_class, parameters = NODES[name]
    node = add(node_class)
    for ros_name, declared in parameters().declared().items():
        description = node.describe_parameter(ros_name)
        default = declared.default
        assert description.type == TYPES[type(default)]
        assert description.description == declared.description
        assert description.read_only == declared.read_only
        value = node.get_parameter(ros_name).value
        assert value == default or (math.isnan(value) and math.isnan(default))
        if type(default) is float and not declared.nan_is_none:
            (limits,) = description.floating_point_range
            assert limits.from_value <= default <= limits.to_value
        if type(default) is int:
            (limits,) = description.integer_range
            assert (limits.from_value, limits.to_value) == (declared.within.low, declared.within.high)
        if type(default) is float:
            assert '[' in declared.description, f'{ros_name} has no unit'


def test_limits_follow_diff_drive_controller():
    assert VirtualRobotParameters().limits().unlimited
    limits = VirtualRobotParameters(linear_x_max_velocity=0.3, angular_z_min_velocity=-1.0).limits()
    assert (limits.min_v, limits.max_v) == (-0.3, 0.3)
    assert (limits.min_omega, limits.max_omega) == (-1.0, math.inf)
    assert VirtualRobotParameters(linear_x_max_deceleration=-1.0).model().actuators.immediate
    given = VirtualRobotParameters(linear_x_max_acceleration=0.5).acceleration_limits().v
    assert (given.max_acceleration, given.max_deceleration) == (0.5, -0.5)
    assert (given.max_acceleration_reverse, given.max_deceleration_reverse) == (-0.5, 0.5)
    given = VirtualRobotParameters(
        angular_z_max_acceleration=2.0, angular_z_max_acceleration_reverse=-3.0
    ).acceleration_limits()
    assert given.omega.max_deceleration == -3.0
    assert given.omega.max_deceleration_reverse == 2.0
    assert given.v.unlimited


def test_quality_of_service_can_be_overridden(add):
    node = add(VirtualRobot, **{'qos_overrides./odom.publisher.reliability': 'best_effort'})
    (info,) = node.get_publishers_info_by_topic('/odom')
    assert info.qos_profile.reliability.name == 'BEST_EFFORT'
    (info,) = node.get_publishers_info_by_topic('/joint_states')
    assert info.qos_profile.reliability.name == 'RELIABLE'
    for override, value in (('depth', 2**31), ('history', 'keep_none')):
        words = f'the qos_overrides of /odom are invalid: .*got publisher.{override}: {value}'
        with pytest.raises(ParameterError, match=words):
            add(VirtualRobot, **{f'qos_overrides./odom.publisher.{override}': value})


# --- What is refused

ROBOT, GOAL = VirtualRobotParameters, GoToGoalParameters
BAD = [
    (ROBOT, {'wheel_radius': 0.0}, "'wheel_radius' must be in [0.001, 10], got 0.0"),
    (ROBOT, {'wheel_radius': '1'}, "'wheel_radius' must be a double (as 1.0), got '1'"),
    (ROBOT, {'publish_rate': 5000.0}, "'publish_rate' must be in [0.1, 1000], got 5000.0"),
    (ROBOT, {'enable_odom_tf': 1}, "'enable_odom_tf' must be a bool (true or false), got 1"),
    (ROBOT, {'linear_x_max_velocity': -0.1}, "'linear.x.max_velocity' must be in [0, 1000] or .nan"),
    (ROBOT, {'command_interface': 'legs'}, "must be one of 'twist', 'wheels', got 'legs'"),
    (ROBOT, {'base_frame_id': ''}, "'base_frame_id' must be not empty"),
    (ROBOT, {'base_frame_id': 'odom'}, 'must differ'),
    (ROBOT, {'odom_frame_id': 257 * 'n'}, "n...' (257 characters)"),
    (ROBOT, {'left_wheel_name': 'right_wheel_joint'}, "must differ, both are 'right_wheel_joint'"),
    (ROBOT, {'wheel_lag': 1e-20}, "'wheel_lag' must be 0.0 or at least 1e-09, got 1e-20"),
    (GOAL, {'controller': 'Pose'}, "'controller' must be one of '"),
    (GOAL, {'controller': 'offset_point', 'offset': -0.0009}, 'rank 1'),
    (GOAL, {'offset': 101.0}, "'offset' must be in"),
    *((GOAL, {name: bad}, f"'{name}'") for name in ('kp', 'kv') for bad in (0.0, math.nan, 101.0)),
]


@pytest.mark.parametrize(('kind', 'values', 'words'), BAD)
def test_bad_values_cannot_exist(kind, values, words):
    with pytest.raises(ParameterError, match=re.escape(words)):
        kind(**values)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'wheel_radius': '1'}, 'Wrong parameter type'),
        ({'wheel_radius': 0.0}, 'wheel_radius'),
        ({'command_interface': 'wheels'}, 'read-only'),
        ({'wheel_separation': 1.0, 'base_frame_id': 'odom'}, 'must differ'),
    ],
)
def test_bad_changes_are_refused(add, changes, words):
    node = add(VirtualRobot)
    before = node.parameters
    result = change(node, **changes)
    assert not result.successful
    assert words in result.reason
    assert node.parameters == before


def test_one_of_several_changes_that_is_bad_refuses_all_when_atomic(add):
    node = add(GoToGoal)
    changes = [Parameter('kp', value=4.0), Parameter('kv', value=-1.0)]
    assert not node.set_parameters_atomically(changes).successful
    assert (node.parameters.kp, node.parameters.kv) == (3.0, 0.5)
    good, bad = node.set_parameters(changes)
    assert (good.successful, bad.successful) == (True, False)
    assert (node.parameters.kp, node.parameters.kv) == (4.0, 0.5)
    # Those of others are left alone.
    node.declare_parameter('foreign', 3)
    assert node.set_parameters([Parameter('foreign', value=4)])[0].successful


def test_a_refused_start_leaves_no_node(lockstep, add):
    with pytest.raises(ParameterError, match='wheel_radius'):
        add(VirtualRobot, wheel_radius=-1.0)
    assert lockstep.node.get_node_names() == ['lockstep']


# --- Files


@pytest.fixture
def written(tmp_path):
    """A function that writes a file of parameters and returns its path."""

    def write(text):
        path = tmp_path / 'p.yaml'
        path.write_text(text)
        return str(path)

    return write


def test_the_last_value_counts_and_integers_are_taken_for_doubles(written):
    path = written('/**/go_to_goal: {ros__parameters: {kp: 5.0, kv: 2, xy_goal_tolerance: 0.1}}')
    arguments = ['--params-file', path, '-p', 'kp:=6', '-p', 'go_to_goal:kv:=1.5']
    with ros_context(['test', '--ros-args', *arguments]) as context:
        node = GoToGoal(context=context)
        assert (node.parameters.kp, node.parameters.kv) == (6.0, 1.5)
        node.set_parameters([Parameter('kp', value=7)])
        assert node.parameters.kp == node.get_parameter('kp').value == 7.0
        assert node.parameters.xy_goal_tolerance == 0.1
        node.destroy_node()


KEYS = (
    *('virtual_robot', '/**', '*', '/**/virtual_robot', '/*/virtual_robot', 'a/virtual_robot'),
    *('/a/*', '/a/**', '/a/b/virtual_robot', '/a/**/virtual_robot', '/other', '/virtual_robot2'),
)


def test_a_name_concerns_the_nodes_to_which_rclpy_gives_the_parameters(written):
    for key in KEYS:
        file = written(f'"{key}":\n  ros__parameters:\n    given: 1.0\n')
        ((name, _),) = sections(file)
        with ros_context(['test', '--ros-args', '--params-file', file]) as context:
            for namespace in ('', '/a', '/a/b'):
                node = Node('virtual_robot', namespace=namespace, context=context, **LEAN)
                given = 'given' in node._parameter_overrides
                assert concerns(name, node.get_fully_qualified_name()) == given, (key, namespace)
                node.destroy_node()


ALIASES = b'a: &p\n  ros__parameters: {x: 1}\nb: *p\n'
"""rcl refuses them, too."""


def test_a_file_that_cannot_be_read_is_refused_and_not_called_empty(tmp_path, capsys):
    path = tmp_path / 'p.yaml'
    for content in (None, b'a: [1, {', b'? {a: 1}\n: 1', b'\xff\xfe\0', b'&a {a: *a}', ALIASES):
        if content is not None:
            path.write_bytes(content)
        for read in (sections, robot_parameters):
            with pytest.raises(UserError, match=f'must be a file of ROS parameters, got {path}'):
                read(str(path))
        warn_of_unused_files('drive_to', ['--ros-args', '--params-file', str(path)], ['/virtual_robot'])
        assert capsys.readouterr().err == ''


def test_a_file_that_is_for_no_node_of_a_program_is_reported(written, capsys):
    def warning(text, *nodes):
        file = written(text)
        warn_of_unused_files('drive_to', ['--ros-args', '--params-file', file, '--'], nodes)
        return capsys.readouterr().err

    of_robot1 = '/robot1/virtual_robot: {ros__parameters: {x: 1.0}}'
    assert warning(of_robot1, '/robot1/virtual_robot', '/go_to_goal') == ''
    words = 'it is for /robot1/virtual_robot, the nodes are /virtual_robot, /go_to_goal\n'
    assert warning(of_robot1, '/virtual_robot', '/go_to_goal').endswith(words)
    # rcl accepts these without a word.
    for text in ('', 'text', 'virtual_robot: {ros__parameters: {}}'):
        assert 'has no parameters: ' in warning(text, '/virtual_robot')


def test_a_tool_without_nodes_takes_the_parameters_of_the_robot_alone(written):
    for name in ('/a/virtual_robot', '/**', '"*"'):
        text = f'{name}: {{ros__parameters: {{linear: {{x: 1.0}}}}}}'
        assert robot_parameters(written(text)) == {'linear.x': 1.0}
    two = '/a/virtual_robot: {ros__parameters: {x: 1.0}}\n/b/virtual_robot: {ros__parameters: {x: 2.0}}'
    for text, words in (
        ('', 'it has none of virtual_robot$'),
        ('/**/wheel_bridge: {ros__parameters: {wheel_radius: 0.1}}', 'none of virtual_robot, but of '),
        (two, 'for one virtual_robot, .* for /a/virtual_robot, /b/'),
    ):
        with pytest.raises(UserError, match=words):
            robot_parameters(written(text))


# --- Unknown parameters


SHARED = """
/**: {ros__parameters: {wheel_radius: 0.1, left_wheel_name: l, own: 1, another.name: 2, kpp: 1.0}}
/**/go_to_goal: {ros__parameters: {kq: 1.0, colour: red}}
"""


def test_unknown_parameters_are_named_with_what_was_meant(written, capfd):
    """Those for all nodes need not be of each, unless one is misspelt."""
    with ros_context(['go_to_goal', '--ros-args', '--params-file', written(SHARED)]) as context:
        node = GoToGoal(context=context)
        report_unknown([node])
        node.destroy_node()
    assert re.findall('unknown parameter (.*)', capfd.readouterr().err) == [
        "'colour' is ignored; see go_to_goal --help",
        "'kpp' is ignored; did you mean 'kp'?",
        "'kq' is ignored; did you mean 'kp' or 'kv'?",
    ]


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        ('Kp:=3.0', "no node of this program has the parameter 'Kp'; did you mean 'kp'?"),
        ('go_to_goal:shape:=1', "the parameter 'shape'; see go_to_goal --help"),
        # Not given to this node.
        ('wheel_bridge:shape:=1', None),
        # Of another node of this program.
        ('own:=1', None),
    ],
)
def test_a_parameter_that_no_node_has_is_refused_on_the_command_line(given, words):
    with ros_context(['go_to_goal', '--ros-args', '-p', given]) as context:
        node, other = GoToGoal(context=context), Node('other', context=context)
        other.declare_parameter('own', 0)
        if words is None:
            report_unknown([node], [other])
        else:
            with pytest.raises(ParameterError, match=re.escape(words)):
                report_unknown([node], [other])
        for one in (node, other):
            one.destroy_node()
