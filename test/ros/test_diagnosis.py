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
    Interface,
    SharedMemory,
    check_environment,
    check_network,
    check_shared_memory,
    environment,
    interfaces,
    shared_memory,
)
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


def found(findings):
    """Give what was found in one text, and how many problems it is."""
    findings = list(findings)
    assert all(one.remedy for one in findings)
    return '\n'.join(f'{one.what} -> {one.remedy}' for one in findings), sum(
        one.problem for one in findings
    )


def test_nothing_is_wrong_with_a_robot_and_its_controller():
    assert list(check_topics(graph(*PAIR))) == []
    assert list(check_clocks(graph(*PAIR))) == []


# --- Topics


def test_two_types_of_a_topic_are_a_problem_with_its_parameter():
    text, problems = found(check_topics(graph(PAIR[0], subscription('/robot', '/cmd_vel', STAMPED))))
    assert f'/go_to_goal publishes /cmd_vel as {TWIST}, but /robot subscribes to it as {STAMPED}' in text
    assert ('enable_stamped_cmd_vel' in text, problems) == (True, 1)


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
    text, problems = found(check_topics(graph(*pair)))
    assert ('/b receives nothing of /a on /x' in text, problems) == (True, 1)


def test_a_subscription_that_misses_one_of_two_publishers_is_told_apart():
    endpoints = (
        publisher('/a', '/x', reliability='BEST_EFFORT'),
        publisher('/c', '/x'),
        subscription('/b', '/x'),
    )
    assert 'It receives the other publishers.' in found(check_topics(graph(*endpoints)))[0]
    assert 'other publishers' not in found(check_topics(graph(endpoints[0], endpoints[2])))[0]


def test_a_command_that_nobody_reads_is_a_problem_that_names_the_near_miss():
    text, problems = found(check_topics(graph(PAIR[0], subscription('/r/robot', '/r/cmd_vel'))))
    assert ('/go_to_goal publishes /cmd_vel, but nobody subscribes' in text, problems) == (True, 1)
    assert 'start virtual_robot' in text
    assert '/r/robot subscribes to /r/cmd_vel' in text


def test_missing_publishers_are_problems():
    text, problems = found(
        check_topics(
            graph(
                subscription('/go_to_goal', '/odom', ODOMETRY),
                subscription('/virtual_robot', '/joint_command', STATES),
            )
        )
    )
    assert problems == 2
    assert '/go_to_goal subscribes to /odom, but nobody publishes it' in text
    assert 'start wheel_bridge' in text


def test_topics_without_readers_are_no_problem_in_general():
    endpoints = (
        publisher('/robot', '/joint_states', STATES),
        publisher('/robot', '/odom', ODOMETRY),
        publisher('/robot', '/rosout', 'rcl_interfaces/msg/Log'),
        subscription('/robot', '/cmd_vel'),
        subscription('/go_to_goal', '/goal_pose', 'geometry_msgs/msg/PoseStamped'),
    )
    assert found(check_topics(graph(*endpoints))) == ('', 0)


def test_two_robots_on_one_odom_are_a_problem_and_two_drivers_a_note():
    text, problems = found(check_topics(graph(*PAIR, publisher('/other', '/odom', ODOMETRY))))
    assert ('/other and /virtual_robot publish /odom' in text, problems) == (True, 1)
    text, problems = found(check_topics(graph(*PAIR, publisher('/teleop', '/cmd_vel'))))
    assert ('/go_to_goal and /teleop publish /cmd_vel' in text, problems) == (True, 0)


def test_two_nodes_of_one_name_are_a_problem():
    text, problems = found(check_topics(graph(*PAIR, nodes=(*NODES, NODES[0]))))
    assert ('2 nodes have the name /go_to_goal' in text, problems) == (True, 1)


def test_names_are_listed():
    assert listed(['/b']) == '/b'
    assert listed(['/b', '/a', '/b']) == '/a and /b (2 times)'
    assert listed(['/c', '/b', '/a']) == '/a, /b and /c'


# --- Clocks


TIME = publisher('/simulator', '/clock', CLOCK)
SIMULATED = (Participant('/go_to_goal', True), Participant('/virtual_robot', True))
RUNNING = ClockMessages(messages=100, advanced=3.0)


def test_simulated_time_needs_one_running_clock():
    others = {'nodes': SIMULATED, 'seconds': 3.0}
    assert found(check_clocks(graph(*PAIR, TIME, clock=RUNNING, **others))) == ('', 0)
    cases = {
        'nobody publishes /clock': graph(*PAIR, **others),
        '/replay_run and /simulator publish /clock': graph(
            *PAIR, TIME, publisher('/replay_run', '/clock', CLOCK), clock=RUNNING, **others
        ),
        'nothing was received on /clock in 3.0 s': graph(*PAIR, TIME, **others),
        'stands still': graph(*PAIR, TIME, clock=ClockMessages(messages=9), **others),
        'went back 2 times': graph(*PAIR, TIME, clock=replace(RUNNING, went_back=2), **others),
    }
    for words, described in cases.items():
        text, problems = found(check_clocks(described))
        assert (words in text, problems) == (True, 1), text


def test_a_node_with_another_clock_is_a_problem():
    nodes = (SIMULATED[0], NODES[1], Participant('/unknown', None))
    text, problems = found(check_clocks(graph(*PAIR, TIME, nodes=nodes, clock=RUNNING, seconds=3.0)))
    assert ('/go_to_goal uses simulated time, /virtual_robot does not' in text, problems) == (True, 1)
    text, problems = found(check_clocks(graph(*PAIR, TIME, clock=RUNNING, seconds=3.0)))
    assert ('but no node uses it' in text, problems) == (True, 0)


