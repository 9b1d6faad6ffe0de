"""What is wrong in the graph is reported. It is queried after changes only, once for all nodes."""

from __future__ import annotations

import gc
import weakref
from collections import Counter

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import String
from support.domains import domain_id
from support.harness import Harness

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros import node as ros_node
from diffdrive_jacobian.ros import rclpy_internals
from diffdrive_jacobian.ros.node import FAULT_PATIENCE
from diffdrive_jacobian.ros.runner import make_executor, ros_context

QUERIES = ('count_publishers', 'count_subscribers', 'get_topic_names_and_types')


@pytest.fixture
def queries(monkeypatch):
    """Numbers of queries of the graph, by method."""
    counts = Counter()

    def counted(name, query):
        def method(node, *args):
            counts[(name, *args)] += 1
            return query(node, *args)

        return method

    for name in QUERIES:
        monkeypatch.setattr(Node, name, counted(name, getattr(Node, name)))
    return counts


@pytest.fixture
def context():
    with ros_context(['test']) as context:
        yield context


@pytest.fixture
def create(context):
    """Create a node, which is destroyed at the end."""
    nodes = []

    def create(node_class, name, context=context):
        named = {'node_name': name} if node_class is Node else {'namespace': name}
        nodes.append(node_class(context=context, **named))
        return nodes[-1]

    yield create
    for node in nodes:
        node.destroy_node()


def check(*nodes, times=FAULT_PATIENCE):
    """Let nodes check the graph, as their timers do once a second."""
    for _ in range(times):
        for node in nodes:
            node._check_graph()


def test_nothing_is_queried_while_the_graph_stays_the_same(create, queries):
    team = [create(one, f'robot_{n}') for n in range(2) for one in (VirtualRobot, GoToGoal)]
    check(*team, times=1)
    assert queries['get_topic_names_and_types',] == 1
    # Also where robot and controller check the same topic.
    assert {queries['count_publishers', f'/robot_{n}/odom'] for n in range(2)} == {1}
    assert queries['count_publishers', '/robot_0/goal_pose'] == 1
    assert set(queries.values()) == {1}
    queries.clear()
    check(*team, times=3)
    assert queries == {}
    team[0].create_publisher(String, 'word', 1)
    check(*team, times=3)
    assert set(queries.values()) == {1}


def test_a_fault_that_appears_after_many_checks_is_reported_each_time_by_each_node(create, capfd):
    robots = [create(VirtualRobot, name) for name in ('first', 'a', 'b')]
    other = create(Node, 'other')
    check(*robots, times=20)
    # The first node of a context takes the signal of a change.
    robots.pop(0).destroy_node()
    for _ in range(2):
        publishers = [other.create_publisher(Odometry, f'/{name}/odom', 1) for name in ('a', 'b')]
        check(*robots, times=FAULT_PATIENCE - 1)
        assert 'publish /a/odom' not in capfd.readouterr().err
        check(*robots, times=1)
        said = capfd.readouterr().err
        assert '/a/virtual_robot and /other publish /a/odom' in said
        assert '/b/virtual_robot and /other publish /b/odom' in said
        for publisher in publishers:
            other.destroy_publisher(publisher)
        check(*robots, times=20)


def test_contexts_have_graphs_of_their_own(create, queries):
    with ros_context(['other']) as second:
        robots = [create(VirtualRobot, 'a'), create(VirtualRobot, 'a', context=second)]
        check(*robots, times=1)
        queries.clear()
        robots[1].create_publisher(String, 'word', 1)
        check(robots[0])
        assert queries == {}
        check(robots[1])
        assert queries['count_publishers', '/a/odom'] == 1
        robots[1].destroy_node()


def test_a_context_is_released():
    with ros_context(['test']) as context:
        robot = VirtualRobot(context=context)
        check(robot)
        robot.destroy_node()
    reference = weakref.ref(context)
    del context, robot
    gc.collect()
    assert reference() is None


def test_without_the_signal_of_rcl_every_check_queries(monkeypatch, create, queries):
    """Libraries without the functions that signal changes of the graph."""
    rclpy_internals._graph_functions.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(rclpy_internals.ctypes, 'CDLL', lambda _: object())
        check(create(VirtualRobot, 'a'), times=3)
    rclpy_internals._graph_functions.cache_clear()
    assert queries['count_publishers', '/a/odom'] == 3


def test_other_types_are_reported_once_until_they_are_gone(create, queries, capfd, monkeypatch):
    controller = create(GoToGoal, 'a')
    check(controller)
    queries.clear()
    # Where the types match, no endpoint is looked at.
    check(controller, times=2)
    assert queries == {}
    infos = [info for _ in range(2) for info in controller.get_publishers_info_by_topic('/a/cmd_vel')]
    kinds = [f'geometry_msgs/msg/{name}' for name in ('Twist', 'TwistStamped', 'Vector3')]
    for info, other in zip(infos, kinds[1:], strict=True):
        info.topic_type = other
    controller._graph.types()['/a/cmd_vel'] = kinds
    monkeypatch.setattr(controller, 'get_subscriptions_info_by_topic', lambda _: infos)

    def reports():
        check(controller)
        said = capfd.readouterr().err
        return [said.count(f'/a/cmd_vel as {kind}, but this node publishes it as') for kind in kinds]

    assert reports() == [0, 1, 1]
    assert reports() == [0, 0, 0]
    found = infos.pop()
    assert reports() == [0, 1, 0]
    infos.append(found)
    assert reports() == [0, 1, 1]


@pytest.mark.parametrize(
    ('node_class', 'theirs', 'ours'),
    [(VirtualRobot, 'publishes', 'subscribes to'), (GoToGoal, 'subscribes to', 'publishes')],
)
def test_a_topic_of_another_type_in_another_process_is_reported(
    monkeypatch, capfd, node_class, theirs, ours
):
    """Two contexts are two participants, as two processes are; they meet on this machine only."""
    monkeypatch.setattr(ros_node, 'WATCH_PERIOD', 0.1)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))
    with ros_context(['test']) as context, ros_context(['other']) as other:
        harness = Harness(context, make_executor(context, isolated=False))
        harness.add(node_class)
        peer = Node('mismatched', context=other)
        if theirs == 'publishes':
            peer.create_publisher(TwistStamped, 'cmd_vel', 10)
        else:
            peer.create_subscription(TwistStamped, 'cmd_vel', lambda _: None, 10)
        said = harness.until_said(capfd, 'enable_stamped_cmd_vel')
        harness.close()
        peer.destroy_node()
    assert (
        f'/mismatched {theirs} /cmd_vel as geometry_msgs/msg/TwistStamped, but this node {ours} it as '
        'geometry_msgs/msg/Twist: no message will arrive' in said
    )


@pytest.mark.parametrize('node_class', [GoToGoal, WheelBridge])
def test_two_types_in_one_process_are_a_clear_error(add, node_class):
    add(VirtualRobot)
    with pytest.raises(ParameterError, match='is enable_stamped_cmd_vel the same for both'):
        add(node_class, enable_stamped_cmd_vel=True)
    add(node_class, 'elsewhere', enable_stamped_cmd_vel=True)
