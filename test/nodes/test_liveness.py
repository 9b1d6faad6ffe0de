"""Nodes that were killed or hang are detected within seconds, and only they."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import SILENCE, GoalClient, duplicates, loss
from diffdrive_jacobian.ros import liveness
from diffdrive_jacobian.ros.liveness import LONGEST_STEP, PERIOD, Liveness


class Clock:
    """A monotonic clock that the test advances."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def answered(ros, watch, clock):
    """Wait for another answer: the silence ends."""
    watch._answered = False

    def over():
        clock.now += 0.1
        watch.silence()
        return watch._answered

    ros.until(over, 'an answer')


def test_a_controller_without_odometry_answers(ros, clock):
    ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    for _ in range(3):
        answered(ros, watch, clock)


def test_a_node_that_is_not_served_falls_silent_and_comes_back(ros, clock):
    node = ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    answered(ros, watch, clock)
    ros.executor.remove_node(node)
    served = 0
    while watch.silence() < SILENCE:
        clock.now += 0.1
        served += 1
        ros.executor.spin_once(timeout_sec=0.001)
    assert served == pytest.approx(SILENCE / 0.1, abs=2)
    ros.executor.add_node(node)
    answered(ros, watch, clock)


def test_time_in_which_the_asking_process_stands_still_does_not_count(ros, clock):
    node = ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    answered(ros, watch, clock)
    ros.executor.remove_node(node)
    before = watch.silence()
    clock.now += 60.0
    assert watch.silence() <= before + LONGEST_STEP


def test_a_node_without_parameter_services_is_never_silent(ros, clock):
    ros.add(GoToGoal, start_parameter_services=False)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    for _ in range(100):
        clock.now += 0.1
        ros.executor.spin_once(timeout_sec=0.0)
        assert watch.silence() == 0.0


def test_requests_without_an_answer_do_not_pile_up(ros, clock):
    node = ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    answered(ros, watch, clock)
    ros.executor.remove_node(node)
    for _ in range(200):
        clock.now += 1.0
        watch.silence()
    assert len(watch._pending) == liveness.PENDING
    assert len(watch._clients['/go_to_goal']._pending_requests) == liveness.PENDING


# --- Loss of a controller

A, B, OTHER = b'a', b'b', b'o'
STEP = 0.05
"""Time by which a test advances the clock (s)."""
RESTARTED = 'the controller /go_to_goal was restarted'


@pytest.mark.parametrize(
    ('sent_to', 'present', 'silence', 'partial', 'expected'),
    [
        ({A: '/go_to_goal'}, {A: '/go_to_goal'}, 2.9, 2.9, None),
        ({A: '/go_to_goal'}, {}, 0.0, 0.0, 'the controller is gone'),
        ({A: '/go_to_goal'}, {OTHER: '/other'}, 0.0, 0.0, 'the controller is gone'),
        ({A: '/go_to_goal'}, {A: '/go_to_goal', OTHER: '/other'}, 0.0, 9.0, None),
        ({A: '/go_to_goal'}, {A: '/go_to_goal', OTHER: ''}, 0.0, 9.0, None),
        ({A: ''}, {A: '', OTHER: ''}, 0.0, 0.0, None),
        ({A: '/go_to_goal'}, {A: '/go_to_goal', B: '/go_to_goal'}, 0.0, 2.9, None),
        ({A: '/go_to_goal', B: '/go_to_goal'}, {A: '/go_to_goal', B: '/go_to_goal'}, 0.0, 9.0, None),
        ({A: '/go_to_goal'}, {A: '/go_to_goal', B: '/go_to_goal'}, 0.0, 3.0, RESTARTED),
        ({A: '/go_to_goal'}, {B: '/go_to_goal'}, 0.0, 0.0, RESTARTED),
        (
            {A: '/go_to_goal'},
            {A: '/go_to_goal'},
            3.0,
            3.0,
            'the controller /go_to_goal has not answered for 3 s: it was killed or hangs',
        ),
    ],
)
def test_loss(sent_to, present, silence, partial, expected):
    assert loss(sent_to, present, silence, {'/go_to_goal': partial}) == expected


