"""Stamps are written, and the order of the wheels is converted, by the package `messages` only."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.ros_messages import value_of

import diffdrive_jacobian
from diffdrive_jacobian.messages.codecs import JOINT_STATE, WHEEL_ARRAY, WheelArray, Wheels

PACKAGE = Path(diffdrive_jacobian.__file__).parent
FIELDS = {'sec', 'nanosec'}
"""Fields of stamps."""
MESSAGES = {'stamp', 'clock', 'message', '_message', '_states'}
"""Names of messages and of fields that have these fields."""


def writers():
    for path in PACKAGE.rglob('*.py'):
        text = path.read_text(encoding='utf-8')
        # To parse a module takes long.
        if not re.search(rf'\.\s*({"|".join(FIELDS)})\b', text):
            continue
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.ctx, ast.Store)
                and node.attr in FIELDS
                and (getattr(node.value, 'attr', None) or getattr(node.value, 'id', None)) in MESSAGES
            ):
                yield str(path.relative_to(PACKAGE)), node.attr


def test_only_the_conversion_writes_stamps_and_wheels():
    found = set(writers())
    assert {path for path, _ in found} == {'messages/conversion.py'}
    assert {field for _, field in found} == FIELDS


def test_no_module_assigns_a_stamp_of_its_own_making():
    """Copies of received stamps are assigned, but none that `to_msg` creates."""
    calls = [
        path.name for path in PACKAGE.rglob('*.py') if '.to_msg()' in path.read_text(encoding='utf-8')
    ]
    assert calls == []


@pytest.mark.parametrize('angles', [None, (0.5, -0.5)])
def test_wheels_are_left_right_in_messages_and_right_left_in_the_library(angles):
    names, time, speeds = ('left', 'right'), 1_500_000_000, (3.0, 2.0)
    template = JointState(name=[*names], velocity=[0.0, 0.0])
    if angles is not None:
        template.position = [0.0, 0.0]
    data = JOINT_STATE.writer(template)(Wheels.of(time, names, speeds, angles))
    state = deserialize_message(data, JointState)
    data = WHEEL_ARRAY.writer(Float64MultiArray(data=[0.0, 0.0]))(WheelArray.of(speeds))
    array = deserialize_message(data, Float64MultiArray)
    assert list(state.velocity) == list(array.data) == [2.0, 3.0]
    assert list(state.position) == ([] if angles is None else [-0.5, 0.5])
    assert (state.header.stamp.sec, state.header.stamp.nanosec) == (1, 500_000_000)
    assert (
        value_of(JOINT_STATE, state).speeds(names)
        == value_of(WHEEL_ARRAY, array).speeds(names)
        == speeds
    )
