"""The graph is queried after changes only, once for all nodes of a context."""

from __future__ import annotations

import gc
import weakref
from collections import Counter

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import String

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.ros import rclpy_internals
from diffdrive_jacobian.ros.graph_faults import SharedGraph
from diffdrive_jacobian.ros.node import FAULT_PATIENCE
from diffdrive_jacobian.ros.runner import ros_context

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
    team = [create(one, f'robot_{n}') for n in range(3) for one in (VirtualRobot, GoToGoal)]
    check(*team, times=1)
    assert queries['get_topic_names_and_types',] == 1
    # Also where robot and controller check the same topic.
    assert {queries['count_publishers', f'/robot_{n}/odom'] for n in range(3)} == {1}
    assert queries['count_publishers', '/robot_0/goal_pose'] == 1
    assert set(queries.values()) == {1}
    queries.clear()
    check(*team, times=3)
    assert queries == {}
    team[0].create_publisher(String, 'word', 1)
    check(*team, times=3)
    assert set(queries.values()) == {1}


def test_a_fault_that_appears_after_many_checks_is_reported(create, capfd):
    robot, other = create(VirtualRobot, 'a'), create(Node, 'other')
    check(robot, times=20)
    publisher = other.create_publisher(Odometry, '/a/odom', 1)
    check(robot, times=FAULT_PATIENCE - 1)
    assert 'publish /a/odom' not in capfd.readouterr().err
    check(robot, times=1)
    assert '/a/virtual_robot and /other publish /a/odom' in capfd.readouterr().err
    other.destroy_publisher(publisher)
    check(robot, times=20)
    other.create_publisher(Odometry, '/a/odom', 1)
    check(robot)
    assert '/a/virtual_robot and /other publish /a/odom' in capfd.readouterr().err


def test_each_node_of_a_context_notices_a_change(create, capfd):
    robots = [create(VirtualRobot, name) for name in ('first', 'a', 'b')]
    other = create(Node, 'other')
    check(*robots, times=1)
    robots.pop(0).destroy_node()
    for name in ('a', 'b'):
        other.create_publisher(Odometry, f'/{name}/odom', 1)
    # The first one of them takes the signal.
    check(*robots)
    text = capfd.readouterr().err
    assert 'publish /a/odom' in text
    assert 'publish /b/odom' in text


def test_contexts_have_graphs_of_their_own(create, queries, capfd):
    with ros_context(['other']) as second:
        robots = [create(VirtualRobot, 'a'), create(VirtualRobot, 'a', context=second)]
        other = create(Node, 'other', context=second)
        check(*robots, times=1)
        queries.clear()
        other.create_publisher(Odometry, '/a/odom', 1)
        check(robots[0])
        assert queries == {}
        assert 'publish /a/odom' not in capfd.readouterr().err
        check(robots[1])
        assert 'publish /a/odom' in capfd.readouterr().err
        other.destroy_node()
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


def test_for_a_maximum_age_changes_are_not_looked_for(create):
    node = create(Node, 'node')
    graph, another = SharedGraph(node), SharedGraph(node)
    graph.refresh()
    assert graph.count_publishers('/word') == 0
    node.create_publisher(String, 'word', 1)
    graph.refresh(1e6)
    assert graph.count_publishers('/word') == 0
    another.refresh()
    assert graph.count_publishers('/word') == 1


@pytest.fixture
def without_signal(monkeypatch):
    """Libraries without the functions that signal changes of the graph."""
    with monkeypatch.context() as patch:
        rclpy_internals._graph_functions.cache_clear()
        patch.setattr(rclpy_internals.ctypes, 'CDLL', lambda _: object())
        yield
    rclpy_internals._graph_functions.cache_clear()


def test_without_the_signal_of_rcl_every_check_queries(without_signal, create, queries):
    check(create(VirtualRobot, 'a'), times=3)
    assert queries['count_publishers', '/a/odom'] == 3


def test_an_idle_driver_that_came_later_is_found(create, queries):
    controller, other = create(GoToGoal, 'a'), create(Node, 'other')
    drivers = controller._others
    drivers.start()
    for second in range(1, 4):
        drivers.search(second * 1_000_000_000)
    assert queries['count_publishers', '/a/cmd_vel'] == 1
    other.create_publisher(Twist, '/a/cmd_vel', 1)
    drivers.start()
    assert drivers.subscriptions == 1


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
