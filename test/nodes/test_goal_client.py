"""The client of go_to_goal: goals, their status, and the distance of the point that is to arrive."""

from __future__ import annotations

import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from support.ros_messages import odometry, receive

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import DRIVEN_POINT_PARAMETERS, GoalClient, driven_offset
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.ros.liveness import Liveness


def add_client(ros, goals, **kwargs):
    def create(context, parameter_overrides):
        return GoalClient('client', np.array(goals), context, **kwargs)

    return ros.add(create, parameters=None)


def test_goals_are_sent_with_the_first_odometry(ros):
    client = add_client(ros, [[1.0, 0.0, 0.0], [1.0, 1.0, 0.5]])
    received, talk = ros.listen(Goals, 'goals'), ros.talk(Odometry, 'odom')
    assert client.distance == math.inf
    client.send_on_odometry()
    talk.publish(odometry(0.5, 0.0, 0.0))
    ros.until(lambda: received, 'the goals are received')
    assert [pose.pose.position.y for pose in received[0].goals] == [0.0, 1.0]
    assert client.distance == 0.5
    client.index = 1
    assert client.distance == pytest.approx(math.hypot(0.5, 1.0))


def test_goals_that_were_withdrawn_are_not_sent(ros):
    client = add_client(ros, [[1.0, 0.0, 0.0]])
    talk = ros.talk(Odometry, 'odom')
    client.send_on_odometry()
    client.withdraw()
    talk.publish(odometry(0.5, 0.0, 0.0))
    ros.until(lambda: client.robot is not None, 'odometry is received')
    assert client._follower.newest is None


def test_a_single_goal_has_the_frame_and_a_status(ros):
    client = add_client(ros, [[1.0, 2.0, 0.0]], topic='goal_pose', frame='odom')
    received = ros.listen(PoseStamped, 'goal_pose')
    ros.add(GoToGoal)
    ros.until(lambda: client.obstacle() is None, 'the controller is discovered')
    client.send()
    ros.until(lambda: client.status == GoalStatus.STATUS_ACCEPTED, 'the goal is accepted')
    assert received[0].header.frame_id == 'odom'
    assert not client.ended
    client.cancel()
    ros.until(lambda: client.ended, 'the goal is canceled')


@pytest.mark.parametrize('goals', [np.zeros(3), np.zeros((0, 3)), np.zeros((1, 2))], ids=str)
def test_goals_must_be_rows(goals):
    with pytest.raises(ValueError, match=r'goals must have shape \(n, 3\)'):
        GoalClient('client', goals, None)


def test_goal_pose_takes_one_goal():
    with pytest.raises(ValueError, match='goal_pose takes one goal, got 2'):
        GoalClient('client', np.zeros((2, 3)), None, topic='goal_pose')


@pytest.mark.parametrize(('controller', 'expected'), [('go_to_goal', 1.0), ('offset_point', 0.75)])
def test_distance_is_that_of_the_point_the_controller_drives(ros, controller, expected):
    client = add_client(ros, [[1.0, 0.0, 0.0]], topic='goal_pose')
    node = ros.add(GoToGoal, parameters={'controller': controller, 'offset': 0.25})
    watch = Liveness(client, ['/go_to_goal', '/missing'], DRIVEN_POINT_PARAMETERS)

    def reported():
        watch.silence()
        return watch.values

    ros.until(reported, 'the parameters are reported')
    assert watch.values == {'/go_to_goal': {'controller': controller, 'offset': 0.25}}
    client.set_controller_parameters(watch.values['/go_to_goal'])
    receive(client, '/odom', odometry(0.0, 0.0, 0.0))
    assert client.distance == expected
    assert node.arrival.offset == driven_offset(watch.values['/go_to_goal'])


def test_a_node_without_these_parameters_answers_without_values(ros):
    watch = Liveness(ros.peer, ['/go_to_goal'], ('controller', 'no_such_parameter'))
    ros.add(GoToGoal)

    def answered():
        watch.silence()
        return watch.answered

    ros.until(answered, 'an answer')
    assert watch.values == {}


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        ({}, 0.0),
        ({'controller': 'pose', 'offset': 0.1}, 0.0),
        ({'controller': 'offset_point', 'offset': -0.1}, -0.1),
        ({'controller': 'offset_point', 'offset': math.nan}, 0.0),
        ({'controller': 'offset_point', 'offset': '0.1'}, 0.0),
        ({'controller': 3, 'offset': None}, 0.0),
    ],
)
def test_driven_offset_of_any_values(values, expected):
    assert driven_offset(values) == expected


def test_a_topic_with_another_type_in_the_process_is_named(ros):
    with pytest.raises(ParameterError) as caught:
        add_client(ros, [[0.0, 0.0, 0.0]], cli_args=['--ros-args', '-r', 'odom:=goal_status'])
    assert str(caught.value) == (
        'two topics of this node have the name /goal_status, one with type nav_msgs/msg/Odometry, the '
        'other with action_msgs/msg/GoalStatus: remap them to different names'
    )


def test_a_topic_with_another_type_in_another_node_is_named(ros):
    ros.peer.create_publisher(PoseStamped, 'odom', 1)
    with pytest.raises(ParameterError) as caught:
        add_client(ros, [[0.0, 0.0, 0.0]])
    assert str(caught.value) == (
        '/odom must have one type within a process: this node uses nav_msgs/msg/Odometry, another one '
        'geometry_msgs/msg/PoseStamped'
    )