@pytest.mark.parametrize(
    ('age', 'simulated', 'words'),
    [
        (0.02, None, ''),
        (3600.0, None, '3.6e+03 s old'),
        (-5.0, None, '5 s in the future'),
        # By the clock of its publisher, not by the other one.
        (3600.0, 0.01, '3.6e+03 s old'),
        (None, None, ''),
    ],
)
def test_stamps_far_from_the_time_are_a_problem(age, simulated, words):
    stream = Stream(topic='/odom', messages=5, rate=50.0, age=age, simulated_age=simulated)
    text, problems = found(check_clocks(graph(*PAIR, streams=(stream,))))
    assert (words in text, problems) == (True, int(words != ''))


def test_stamps_of_simulated_time_and_of_an_unknown_clock_are_compared_with_it():
    stream = Stream(topic='/odom', messages=5, rate=50.0, age=1e9, simulated_age=0.01)
    for nodes in (SIMULATED, ()):
        others = {'nodes': nodes, 'clock': RUNNING, 'seconds': 3.0}
        assert found(check_clocks(graph(*PAIR, TIME, streams=(stream,), **others)))[1] == 0


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
    assert found(check_shared_memory(memory)) == ('', 0)
    text, problems = found(check_shared_memory(replace(memory, stale=3, stale_bytes=2_000_000)))
    assert ('3 segments of killed processes' in text, 'shm clean' in text, problems) == (True, True, 0)
    text, problems = found(check_shared_memory(replace(memory, free=1000)))
    assert ('is full: 1.0 kB of 1.0 GB are free' in text, problems) == (True, 1)
    for missing in (None, replace(memory, writable=False)):
        assert found(check_shared_memory(missing))[1] == 0


LOOPBACK = Interface('lo', up=True, loopback=True, multicast=False)
WIRED = Interface('eth0', up=True, loopback=False, multicast=True)


def test_loopback_and_multicast_are_checked():
    assert found(check_network((LOOPBACK, WIRED), 'SUBNET', '')) == ('', 0)
    assert found(check_network((), 'SUBNET', '')) == ('', 0)
    text, problems = found(check_network((replace(LOOPBACK, up=False), WIRED), 'LOCALHOST', ''))
    assert ('loopback interface is down' in text, problems) == (True, 1)
    deaf = replace(WIRED, multicast=False)
    text, problems = found(check_network((LOOPBACK, deaf), 'SUBNET', ''))
    assert ('no network interface has multicast (eth0)' in text, problems) == (True, 1)
    # On this machine multicast is not needed.
    assert found(check_network((LOOPBACK, deaf), 'LOCALHOST', ''))[1] == 0
    assert (
        'does not work (no message'
        in found(check_network((LOOPBACK, WIRED), 'SUBNET', 'no message arrives'))[0]
    )


def test_this_machine_has_a_loopback_interface():
    assert any(one.loopback for one in interfaces())


# --- Environment


SOURCES = dict.fromkeys(ROS_PACKAGES, WHEELS)
USUAL = Environment(python='3.12.3', versions={'rclpy': '7.1.6'}, sources=SOURCES)


@pytest.mark.parametrize(
    ('variables', 'words', 'expected'),
    [
        ({}, '', 0),
        ({'ROS_DOMAIN_ID': '101', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, '', 0),
        ({'ROS_DOMAIN_ID': '233'}, "must be in 0 to 232, got '233'", 1),
        ({'ROS_DOMAIN_ID': 'x'}, "got 'x'", 1),
        ({'ROS_DOMAIN_ID': '٣'}, 'must be in 0 to 232', 1),
        ({'ROS_DOMAIN_ID': '150'}, 'can be taken by other programs', 0),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, 'no other process is found', 1),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'localhost'}, "got 'localhost': SUBNET is used", 1),
        ({'ROS_LOCALHOST_ONLY': '1'}, 'deprecated', 0),
        ({'ROS_LOCALHOST_ONLY': 'true'}, "must be 0 or 1, got 'true': it has no effect", 1),
        ({'ROS_DISCOVERY_SERVER': '10.0.0.1'}, 'ROS_SUPER_CLIENT', 0),
        ({'ROS_DISTRO': 'humble'}, 'ROS_DISTRO is humble', 0),
        ({'FASTRTPS_DEFAULT_PROFILES_FILE': '/nowhere.xml'}, 'does not exist: /nowhere.xml', 1),
    ],
)
def test_variables_that_keep_nodes_apart(variables, words, expected):
    text, problems = found(check_environment(replace(USUAL, variables=variables)))
    assert (words in text, problems) == (True, expected)
    assert bool(text) == bool(words)


def test_installations_that_do_not_suit():
    cases = {
        'two installations of ROS are mixed: ': {'sources': {**SOURCES, 'rclpy': INSTALLATION}},
        'there is no rclpy, geometry_msgs': {'sources': {}},
        'rclpy 9.1.0 is not that of ROS 2 Jazzy': {'versions': {'rclpy': '9.1.0'}},
        'is rmw_x, which is not installed': {
            'rmw_missing': True,
            'variables': {'RMW_IMPLEMENTATION': 'rmw_x'},
        },
    }
    for words, changes in cases.items():
        text, problems = found(check_environment(replace(USUAL, **changes)))
        assert (words in text, problems) == (True, 1), text


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
    assert not here.rmw_missing
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_nobody_has')
    assert environment().rmw_missing
