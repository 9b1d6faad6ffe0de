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

"""What `doctor` finds: pure functions over descriptions, no ROS."""

from __future__ import annotations

import fcntl
from dataclasses import replace

import pytest

from diffdrive_jacobian.diagnosis.graph import (
    ClockMessages,
    Endpoint,
    Graph,
    Participant,
    Quality,
    Stream,
    check_clocks,
    check_topics,
    mismatch,
)
from diffdrive_jacobian.diagnosis.machine import (
    INSTALLATION,
    ROS_PACKAGES,
    WHEELS,
    Environment,
    SharedMemory,
    check_environment,
    check_shared_memory,
    environment,
    shared_memory,
)
from diffdrive_jacobian.parameters.wheels import Dimensions
from diffdrive_jacobian.text import listed

TWIST, STAMPED = 'geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped'
ODOMETRY, STATES = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/JointState'
CLOCK = 'rosgraph_msgs/msg/Clock'


def publisher(node, topic, kind=TWIST, **quality):
    return Endpoint(node, topic, kind, True, Quality(**quality))


def subscription(node, topic, kind=TWIST, **quality):
    return Endpoint(node, topic, kind, False, Quality(**quality))


PAIR = (
    publisher('/go_to_goal', '/cmd_vel'),
    subscription('/virtual_robot', '/cmd_vel'),
    publisher('/virtual_robot', '/odom', ODOMETRY),
    subscription('/go_to_goal', '/odom', ODOMETRY),
)
NODES = (Participant('/go_to_goal', False), Participant('/virtual_robot', False))


def graph(*endpoints, nodes=NODES, **others):
    return Graph(nodes=nodes, endpoints=endpoints, **others)


def check(findings, words, problems=1):
    """Check that something is found, in these words, with a remedy, and how many problems it is."""
    findings = list(findings)
    assert all(one.remedy for one in findings)
    assert words in '\n'.join(f'{one.what} -> {one.remedy}' for one in findings)
    assert (sum(one.problem for one in findings), bool(findings)) == (problems, bool(words))


# --- Topics


SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ('offered', 'requested', 'word'),
    [
        ({'reliability': 'BEST_EFFORT'}, {}, 'reliability'),
        ({}, {'durability': 'TRANSIENT_LOCAL'}, 'durability'),
        ({}, {'deadline': SECOND}, 'deadline: it offers no limit, 1 s is requested'),
        ({'deadline': 2 * SECOND}, {'deadline': SECOND}, 'deadline: it offers 2 s'),
        ({}, {'liveliness': 'MANUAL_BY_TOPIC'}, 'liveliness: '),
        ({'lease': 2 * SECOND}, {'lease': SECOND}, 'lease'),
    ],
)
def test_quality_that_does_not_match_is_a_problem(offered, requested, word):
    (reason,) = mismatch(Quality(**offered), Quality(**requested))
    assert reason.startswith(word)
    # The other way round it matches.
    assert mismatch(Quality(**requested), Quality(**offered)) == []
    pair = publisher('/a', '/x', **offered), subscription('/b', '/x', **requested)
    check(check_topics(graph(*pair)), '/b receives nothing of /a on /x')
    others = publisher('/c', '/x', **requested)
    check(check_topics(graph(*pair, others)), 'It receives the other publishers.')


TOPICS = {
    f'as {TWIST}, but /robot subscribes to it as {STAMPED}': (
        (PAIR[0], subscription('/robot', '/cmd_vel', STAMPED)),
        1,
    ),
    '/go_to_goal publishes /cmd_vel, but nobody subscribes': (PAIR[:1], 1),
    # A near miss.
    '/r/robot subscribes to /r/cmd_vel': ((PAIR[0], subscription('/r/robot', '/r/cmd_vel')), 1),
    'start wheel_bridge': ((subscription('/virtual_robot', '/joint_command', STATES),), 1),
    # In general a topic needs no reader.
    '': ((publisher('/robot', '/odom', ODOMETRY), subscription('/robot', '/cmd_vel')), 0),
    '/other and /virtual_robot publish /odom': ((*PAIR, publisher('/other', '/odom', ODOMETRY)), 1),
    '/go_to_goal and /teleop publish /cmd_vel': ((*PAIR, publisher('/teleop', '/cmd_vel')), 0),
}


