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

"""Publishers that end right after their last messages: what record_run reports of them."""

from __future__ import annotations

import signal

import pytest
from std_msgs.msg import String
from support.processes import run_python, start_python
from support.raw_bags import read_bag

pytestmark = pytest.mark.process

PUBLISHERS = """
import os, sys, time
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import String

publishers, count, size, milliseconds = map(int, sys.argv[1:])
for number in range(publishers):
    context = Context()
    rclpy.init(context=context)
    node = Node('ends', context=context)
    publisher = node.create_publisher(String, 'said', 10)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(0.2)
    for _ in range(count):
        time.sleep(milliseconds / 1000)
        publisher.publish(String(data='x' * size))
    if number < publishers - 1:
        node.destroy_node()
        context.shutdown()
# Not even the last participant is taken back.
os._exit(0)
"""


@pytest.fixture
def recorded(world, tmp_path):
    """A function that records publishers; returns the number of messages, exit code, and output."""

    def record(*publishers):
        child = world.start('record_run', '/said', '-o', str(tmp_path / 'run'))
        child.until_says('recording to')
        arguments = [str(one) for one in publishers]
        assert run_python(PUBLISHERS, *arguments, timeout=60).returncode == 0
        child.signal(signal.SIGTERM)
        code = child.exit()
        return len(read_bag(tmp_path / 'run')), code, child.stdout + child.stderr

    return record


def test_the_last_message_is_read_before_the_end_is_heard(recorded):
    """Through a port of its own, discovery was faster in one of six."""
    count, code, output = recorded(10, 5, 300, 10)
    assert (count, code) == (50, 0), output
    assert 'late messages' not in output


def test_an_overflow_is_not_called_complete(recorded):
    """As much as three buffers hold at once: the rest would be sent again, by a publisher that lives."""
    count, code, output = recorded(1, 10, 60_000, 0)
    assert count == 10 or (code == 1 and 'possibly the end of /said' in output), output


NODE = """
import time
from rclpy.node import Node
from std_msgs.msg import String
from diffdrive_jacobian.ros import runner
from diffdrive_jacobian.ros.fastdds_profiles import open_to_others
from diffdrive_jacobian.ros.runner import ros_context, running

runner.PATIENCE = 30.0  # Not all arrives in half a second on a busy machine.
open_to_others()
with ros_context(['ends']) as context, running(context, isolated=False) as nodes:
    node = nodes.add(lambda: Node('ends', context=context))
    publisher = node.create_publisher(String, 'said', 10)
    assert nodes.spin(lambda: publisher.get_subscription_count() > 0, timeout=30.0)
    time.sleep(0.3)
    for number in range(10):
        publisher.publish(String(data=f'{number}' * 60_000))
"""


def test_a_node_of_ours_ends_when_its_last_messages_have_arrived(world):
    received = []
    world.harness.peer.create_subscription(String, 'said', received.append, 100)
    process = start_python(NODE)
    world.harness.until(lambda: process.poll() is not None, 'it ends', patience=40.0)
    assert process.wait() == 0
    world.harness.until(lambda: len(received) == 10, 'all has arrived')
    assert [one.data[0] for one in received] == [*'0123456789']
