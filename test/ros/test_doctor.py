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

"""The tool doctor: its report, its exit codes, and what its node observes."""

from __future__ import annotations

import json

import pytest
from rclpy.node import Node
from sensor_msgs.msg import JointState

from diffdrive_jacobian.diagnosis.graph import Graph, Participant
from diffdrive_jacobian.diagnosis.machine import SharedMemory
from diffdrive_jacobian.diagnosis.observation import Observer
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import doctor


@pytest.fixture
def observed(monkeypatch):
    """Set what the tool observes, in an environment without problems."""
    monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE', raising=False)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    graph = Graph()
    monkeypatch.setattr(doctor, 'shared_memory', lambda: SharedMemory(size=10**9, free=10**9))
    monkeypatch.setattr(doctor, '_observe', lambda *_: ('rmw_fastrtps_cpp', graph))

    def observe(value):
        nonlocal graph
        graph = value

    return observe


def test_an_observer_describes_what_it_sees(ros):
    observer = ros.add(Observer, name='_doctor')
    ros.add(VirtualRobot, parameters={'publish_rate': 100.0})
    ros.add(Node, node_name='simulated', parameters={'use_sim_time': True})
    states = ros.peer.create_publisher(JointState, 'joint_command', 10)
    message = JointState()
    message.header.stamp.sec = 5
    ros.peer.create_timer(0.05, lambda: states.publish(message))

    def described():
        return observer.describe(1.0)

    def complete():
        graph = described()
        streams = {one.topic: one.messages for one in graph.streams}
        heard = min(streams.get('/odom', 0), streams.get('/joint_command', 0))
        return heard > 2 and all(node.use_sim_time is not None for node in graph.nodes)

    ros.until(complete, 'messages and clocks are known')
    graph = described()
    clocks = {node.name: node.use_sim_time for node in graph.nodes}
    assert clocks == {'/peer': False, '/simulated': True, '/virtual_robot': False}
    ends = {(one.node, one.topic, one.publishes) for one in graph.endpoints}
    assert {('/virtual_robot', '/odom', True), ('/virtual_robot', '/cmd_vel', False)} <= ends
    assert not any('_doctor' in node for node, *_ in ends)
    (start,) = graph.publishers('/start_pose')
    assert (start.kind, start.quality.durability) == (
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        'TRANSIENT_LOCAL',
    )
    streams = {one.topic: one for one in graph.streams}
    assert abs(streams['/odom'].age) < 10.0
    assert streams['/joint_command'].age > 1e6
    assert streams['/odom'].rate > 1.0


def test_an_observer_ignores_names_that_cannot_be_queried(ros, monkeypatch):
    """As of programs that use DDS without ROS, or too long for a service."""
    long = {'start_type_description_service': False}
    ros.add(Node, node_name='n' * 240, start_parameter_services=False, parameters=long)
    ros.add(Node, node_name='usual')
    observer = ros.add(Observer, name='_doctor')
    others = [('/not-a-name', ['a/msg/B']), ('/9', ['nav_msgs/msg/Odometry'])]
    query = observer.get_topic_names_and_types
    monkeypatch.setattr(observer, 'get_topic_names_and_types', lambda: [*query(), *others])

    def clocks():
        return {node.name: node.use_sim_time for node in observer.describe(1.0).nodes}

    ros.until(lambda: clocks().get('/usual') is False, 'the clock is known')
    assert any('nnn' in name for name in clocks())
    assert '/not-a-name' not in observer.describe(1.0).topics()


def test_exit_code_and_report_depend_on_problems(observed, capsys):
    assert doctor.main([], Signals()) == 0
    assert capsys.readouterr().out.endswith('\n0 problems found\n')
    observed(Graph(nodes=(Participant('/a', True), Participant('/a', None))))
    assert doctor.main([], Signals()) == 1
    said = capsys.readouterr().out
    assert '2 nodes found\n  /a (simulated time)\n  /a (clock unknown)\n' in said
    assert 'problem 1: 2 nodes have the name /a\n  remedy: stop one of them' in said
    assert said.endswith('\n2 problems found\n')
    assert doctor.main(['--json'], Signals()) == 1
    report = json.loads(capsys.readouterr().out)
    assert report['graph']['nodes'][0] == {'name': '/a', 'use_sim_time': True, 'wheels': None}
    assert [one['problem'] for one in report['findings']] == [True, True]
    assert report['environment']['versions']['diffdrive_jacobian']


def test_an_environment_in_which_no_node_can_start_is_a_diagnosis(monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', 'lab')
    monkeypatch.setattr(doctor, '_observe', lambda *_: pytest.fail('nodes were searched'))
    assert doctor.main([], Signals()) == 1
    said = capsys.readouterr().out
    assert "ROS_DOMAIN_ID must be in 0 to 232, got 'lab'" in said
    assert 'nodes were not searched' in said


def test_an_import_that_fails_is_a_problem(observed, monkeypatch, capsys):
    def fail(*_):
        raise ImportError('librmw_fastrtps_cpp.so: cannot open\nshared object file')

    monkeypatch.setattr(doctor, '_observe', fail)
    assert doctor.main([], Signals()) == 1
    assert 'ROS cannot be used: librmw_fastrtps_cpp.so: cannot open shared' in capsys.readouterr().out
