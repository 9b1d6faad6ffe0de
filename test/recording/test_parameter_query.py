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

"""A recorder survives any answer of a node to a query of its parameters."""

from __future__ import annotations

import re

from geometry_msgs.msg import Twist
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.task import Future
from support.recorded import LockstepRecording

from diffdrive_jacobian.recording import parameter_query
from diffdrive_jacobian.recording.parameter_query import ParameterQuery

VALUES = {f'parameter_{index}': ParameterValue(type=2, integer_value=index) for index in range(20)}
INTEGERS = {name: value.integer_value for name, value in VALUES.items()}
UNSET = ('unset', 'other', 'third')
NAMES = (*list(VALUES)[:7], *UNSET, *list(VALUES)[7:])
RECORDABLE = {
    'flag': (1, 'bool_value', True),
    'number': (3, 'double_value', 0.5),
    'text': (4, 'string_value', 'a "b"'),
    'bytes': (5, 'byte_array_value', [b'\x01', b'\xff']),
    'flags': (6, 'bool_array_value', [True, False]),
    'integers': (7, 'integer_array_value', [1, -2]),
    'numbers': (8, 'double_array_value', [0.5, 1.5]),
    'texts': (9, 'string_array_value', ['a', 'b']),
}
"""Number of the type, its field, and a value."""
UNKNOWN = {f'of_type_{kind}': ParameterValue(type=kind) for kind in (10, 11, 128, 255)}
UNKNOWN['too_large'] = ParameterValue(type=4, string_value='x' * (parameter_query.MAX_TEXT + 1))
TYPES = {
    name: ParameterValue(type=kind, **{field: value})
    for name, (kind, field, value) in RECORDABLE.items()
} | UNKNOWN


class Stranger(Node):
    """Publishes, and answers requests for parameters in its own way."""

    def __init__(self, name, names, answer):
        super().__init__(name, start_parameter_services=False)
        self.names, self.answer = names, answer
        self.asked = 0
        self.publisher = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_service(ListParameters, '~/list_parameters', self._on_list)
        self.create_service(GetParameters, '~/get_parameters', self._on_get)

    def _on_list(self, _, response):
        response.result.names = list(self.names)
        return response

    def _on_get(self, request, response):
        self.asked += 1
        response.values = self.answer(request.names)
        return response


def known(names):
    return [VALUES.get(name, ParameterValue()) for name in names]


def as_rclcpp(names):
    """No values at all if one of them is not there."""
    return known(names) if all(name in VALUES for name in names) else []


def omitting(names):
    return [VALUES[name] for name in names if name in VALUES]


def one_more(names):
    return [*known(names), ParameterValue(type=2, integer_value=99)] if len(names) > 1 else known(names)


def of_all_types(names):
    return [TYPES[name] for name in names]


def recorded_parameters(lockstep, tmp_path, *strangers):
    """Record beside strangers; return the parameters of each that are in the bag."""
    for stranger in strangers:
        lockstep.add(stranger)
    recording = LockstepRecording(lockstep, tmp_path / 'run')
    recording.look()
    lockstep.run_for(0.1)
    for stranger in strangers:
        stranger.publisher.publish(Twist())
    lockstep.run_for(0.1)
    run = recording.finish()
    # Whatever they answer, their messages are recorded.
    assert recording.summary.topics['/cmd_vel'] == len(strangers)
    return [run.parameters.get(f'/{stranger.get_name()}') for stranger in strangers]


def reports(text):
    """Return the reports of missing parameters by node."""
    found = re.findall(r'parameters of /(\w+) are not all recorded: (.*)', text)
    assert len(found) == len(dict(found))
    return dict(found)


def test_what_is_answered_is_recorded_and_the_rest_reported(lockstep, tmp_path, capfd):
    answers = (as_rclcpp, omitting, known, one_more)
    strangers = [Stranger(answer.__name__, NAMES, answer) for answer in answers]
    complete = Stranger('complete', VALUES, known)
    typed = Stranger('typed', TYPES, of_all_types)
    found = recorded_parameters(lockstep, tmp_path, *strangers, complete, typed)
    assert found[:5] == [INTEGERS] * 5
    values = {name: value for name, (_, _, value) in RECORDABLE.items()}
    assert found[5] == {**values, 'bytes': [[1], [255]]}
    said = reports(capfd.readouterr().err)
    assert sorted(said) == sorted([*(one.__name__ for one in answers), 'typed'])
    for stranger in strangers:
        assert all(name in said[stranger.get_name()] for name in UNSET)
        assert stranger.asked < 2 * len(NAMES)
    assert all(name in said['typed'] for name in UNKNOWN)


def test_strange_names_and_a_node_that_answers_nothing(lockstep, tmp_path, capfd):
    """Names are printed in short, without control characters."""
    names = ['parameter_1', 'parameter_1', '', 'ä.b', 'a\nb', '\x1b[2J', 'x' * 10_000]
    strange = Stranger('strange', names, omitting)
    silent = Stranger('silent', ['y' * 500, '\x1b[2J', *VALUES], lambda names: [])
    assert recorded_parameters(lockstep, tmp_path, strange, silent) == [{'parameter_1': 1}, None]
    said = capfd.readouterr().err
    assert 'and 17 more' in reports(said)['silent']
    assert '\x1b[2J' not in said
    assert '\\x1b[2J' in said
    assert 'y' * 81 not in said


def test_a_node_without_end_of_parameters_is_asked_for_some(lockstep, tmp_path, monkeypatch):
    monkeypatch.setattr(parameter_query, 'MAX_PARAMETERS', 5)
    (found,) = recorded_parameters(lockstep, tmp_path, Stranger('endless', VALUES, known))
    assert found == dict(list(INTEGERS.items())[:5])


def advanced(lockstep, name):
    """Return what a query says that gets three chances."""
    said = []
    query = ParameterQuery(lockstep.node, name, said.append, said.append)
    for _ in range(3):
        lockstep.settle()
        query.advance()
    return said


def test_a_node_without_services_is_waited_for_in_silence(lockstep):
    lockstep.add(Node('target', start_parameter_services=False))
    assert advanced(lockstep, '/target') == []


def test_a_node_that_never_answers_is_given_up(lockstep, monkeypatch):
    monkeypatch.setattr(parameter_query, 'PATIENCE', 0.0)
    silent = Node('target', start_parameter_services=False)

    async def never(request, response):
        await Future()

    for kind, name in ((ListParameters, 'list'), (GetParameters, 'get')):
        silent.create_service(kind, f'~/{name}_parameters', never)
    lockstep.add(silent)
    assert advanced(lockstep, '/target') == ['it did not answer within 0 s']


def test_a_node_whose_name_no_service_can_have(lockstep):
    (said,) = advanced(lockstep, '/no such/näme')
    assert said.startswith('its services cannot be called: ')
