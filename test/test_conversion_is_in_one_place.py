"""Stamps are written, and the order of the wheels is converted, by the package `messages` only."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import diffdrive_jacobian
from diffdrive_jacobian.messages import conversion, wire
from diffdrive_jacobian.ros.serialization import reader

PACKAGE = Path(diffdrive_jacobian.__file__).parent
FIELDS = {'sec', 'nanosec', 'velocity', 'position', 'data'}
"""Fields of stamps, of joint states and of arrays of wheel speeds."""
MESSAGES = {'stamp', 'clock', 'message', '_message', '_states'}
"""Names of messages and of fields that have these fields."""


def writers():
    for path in PACKAGE.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.ctx, ast.Store)
                and node.attr in FIELDS
                and (getattr(node.value, 'attr', None) or getattr(node.value, 'id', None)) in MESSAGES
            ):
                yield str(path.relative_to(PACKAGE)), node.attr


def test_only_the_conversion_writes_stamps_and_wheels():
    found = set(writers())
    assert {path for path, _ in found} == {'messages/conversion.py', 'messages/wire.py'}
    assert {field for _, field in found} == FIELDS


def test_no_module_assigns_a_stamp_of_its_own_making():
    """Copies of received stamps are assigned, but none that `to_msg` creates."""
    calls = [
        path.name for path in PACKAGE.rglob('*.py') if '.to_msg()' in path.read_text(encoding='utf-8')
    ]
    assert calls == []


@pytest.mark.parametrize('angles', [None, (0.5, -0.5)])
def test_wheels_are_left_right_in_messages_and_right_left_in_the_library(angles):
    state, time, speeds = JointState(name=['left', 'right']), 1_500_000_000, (3.0, 2.0)
    if angles is None:
        data = wire.joint_command_writer(state)(time, speeds)
    else:
        data = wire.joint_state_writer(state)(time, speeds, angles)
    state = deserialize_message(data, JointState)
    data = wire.wheel_array_writer(Float64MultiArray())(time, speeds)
    array = deserialize_message(data, Float64MultiArray)
    assert list(state.velocity) == list(array.data) == [2.0, 3.0]
    assert list(state.position) == ([] if angles is None else [-0.5, 0.5])
    assert (state.header.stamp.sec, state.header.stamp.nanosec) == (1, 500_000_000)
    assert conversion.from_joint_state(state, ('left', 'right')) == speeds
    assert reader(JointState, wire.JOINT_STATE)(
        wire.joint_command_writer(JointState(name=['left', 'right']))(time, speeds)
    ) == (1, 500_000_000, ('left', 'right'), (2.0, 3.0))