def test_topics_that_do_not_fit_are_named_with_a_remedy():
    check(check_topics(graph(*PAIR)), '', 0)
    for words, (endpoints, problems) in TOPICS.items():
        check(check_topics(graph(*endpoints)), words, problems)
    twice = graph(*PAIR, nodes=(*NODES, NODES[0]))
    check(check_topics(twice), '2 nodes have the name /go_to_goal')
    check(check_topics(twice), 'a ROS_DOMAIN_ID of your own keeps it away')


def test_wheels_that_differ_are_a_problem():
    speeds = (
        publisher('/bridge', '/r/joint_command', STATES),
        subscription('/robot', '/r/joint_command', STATES),
    )

    def of_wheels(robot):
        bridge = Participant('/bridge', False, Dimensions(0.05, 0.05, 0.2))
        return check_topics(graph(*speeds, nodes=(bridge, Participant('/robot', False, robot))))

    for same in (Dimensions(0.05, 0.05, 0.2), None):
        check(of_wheels(same), '', 0)
    other = Dimensions(0.06, 0.06, 0.3)
    check(of_wheels(other), '/robot has wheel_radius 0.06 m instead of 0.05 m')
    check(of_wheels(other), 'and wheel_separation 0.3 m instead of 0.2 m')
    check(of_wheels(other), 'it drives 1.2 times and turns 0.8 times as fast')
    check(of_wheels(other), 'as commanded by /bridge')


def test_names_are_listed():
    assert listed(['/b', '/a', '/b']) == '/a and /b (2 times)'
    assert listed(['/c', '/b', '/a']) == '/a, /b and /c'


# --- Clocks


TIME = publisher('/simulator', '/clock', CLOCK)
SIMULATED = (Participant('/go_to_goal', True), Participant('/virtual_robot', True))
RUNNING = ClockMessages(messages=100, advanced=3.0)


def test_simulated_time_needs_one_running_clock():
    others = {'nodes': SIMULATED, 'seconds': 3.0}
    cases = {
        '': graph(*PAIR, TIME, clock=RUNNING, **others),
        'nobody publishes /clock': graph(*PAIR, **others),
        '/replay_run and /simulator publish /clock': graph(
            *PAIR, TIME, publisher('/replay_run', '/clock', CLOCK), clock=RUNNING, **others
        ),
        'nothing was received on /clock in 3.0 s': graph(*PAIR, TIME, **others),
        'stands still': graph(*PAIR, TIME, clock=ClockMessages(messages=9), **others),
        'went back 2 times': graph(*PAIR, TIME, clock=replace(RUNNING, went_back=2), **others),
    }
    for words, described in cases.items():
        check(check_clocks(described), words, int(words != ''))


def test_a_node_with_another_clock_is_a_problem():
    nodes = (SIMULATED[0], NODES[1], Participant('/unknown', None))
    mixed = graph(*PAIR, TIME, nodes=nodes, clock=RUNNING, seconds=3.0)
    check(check_clocks(mixed), '/go_to_goal uses simulated time, /virtual_robot does not')
    unused = graph(*PAIR, TIME, clock=RUNNING, seconds=3.0)
    check(check_clocks(unused), 'but no node uses it', problems=0)


@pytest.mark.parametrize(
    ('age', 'simulated_age', 'words'),
    [
        (0.02, None, ''),
        (3600.0, None, '3.6e+03 s old'),
        (-5.0, None, '5 s in the future'),
        (3600.0, 0.01, '3.6e+03 s old'),
        (None, None, ''),
    ],
)
def test_stamps_far_from_the_time_are_a_problem(age, simulated_age, words):
    stream = Stream(topic='/odom', messages=5, rate=50.0, age=age, simulated_age=simulated_age)
    check(check_clocks(graph(*PAIR, streams=(stream,))), words, int(words != ''))


@pytest.mark.parametrize('nodes', [SIMULATED, ()])
def test_stamps_of_simulated_time_and_of_an_unknown_clock_are_compared_with_it(nodes):
    stream = Stream(topic='/odom', messages=5, rate=50.0, age=1e9, simulated_age=0.01)
    others = {'nodes': nodes, 'clock': RUNNING, 'seconds': 3.0}
    findings = check_clocks(graph(*PAIR, TIME, streams=(stream,), **others))
    assert not any(one.problem for one in findings)


