"""The executor of the entry points: when it moves its nodes, and that a move loses nothing."""

from __future__ import annotations

import time
from functools import partial

import pytest
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.harness import PATIENCE

from diffdrive_jacobian.ros import guarded_executor
from diffdrive_jacobian.ros.guarded_executor import GuardedExecutor
from diffdrive_jacobian.ros.rclpy_internals import events_executor
from diffdrive_jacobian.ros.runner import ros_context

FLOOD = 600
"""Messages that are published before any of them is handled."""


class Served:
    """Nodes on a guarded executor, and a publisher and a client that they hear."""

    def __init__(self, context):
        self.context = context
        self.executor = GuardedExecutor(context, events_executor(context))
        self.nodes = []
        self.node, self.peer = self.add('served'), self.add('peer')
        self.received, self.answers = [], []
        self.publisher = self.peer.create_publisher(String, 'words', 2 * FLOOD)
        self.client = self.peer.create_client(Trigger, 'trigger')

    def add(self, name):
        node = Node(name, context=self.context, start_parameter_services=False)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def listen(self, seconds=0.0, depth=2 * FLOOD):
        """Receive the messages, with a callback that takes so long."""

        def on_message(message):
            self.received.append(message.data)
            busy(seconds)

        self.node.create_subscription(String, 'words', on_message, depth)
        self.settle()

    def settle(self):
        """Execute what waits, such as the registration of new entities."""
        task = self.node.executor.create_task(lambda: None)
        self.spin(task.done)

    def answer(self):
        def on_request(request, response):
            response.success = True
            return response

        return self.node.create_service(Trigger, 'trigger', on_request)

    def publish(self, words):
        for word in words:
            self.publisher.publish(serialize_message(String(data=str(word))))

    def request(self):
        future = self.client.call_async(Trigger.Request())
        future.add_done_callback(lambda future: self.answers.append(future.result().success))

    def spin(self, until):
        deadline = time.monotonic() + PATIENCE
        while not until():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.01)

    def flood(self):
        """Publish more messages than can be handled in time, and wait until all are handled."""
        sent = len(self.received)
        self.publish(range(sent, sent + FLOOD))
        self.spin(lambda: len(self.received) == sent + FLOOD)

    def move(self):
        """Move the nodes to the other executor."""
        if self.executor.fair:
            self.executor.hold = 0.0
            self.spin(lambda: not self.executor.fair)
        else:
            self.executor.use_single_threaded()


