"""Parameters: declared once, compared with the files in config/, refused with the reason."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import pytest
import yaml
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError, specifications
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from diffdrive_jacobian.ros.parameters import report_unknown
from diffdrive_jacobian.ros.runner import ros_context

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


def test_config_files_name_only_what_exists_agree_and_run():
    assert len(FILES) >= 2
    for path in FILES:
        sections = yaml.safe_load(path.read_text())
        assert set(sections) == {f'/**/{name}' for name in NODES}
        robot, goal, bridge = (sections[f'/**/{name}']['ros__parameters'] for name in NODES)
        for shared in ('wheel_radius', 'wheel_separation', 'left_wheel_name', 'right_wheel_name'):
            assert robot[shared] == bridge[shared]
        assert {key: robot[key] for key in goal} == goal
        with ros_context(['test', '--ros-args', '--params-file', str(path)]) as context:
            for (node_class, parameters), given in zip(
                NODES.values(), (robot, goal, bridge), strict=True
            ):
                known = specifications(parameters)
                assert set(given) <= set(known)
                node = node_class(context=context, namespace='any/where')
                for ros_name, value in given.items():
                    assert getattr(node.parameters, known[ros_name][0]) == value
                node.destroy_node()


@pytest.mark.parametrize('name', NODES)
def test_every_parameter_is_described_as_declared(add, name):
    node_class, parameters = NODES[name]
    node = add(node_class)
    defaults = {field.name: field.default for field in fields(parameters)}
    for ros_name, (field, specification) in specifications(parameters).items():
        description = node.describe_parameter(ros_name)
        default = defaults[field]
        assert description.type == TYPES[type(default)]
        assert description.description == specification.description
        assert description.read_only == specification.read_only
        value = node.get_parameter(ros_name).value
        assert value == default or (math.isnan(value) and math.isnan(default))
        if type(default) is float and not specification.nan_is_none:
            (limits,) = description.floating_point_range
            assert limits.from_value <= default <= limits.to_value
        if type(default) is int:
            (limits,) = description.integer_range
            assert (limits.from_value, limits.to_value) == (specification.low, specification.high)
        if type(default) is float:
            assert '[' in specification.description, f'{ros_name} has no unit'


BAD = [
    ({'wheel_radius': 0.0}, "'wheel_radius' must be in [0.001, 10], got 0.0"),
    ({'wheel_radius': math.nan}, 'got nan'),
    ({'wheel_radius': '1'}, "'wheel_radius' must be a double (as 1.0), got '1'"),
    ({'publish_rate': 5000.0}, "'publish_rate' must be in [0.1, 1000], got 5000.0"),
    ({'enable_odom_tf': 1}, "'enable_odom_tf' must be a bool (true or false), got 1"),
    ({'linear_x_max_velocity': -0.1}, "'linear.x.max_velocity' must be in [0, 1000] or .nan"),
    ({'command_interface': 'legs'}, "must be one of 'twist', 'wheels', got 'legs'"),
    ({'left_wheel_name': 'right_wheel_joint'}, "must differ, both are 'right_wheel_joint'"),
]


def test_bad_values_cannot_exist():
    for values, words in BAD:
        with pytest.raises(ParameterError) as caught:
            VirtualRobotParameters(**values)
        assert words in str(caught.value)
    for name in ('kp', 'kv'):
        with pytest.raises(ParameterError, match=rf"'{name}' must be in \(0, 100\], got 0.0"):
            GoToGoalParameters(**{name: 0.0})
    parameters = GoToGoalParameters(kp=4.0)
    with pytest.raises(FrozenInstanceError):
        parameters.kp = 5.0
    with pytest.raises(TypeError):
        GoToGoalParameters(4.0)


def test_limits_follow_diff_drive_controller():
    assert VirtualRobotParameters().limits().unlimited
    limits = VirtualRobotParameters(linear_x_max_velocity=0.3, angular_z_min_velocity=-1.0).limits()
    assert (limits.min_v, limits.max_v) == (-0.3, 0.3)
    assert (limits.min_omega, limits.max_omega) == (-1.0, math.inf)
    assert VirtualRobotParameters(linear_x_max_deceleration=-1.0).model().actuators is None
    given = VirtualRobotParameters(linear_x_max_acceleration=0.5).acceleration_limits().v
    assert (given.max_acceleration, given.max_deceleration) == (0.5, -0.5)
    assert (given.max_acceleration_reverse, given.max_deceleration_reverse) == (-0.5, 0.5)
    given = VirtualRobotParameters(
        angular_z_max_acceleration=2.0, angular_z_max_acceleration_reverse=-3.0
    ).acceleration_limits()
    assert given.omega.max_deceleration == -3.0
    assert given.omega.max_deceleration_reverse == 2.0
    assert given.v.unlimited


def test_a_refused_start_leaves_no_node(lockstep, add):
    with pytest.raises(ParameterError, match='wheel_radius'):
        add(VirtualRobot, wheel_radius=-1.0)
    assert lockstep.node.get_node_names() == ['lockstep']
    add(VirtualRobot)
    assert lockstep.node.get_node_names() == ['lockstep', 'virtual_robot']


def test_one_of_several_changes_that_is_bad_refuses_all_when_atomic(add):
    node = add(GoToGoal)
    changes = [Parameter('kp', value=4.0), Parameter('kv', value=-1.0)]
    assert not node.set_parameters_atomically(changes).successful
    assert (node.parameters.kp, node.parameters.kv) == (3.0, 0.5)
    good, bad = node.set_parameters(changes)
    assert good.successful
    assert not bad.successful
    assert (node.parameters.kp, node.parameters.kv) == (4.0, 0.5)


def test_unknown_parameters_are_named_with_what_was_meant(add, capfd):
    report_unknown([add(GoToGoal, kpp=1.0, kq=2.0, colour='red')])
    said = capfd.readouterr().err
    assert "unknown parameter 'kpp' is ignored; did you mean 'kp'?" in said
    assert "unknown parameter 'kq' is ignored; did you mean 'kp' or 'kv'?" in said
    assert "unknown parameter 'colour' is ignored; see go_to_goal --help" in said
    assert 'qos_overrides' not in said


def test_quality_of_service_can_be_overridden(add):
    node = add(VirtualRobot, **{'qos_overrides./odom.publisher.reliability': 'best_effort'})
    (info,) = node.get_publishers_info_by_topic('/odom')
    assert info.qos_profile.reliability.name == 'BEST_EFFORT'
    (info,) = node.get_publishers_info_by_topic('/joint_states')
    assert info.qos_profile.reliability.name == 'RELIABLE'
    for override, value in (
        *(('depth', depth) for depth in (2**63 - 1, 2**31, -(2**63), -1)),
        ('history', 'keep_none'),
        ('reliability', ''),
    ):
        with pytest.raises(ParameterError) as caught:
            add(VirtualRobot, **{f'qos_overrides./odom.publisher.{override}': value})
        message = str(caught.value)
        assert message.startswith('the qos_overrides of /odom are invalid: ')
        assert message.endswith(f'(got publisher.{override}: {value})')
        assert '\n' not in message


def test_the_last_word_counts(tmp_path):
    path = tmp_path / 'parameters.yaml'
    path.write_text('/**/go_to_goal: {ros__parameters: {kp: 5.0, kv: 2, xy_goal_tolerance: 0.1}}')
    arguments = ['--params-file', str(path), '-p', 'kp:=6', '-p', 'go_to_goal:kv:=1.5']
    with ros_context(['test', '--ros-args', *arguments]) as context:
        node = GoToGoal(context=context)
        assert (node.parameters.kp, node.parameters.kv) == (6.0, 1.5)
        node.set_parameters([Parameter('kp', value=7)])
        assert node.parameters.kp == node.get_parameter('kp').value == 7.0
        assert node.parameters.xy_goal_tolerance == 0.1
        node.destroy_node()