@pytest.mark.parametrize(
    ('present', 'expected'),
    [
        ({A: '/go_to_goal'}, []),
        ({A: '/go_to_goal', OTHER: '/other'}, []),
        ({A: '/go_to_goal', B: '/go_to_goal'}, ['/go_to_goal']),
        ({B: '/go_to_goal'}, []),
    ],
)
def test_duplicates_of_a_controller_that_is_present(present, expected):
    assert duplicates({A: '/go_to_goal'}, present) == expected


def partial_silence(ros, watch, clock, seconds):
    """Spin while some node answers, for a time of the clock; return the partial silence."""
    end = clock.now + seconds

    def over():
        clock.now += STEP
        watch.silence()
        return clock.now >= end

    ros.until(over, 'the end')
    return watch.partial_silence()['/go_to_goal']


def test_a_duplicate_that_answers_too_is_no_restart(ros, clock):
    ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    answered(ros, watch, clock)
    twin = ros.add(GoToGoal)
    service = '/go_to_goal/get_parameters'
    ros.until(lambda: ros.peer.count_services(service) == 2, 'both are discovered')
    ros.until(lambda: partial_silence(ros, watch, clock, PERIOD) == 0.0, 'both have answered')
    # Which of them falls silent now is unknown.
    ros.executor.remove_node(twin)
    assert partial_silence(ros, watch, clock, 2 * SILENCE) == 0.0


def test_a_namesake_without_parameter_services_is_no_restart(ros, clock):
    ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    ros.add(GoToGoal, start_parameter_services=False)
    answered(ros, watch, clock)
    assert partial_silence(ros, watch, clock, 2 * SILENCE) < 1.0


def test_a_successor_that_answers_alone_is_a_restart(ros, clock):
    old = ros.add(GoToGoal)
    watch = Liveness(ros.peer, ['/go_to_goal'], monotonic=clock.monotonic)
    answered(ros, watch, clock)
    ros.executor.remove_node(old)
    ros.add(GoToGoal)
    service = '/go_to_goal/get_parameters'
    ros.until(lambda: ros.peer.count_services(service) == 2, 'both are discovered')
    assert partial_silence(ros, watch, clock, 2 * SILENCE) >= SILENCE
    assert watch.silence() < SILENCE


def test_a_restarted_controller_is_distinguished_from_the_one_that_has_the_goal(ros):
    goals = np.array([[1.0, 1.0, 0.0]])
    sender = ros.add(
        lambda context, parameter_overrides: GoalClient(
            'send_goal', goals, context, topic='goal_pose', start_parameter_services=False
        ),
        parameters=None,
    )
    ros.add(GoToGoal, namespace='/here')
    old = ros.add(GoToGoal)
    ros.until(lambda: sender.obstacle() is None, 'the sender is ready')
    controllers = sender.controllers()
    assert list(controllers.values()) == ['/go_to_goal']
    assert loss(controllers, sender.controllers(), 0.0, {}) is None
    ros.add(GoToGoal)
    ros.until(lambda: len(sender.controllers()) == 2, 'the new one is found')
    ros.until(
        lambda: duplicates(controllers, sender.controllers()) == ['/go_to_goal'], 'it has a namesake'
    )
    # Both are there: it is not lost, unless only the new one answers.
    assert loss(controllers, sender.controllers(), 0.0, {'/go_to_goal': 0.0}) is None
    assert loss(controllers, sender.controllers(), 0.0, {'/go_to_goal': SILENCE}) == RESTARTED
    ros.executor.remove_node(old)
    old.destroy_node()
    ros.nodes.remove(old)
    ros.until(lambda: len(sender.controllers()) == 1, 'the old one is gone')
    # Within a process the name of the new one is lost with the old one.
    assert loss(controllers, sender.controllers(), 0.0, {}) == 'the controller is gone'