def busy(seconds):
    """Keep the thread busy, as a slow callback does."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


@pytest.fixture
def served(monkeypatch):
    # Moves back as soon as there is nothing to do, where the time on the other executor is short, too.
    monkeypatch.setattr(guarded_executor, 'WINDOW', 0.001)
    with ros_context(['test']) as context:
        world = Served(context)
        yield world
        world.executor.shutdown()
        for node in world.nodes:
            node.destroy_node()


@pytest.fixture
def quick(monkeypatch):
    """Short times until the nodes move back."""
    monkeypatch.setattr(guarded_executor, 'FIRST_HOLD', 0.05)
    monkeypatch.setattr(guarded_executor, 'QUIET', 0.05)
    monkeypatch.setattr(guarded_executor, 'WINDOW', 0.05)


# --- When nodes move


def test_messages_that_wait_for_too_long_move_the_nodes_and_quiet_moves_them_back(quick, served, capfd):
    served.listen(seconds=1e-4)
    served.node.create_timer(0.01, lambda: None)
    assert not served.executor.fair
    moved = []
    served.publish(range(FLOOD))
    served.spin(lambda: moved.append(served.executor.fair) or len(served.received) == FLOOD)
    assert any(moved)
    assert served.received == [str(number) for number in range(FLOOD)]
    served.spin(lambda: not served.executor.fair)
    said = ''

    def over():
        nonlocal said
        said += capfd.readouterr().err
        return 'in time again' in said

    served.spin(over)
    assert said.count('arrive faster than they are handled') == 1
    served.publish(['after'])
    served.spin(lambda: served.received[-1] == 'after')


def test_the_time_until_nodes_move_back_grows_and_the_episode_is_logged_once(
    quick, monkeypatch, served, capfd
):
    served.listen(seconds=1e-4)
    served.node.create_timer(0.01, lambda: None)
    holds = []
    for _ in range(3):
        served.flood()
        holds.append(served.executor.hold)
        served.spin(lambda: not served.executor.fair)
        served.settle()
        monkeypatch.setattr(guarded_executor, 'QUIET', 10.0)
    assert holds[1:] == [2 * holds[0], 4 * holds[0]]
    assert capfd.readouterr().err.count('arrive faster than they are handled') == 1


def test_a_slow_callback_alone_moves_nothing(served):
    ticks = []

    def tick():
        ticks.append(len(ticks))
        # A few messages wait until the callback is over.
        served.publish(range(4))
        busy(0.04)

    served.listen()
    served.node.create_timer(0.02, tick)
    fair = []
    served.spin(lambda: fair.append(served.executor.fair) or len(ticks) == 15)
    assert not any(fair)


def test_one_message_of_each_of_many_topics_moves_nothing(served):
    received = []

    def on_message(message):
        received.append(message)
        busy(1e-3)

    topics = [f'topic{number}' for number in range(60)]
    publishers = [served.peer.create_publisher(String, topic, 10) for topic in topics]
    for topic in topics:
        served.node.create_subscription(String, topic, on_message, 10)
    fair = []
    for count in range(1, 5):
        for publisher in publishers:
            publisher.publish(String())
        served.spin(lambda: fair.append(served.executor.fair) or len(received) == 60 * count)  # noqa: B023
    assert not any(fair)


def test_nodes_are_not_moved_back_while_a_coroutine_waits(served):
    served.executor.use_single_threaded()
    served.executor.hold = 0.0
    future, done = Future(), []

    async def wait():
        done.append(await future)

    served.node.executor.create_task(wait)
    ticks = []
    served.node.create_timer(0.01, lambda: ticks.append(1))
    served.spin(lambda: len(ticks) == 10)
    assert served.executor.fair
    future.set_result('done')
    served.spin(lambda: done and not served.executor.fair)


def test_a_load_that_only_the_events_executor_can_handle_moves_back_in_the_end(monkeypatch, served):
    monkeypatch.setattr(guarded_executor, 'LONGEST_HOLD', 0.1)
    served.listen(depth=3)
    served.executor.use_single_threaded()
    served.executor.hold = 0.0
    fair = []

    def never_quiet():
        served.publish([len(fair)])
        fair.append(served.executor.fair)
        return not fair[-1]

    served.spin(never_quiet)
    assert all(fair[:-1])
    served.spin(lambda: served.received[-1] == str(len(fair) - 1))


def test_messages_that_were_announced_before_are_taken_before_nodes_move_back(served):
    # The middleware does not announce them again.
    served.listen()
    served.publish(range(50))
    served.executor.use_single_threaded()
    served.move()
    assert len(served.received) == 50
    served.publish(['after'])
    served.spin(lambda: served.received[-1] == 'after')


def test_nodes_that_were_destroyed_are_moved_too(monkeypatch, served):
    monkeypatch.setattr(guarded_executor, 'LONGEST_HOLD', 0.0)
    for node in served.nodes:
        node.destroy_node()
    served.executor.use_single_threaded()
    served.spin(lambda: not served.executor.fair)


@pytest.mark.parametrize(
    'subscribe',
    [
        lambda node, take: node.create_subscription(
            String, 'words', lambda m, info: take((m, info)), 10
        ),
        lambda node, take: node.create_subscription(String, 'words', partial(_awaiting, take), 10),
    ],
    ids=['message info', 'coroutine'],
)
def test_callbacks_that_need_a_wait_set_get_it(served, subscribe):
    received = []
    other = Node('other', context=served.context)
    served.nodes.append(other)
    subscribe(other, received.append)
    served.executor.add_node(other)
    assert served.executor.fair
    served.publish(['word'])
    served.spin(lambda: received)


async def _awaiting(take, message):
    take(message)


def test_a_context_that_is_shut_down_ends_the_loop_on_both(served):
    served.move()
    served.node.create_timer(0.01, served.context.try_shutdown)
    with pytest.raises(ExternalShutdownException):
        served.spin(lambda: False)


# --- What survives a move


def test_no_message_request_or_response_is_lost_by_moves(served):
    served.listen()
    served.answer()
    served.spin(served.client.service_is_ready)
    for number in range(200):
        served.publish(range(3 * number, 3 * number + 3))
        served.request()
        if number % 3 == 0:
            # Some are handled before the move.
            served.executor.spin_once(timeout_sec=0.0)
        served.move()
        served.spin(lambda: len(served.answers) == number + 1)  # noqa: B023
        served.spin(lambda: len(served.received) == 3 * number + 3)  # noqa: B023
    assert served.received == [str(number) for number in range(600)]
    assert all(served.answers)


@pytest.mark.parametrize('fair', [False, True])
def test_a_message_for_the_executor_that_was_left_is_received_at_once(served, fair):
    served.listen(depth=1)
    if fair:
        served.move()
    served.spin(lambda: served.publish(['first']) or served.received)
    served.publish(['second'])
    served.move()
    served.spin(lambda: served.received[-1] == 'second')
    served.publish(['third'])
    served.spin(lambda: served.received[-1] == 'third')


@pytest.mark.parametrize('fair', [False, True])
def test_timers_keep_the_time_of_their_next_expiry(served, fair):
    if fair:
        served.move()
    ticks = []
    timer = served.node.create_timer(30.0, lambda: ticks.append(1))
    soon = served.node.create_timer(0.02, lambda: ticks.append(1))
    served.spin(lambda: ticks)
    before = timer.time_until_next_call()
    soon_before = soon.time_until_next_call()
    served.move()
    assert timer.time_until_next_call() <= before
    assert soon.time_until_next_call() <= soon_before
    served.spin(lambda: len(ticks) == 3)


def test_a_coroutine_that_waits_on_the_left_executor_ends(served):
    future, done = Future(), []

    async def wait():
        done.append(await future)

    served.node.executor.create_task(wait)
    served.spin(lambda: True)
    served.executor.spin_once(timeout_sec=0.01)
    served.executor.use_single_threaded()
    served.executor.spin_once(timeout_sec=0.01)
    future.set_result('done')
    served.spin(lambda: done)


@pytest.mark.parametrize('fair', [False, True])
def test_nodes_and_entities_that_are_created_after_a_move_are_executed(served, fair):
    served.move()
    if not fair:
        served.move()
    served.listen()
    late, ticks = served.add('late'), []
    timer = late.create_timer(0.005, lambda: ticks.append(1))
    served.spin(lambda: len(ticks) == 2)
    served.spin(lambda: served.publish(['word']) or served.received)
    late.destroy_timer(timer)
    served.move()
    served.received.clear()
    served.publish(['word'])
    served.spin(lambda: served.received)
