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

"""The executor of the entry points moves its nodes in a flood, and loses nothing."""

from __future__ import annotations

import time

import pytest
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.harness import PATIENCE

from diffdrive_jacobian.ros.guarded_executor import GuardedExecutor
from diffdrive_jacobian.ros.rclpy_internals import events_executor
from diffdrive_jacobian.ros.runner import ros_context

FLOOD = 400
"""Messages that are published before any of them is handled."""


class Served:
    """Nodes on a guarded executor, and a publisher that they hear."""

    def __init__(self, context):
        self.context = context
        self.executor = GuardedExecutor(context, events_executor(context))
        self.nodes = []
        self.node, self.peer = self.add('served'), self.add('peer')
        self.received = []
        self.publisher = self.peer.create_publisher(String, 'words', 2 * FLOOD)

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
        self.spin(self.node.executor.create_task(lambda: None).done)

    def publish(self, words):
        for word in words:
            self.publisher.publish(serialize_message(String(data=str(word))))

    def spin(self, until):
        """Execute callbacks until a condition holds. Return the values of `fair`."""
        deadline, fair = time.monotonic() + PATIENCE, set()
        while not until():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.01)
            fair.add(self.executor.fair)
        return fair

    def until_received(self, word):
        self.spin(lambda: self.received and self.received[-1] == str(word))

    def await_future(self):
        """Start a coroutine. Return the future that it awaits, and the list of its result."""
        future, done = Future(), []

        async def wait():
            done.append(await future)

        self.node.executor.create_task(wait)
        return future, done

    def move(self):
        self.executor.use_single_threaded()


def busy(seconds):
    """Keep the thread busy, as a slow callback does."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


@pytest.fixture
def served():
    with ros_context(['test']) as context:
        world = Served(context)
        yield world
        world.executor.shutdown()
        for node in world.nodes:
            node.destroy_node()


# --- When nodes move


@pytest.mark.slow
def test_the_first_flood_moves_the_nodes_for_good_and_is_logged(served, capfd):
    served.listen(seconds=1e-4)
    ticks = []
    served.node.create_timer(0.01, lambda: ticks.append(1))
    assert not served.executor.fair
    for flood in range(1, 3):
        served.publish(range((flood - 1) * FLOOD, flood * FLOOD))
        assert True in served.spin(lambda: len(served.received) == flood * FLOOD)  # noqa: B023
        before = len(ticks)
        # It is quiet.
        assert served.spin(lambda: len(ticks) == before + 50) == {True}  # noqa: B023
    assert served.received == [str(number) for number in range(2 * FLOOD)]
    said = capfd.readouterr().err
    assert said.count('arrive faster than they are handled') == 1
    assert 'until this program is restarted, ' in said
    assert 'which takes two to six times the CPU time\n' in said


def test_a_slow_callback_alone_moves_nothing(served):
    ticks = []

    def tick():
        ticks.append(len(ticks))
        # A few messages wait until the callback is over.
        served.publish(range(4))
        busy(0.04)

    served.listen()
    served.node.create_timer(0.02, tick)
    assert served.spin(lambda: len(ticks) == 8) == {False}


def test_one_message_of_each_of_many_topics_moves_nothing(served):
    received = []

    def on_message(message):
        received.append(message)
        busy(1e-3)

    topics = [f'topic{number}' for number in range(30)]
    publishers = [served.peer.create_publisher(String, topic, 10) for topic in topics]
    for topic in topics:
        served.node.create_subscription(String, topic, on_message, 10)
    for count in range(1, 3):
        for publisher in publishers:
            publisher.publish(String())
        assert served.spin(lambda: len(received) == 30 * count) == {False}  # noqa: B023


@pytest.mark.parametrize('kind', ['message info', 'coroutine'])
def test_callbacks_that_need_a_wait_set_get_it(served, kind):
    received = []

    async def awaiting(message):
        received.append(message)

    callbacks = {'coroutine': awaiting, 'message info': lambda _, info: received.append(info)}
    other = Node('other', context=served.context)
    served.nodes.append(other)
    other.create_subscription(String, 'words', callbacks[kind], 10)
    served.executor.add_node(other)
    assert served.executor.fair
    served.publish(['word'])
    served.spin(lambda: received)


# --- What survives the move


@pytest.mark.parametrize('handled', range(4))
def test_no_message_request_or_response_is_lost_by_the_move(served, handled):
    served.listen()
    answers = []
    served.node.create_service(Trigger, 'trigger', lambda request, response: response)
    client = served.peer.create_client(Trigger, 'trigger')
    served.spin(client.service_is_ready)
    for round_ in range(1, 4):
        served.publish(range(3 * round_ - 3, 3 * round_))
        client.call_async(Trigger.Request()).add_done_callback(answers.append)
        if round_ == 2:
            for _ in range(handled):
                served.executor.spin_once(timeout_sec=0.0)
            served.move()
        served.spin(lambda: (len(answers), len(served.received)) == (round_, 3 * round_))  # noqa: B023
    assert served.received == [str(number) for number in range(9)]


def test_a_coroutine_that_waits_on_the_left_executor_ends(served):
    future, done = served.await_future()
    served.executor.spin_once(timeout_sec=0.01)
    served.move()
    served.executor.spin_once(timeout_sec=0.01)
    future.set_result('done')
    served.spin(lambda: done)
    assert done == ['done']


def test_a_message_for_the_executor_that_was_left_is_received_at_once(served):
    served.listen(depth=1)
    served.spin(lambda: served.publish(['first']) or served.received)
    served.publish(['second'])
    served.move()
    served.until_received('second')
    served.publish(['third'])
    served.until_received('third')


def test_timers_keep_the_time_of_their_next_expiry(served):
    ticks = []
    slow, _ = (served.node.create_timer(period, lambda: ticks.append(1)) for period in (30.0, 0.02))
    served.spin(lambda: ticks)
    before = slow.time_until_next_call()
    served.move()
    assert slow.time_until_next_call() <= before
    served.spin(lambda: len(ticks) == 3)


def test_nodes_and_entities_that_are_created_after_the_move_are_executed(served):
    served.move()
    served.listen()
    late, ticks = served.add('late'), []
    timer = late.create_timer(0.005, lambda: ticks.append(1))
    served.spin(lambda: len(ticks) == 2)
    served.spin(lambda: served.publish(['word']) or served.received)
    late.destroy_timer(timer)
    served.executor.remove_node(late)
    served.received.clear()
    served.publish(['word'])
    served.spin(lambda: served.received)