# --- Machine


def test_segments_of_killed_processes_are_found(tmp_path):
    for name, size in (('fastrtps_dead', 1000), ('fastrtps_alive', 500)):
        (tmp_path / name).write_bytes(bytes(size))
        (tmp_path / f'{name}_el').touch()
    with (tmp_path / 'fastrtps_alive_el').open('w') as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        memory = shared_memory(tmp_path)
    assert (memory.stale, memory.stale_bytes, memory.writable) == (1, 1000, True)
    assert shared_memory(tmp_path / 'nowhere') is None


def test_full_shared_memory_is_a_problem_and_stale_segments_are_a_note():
    memory = SharedMemory(size=10**9, free=10**8)
    check(check_shared_memory(memory), '', 0)
    stale = replace(memory, stale=3, stale_bytes=2_000_000)
    check(check_shared_memory(stale), '3 segments of killed processes', 0)
    check(check_shared_memory(stale), 'shm clean', 0)
    check(check_shared_memory(replace(memory, free=1000)), 'is full: 1.0 kB of 1.0 GB are free')
    for missing in (None, replace(memory, writable=False)):
        assert not any(one.problem for one in check_shared_memory(missing))


# --- Environment


SOURCES = dict.fromkeys(ROS_PACKAGES, WHEELS)
USUAL = Environment(python='3.12.3', versions={'rclpy': '7.1.6'}, sources=SOURCES)


VARIABLES = [
    ('ROS_DOMAIN_ID', '101', '', 0),
    ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST', '', 0),
    ('ROS_DOMAIN_ID', '233', "must be in 0 to 232, got '233'", 1),
    ('ROS_DOMAIN_ID', '٣', 'must be in 0 to 232', 1),
    ('ROS_DOMAIN_ID', '150', 'can be taken by other programs', 0),
    ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF', 'no other process is found', 1),
    ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'localhost', 'SUBNET is used', 1),
    ('ROS_LOCALHOST_ONLY', '1', 'deprecated', 0),
    ('ROS_LOCALHOST_ONLY', 'true', 'must be 0 or 1', 1),
    ('ROS_DISCOVERY_SERVER', '10.0.0.1', 'ROS_SUPER_CLIENT', 0),
    ('ROS_DISTRO', 'humble', 'ROS_DISTRO is humble', 0),
    ('FASTRTPS_DEFAULT_PROFILES_FILE', '/nowhere.xml', 'does not exist', 1),
]
INSTALLATIONS = {
    'two installations of ROS are mixed: ': {'sources': {**SOURCES, 'rclpy': INSTALLATION}},
    'there is no rclpy, geometry_msgs': {'sources': {}},
    'rclpy 9.1.0 is not that of ROS 2 Jazzy': {'versions': {'rclpy': '9.1.0'}},
    'the loopback interface is down': {'loopback': False},
    'is rmw_x, which is not installed': {
        'rmw_missing': True,
        'variables': {'RMW_IMPLEMENTATION': 'rmw_x'},
    },
}


def test_variables_that_keep_nodes_apart_and_installations_that_do_not_suit():
    check(check_environment(USUAL), '', 0)
    for name, value, words, problems in VARIABLES:
        check(check_environment(replace(USUAL, variables={name: value})), words, problems)
    for words, changes in INSTALLATIONS.items():
        check(check_environment(replace(USUAL, **changes)), words)


def test_the_reach_of_the_discovery():
    for variables, reach in (
        ({}, 'SUBNET'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, 'OFF'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', 'ROS_LOCALHOST_ONLY': '1'}, 'LOCALHOST'),
        ({'ROS_LOCALHOST_ONLY': '0'}, 'SUBNET'),
        ({'ROS_LOCALHOST_ONLY': 'true'}, 'SUBNET'),
    ):
        assert replace(USUAL, variables=variables).reach == reach


def test_the_environment_of_the_tests_is_found(monkeypatch):
    monkeypatch.delenv('RMW_IMPLEMENTATION', raising=False)
    here = environment()
    assert set(here.sources) == set(ROS_PACKAGES)
    assert len(set(here.sources.values())) == 1
    assert here.loopback
    assert not here.rmw_missing
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_nobody_has')
    assert environment().rmw_missing
