"""A recorder survives any answer of a node to a query of its parameters."""

from __future__ import annotations

import json

import pytest
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from support.recorded import LockstepRecording

from diffdrive_jacobian.bags.bounded_reader import BoundedReader
from diffdrive_jacobian.bags.journal import PARAMETERS
from diffdrive_jacobian.recording import parameter_query
from diffdrive_jacobian.recording.parameter_query import ParameterQuery

VALUES = {f'parameter_{index}': ParameterValue(type=2, integer_value=index) for index in range(20)}


class Stranger(Node):
    """Publishes, and answers requests for parameters in its own way."""

    def __init__(self, names, answer):
        super().__init__('stranger', start_parameter_services=False)
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


def none(names):
    return []


def recorded_parameters(lockstep, tmp_path, stranger):
    """Record beside a stranger; gives what the bag holds of its parameters."""
    lockstep.add(stranger)
    recording = LockstepRecording(lockstep, tmp_path / 'run')
    recording.look()
    lockstep.run_for(0.1)
    stranger.publisher.publish(Twist())
    lockstep.run_for(0.1)
    recording.finish()
    # Whatever it answers, its messages are recorded.
    assert recording.summary.topics['/cmd_vel'] == 1
    reader = BoundedReader(tmp_path / 'run')
    reader.open()
    text = dict(reader.storage.metadata.custom).get(f'{PARAMETERS}/stranger')
    reader.close()
    return None if text is None else json.loads(text)


INTEGERS = {name: value.integer_value for name, value in VALUES.items()}


@pytest.mark.parametrize('answer', [as_rclcpp, omitting, known, one_more])
@pytest.mark.parametrize('unset', [(), ('unset', 'other', 'third')])
def test_what_can_be_had_is_recorded(lockstep, tmp_path, capfd, answer, unset):
    names = [*list(VALUES)[:7], *unset, *list(VALUES)[7:]]
    stranger = Stranger(names, answer)
    assert recorded_parameters(lockstep, tmp_path, stranger) == INTEGERS
    said = capfd.readouterr().err
    if unset:
        assert said.count('parameters of /stranger are not all recorded: ') == 1
        assert all(name in said for name in unset)
        assert stranger.asked < 2 * len(names)
    else:
        assert 'not all recorded' not in said


def test_known_types_are_recorded_and_others_left_out(lockstep, tmp_path, capfd):
    recordable = {
        'flag': (True, ParameterValue(type=1, bool_value=True)),
        'number': (0.5, ParameterValue(type=3, double_value=0.5)),
        'text': ('a "b"', ParameterValue(type=4, string_value='a "b"')),
        'bytes': ([[1], [255]], ParameterValue(type=5, byte_array_value=[b'\x01', b'\xff'])),
        'flags': ([True, False], ParameterValue(type=6, bool_array_value=[True, False])),
        'integers': ([1, -2], ParameterValue(type=7, integer_array_value=[1, -2])),
        'numbers': ([0.5, 1.5], ParameterValue(type=8, double_array_value=[0.5, 1.5])),
        'texts': (['a', 'b'], ParameterValue(type=9, string_array_value=['a', 'b'])),
    }
    values = {name: value for name, (_, value) in recordable.items()}
    unknown = {f'of_type_{kind}': ParameterValue(type=kind) for kind in (10, 11, 128, 255)}
    unknown['too_large'] = ParameterValue(type=4, string_value='x' * (parameter_query.MAX_TEXT + 1))
    values |= unknown
    stranger = Stranger(values, lambda names: [values[name] for name in names])
    assert recorded_parameters(lockstep, tmp_path, stranger) == {
        name: value for name, (value, _) in recordable.items()
    }
    said = capfd.readouterr().err
    assert all(f'no value of {name}' in said or name in said for name in unknown)


def test_a_node_that_answers_nothing_is_recorded_without(lockstep, tmp_path, capfd):
    names = [*VALUES, '\x1b[2J', 'y' * 500]
    assert recorded_parameters(lockstep, tmp_path, Stranger(names[::-1], none)) is None
    said = capfd.readouterr().err
    assert 'and 17 more' in said
    # Names are printed in short, without control characters.
    assert '\x1b[2J' not in said
    assert '\\x1b[2J' in said
    assert 'y' * 81 not in said


def test_duplicate_and_strange_names(lockstep, tmp_path):
    names = ['parameter_1', 'parameter_1', '', 'ä.b', 'a\nb', '\x1b[2J', 'x' * 10_000]
    found = recorded_parameters(lockstep, tmp_path, Stranger(names, omitting))
    assert found == {'parameter_1': 1}


def test_a_node_without_end_of_parameters_is_asked_for_some(lockstep, tmp_path, monkeypatch):
    monkeypatch.setattr(parameter_query, 'MAX_PARAMETERS', 5)
    found = recorded_parameters(lockstep, tmp_path, Stranger(VALUES, known))
    assert found == dict(list(INTEGERS.items())[:5])


def test_an_unset_parameter_of_an_ordinary_node(lockstep, tmp_path):
    """rclpy's own services, which answer as those of rclcpp."""
    node = Node('stranger')
    node.declare_parameter('number', 3)
    node.declare_parameter('unset', Parameter.Type.INTEGER)
    node.publisher = node.create_publisher(Twist, 'cmd_vel', 10)
    found = recorded_parameters(lockstep, tmp_path, node)
    assert found['number'] == 3
    assert 'unset' not in found


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
