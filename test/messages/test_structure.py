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

"""Types of the fields of messages: the same from a class and from a definition."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from contextlib import suppress

import geometry_msgs.msg
import pytest
import rcl_interfaces.msg
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.bags.message_definitions import (
    definition,
    installed_structure,
    is_known,
    known_definition,
    known_structure,
)
from diffdrive_jacobian.messages.structure import (
    Number,
    is_identifier,
    is_stamp,
    structure,
    walk,
)


def installed_types():
    """Yield the classes of messages of the installed packages of interfaces, and their names."""
    for module in pkgutil.iter_modules():
        if module.ispkg and module.name.endswith(('_msgs', '_interfaces')):
            with suppress(ModuleNotFoundError):
                messages = importlib.import_module(f'{module.name}.msg')
                for name, kind in inspect.getmembers(messages, inspect.isclass):
                    yield f'{module.name}/msg/{name}', kind


def test_installed_types_are_the_same_by_their_classes_and_by_their_definitions():
    types = sorted(installed_types())
    assert len(types) > 100
    # Not all: they take a second.
    for name, kind in types[::9]:
        assert installed_structure(name) == structure(kind), name
        if is_known(name) and known_definition(name).type_hash == definition(name).type_hash:
            assert known_structure(name) == structure(kind), name


def test_a_message_is_walked_through_in_order():
    message = Goals(goals=[PoseStamped(), PoseStamped()])
    message.goals[1].pose.position.x = 2.5
    fields = list(walk(structure(Goals), message, whole=is_stamp))
    assert [path for path, _, _ in fields[:5]] == [
        *('header.stamp', 'header.frame_id', 'len(goals)', 'goals[0].header.stamp'),
        'goals[0].header.frame_id',
    ]
    assert ('goals[1].pose.position.x', Number('d'), 2.5) in fields
    paths = {path: value for path, _, value in walk(structure(Odometry), Odometry())}
    assert len(paths['pose.covariance']) == 36


def test_identifiers_and_the_limits_of_integers_are_known():
    assert is_identifier(structure(UUID))
    assert not is_identifier(structure(geometry_msgs.msg.Pose))
    limits = {name: kind.limits for name, kind in structure(rcl_interfaces.msg.IntegerRange).fields}
    assert limits['from_value'] == (-(2**63), 2**63 - 1)
    assert limits['step'] == (0, 2**64 - 1)
    assert Number('?').limits is Number('d').limits is None


def test_parts_of_an_action_are_found():
    actions = pytest.importorskip('test_msgs.action', reason='test_msgs is not installed')
    feedback = structure(actions.Fibonacci.Impl.FeedbackMessage)
    assert [name for name, _ in feedback.fields] == ['goal_id', 'feedback']
    assert feedback.fields[1][1] == structure(actions.Fibonacci.Feedback)
