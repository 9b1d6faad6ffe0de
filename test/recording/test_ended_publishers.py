"""Publishers that end right after their last messages: what record_run says of them."""

from __future__ import annotations

import signal

import pytest
from fork_server import forked
from std_msgs.msg import String
from support.raw_bags import read_bag

pytestmark = pytest.mark.process

PUBLISHER = """
import os, sys, time
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

count, size, period = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
rclpy.init()
node = Node('ends')
publisher = node.create_publisher(String, 'said', 10)
while not publisher.get_subscription_count():
    time.sleep(0.02)
time.sleep(0.3)
for number in range(count):
    publisher.publish(String(data='x' * size))
    time.sleep(period)
# Not even its participant is taken back.
os._exit(0)
"""


@pytest.fixture
def recorded(world, tmp_path):
    """A function that records a publisher; returns the number of messages, exit code, and output."""

    def record(name, *publisher):
        child = world.start('record_run', '/said', '-o', str(tmp_path / name))
        child.until_says('recording to')
        assert forked.run(PUBLISHER, [str(one) for one in publisher], timeout=60).returncode == 0
        child.signal(signal.SIGINT)
        code = child.exit()
        return len(read_bag(tmp_path / name)), code, child.stdout + child.stderr

    return record


def test_one_that_is_slow_is_recorded_completely(recorded):
    count, code, said = recorded('slow', 25, 500, 0.02)
    assert (count, code) == (25, 0), said
    assert 'waiting' not in said


@pytest.mark.parametrize('number', range(3))
def test_one_that_overflows_the_buffer_is_not_called_complete(recorded, number):
    """As much as three buffers hold at once: the rest would be sent again, by a publisher that lives."""
    count, code, said = recorded(f'burst_{number}', 10, 60_000, 0.0)
    assert count == 10 or (code == 1 and 'possibly the end of /said' in said), said


SEVERAL = """
import time
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import String

for number in range(10):
    context = Context()
    rclpy.init(context=context)
    node = Node('ends', context=context)
    publisher = node.create_publisher(String, 'said', 10)
    while not publisher.get_subscription_count():
        time.sleep(0.02)
    time.sleep(0.2)
    for _ in range(5):
        time.sleep(0.01)
        publisher.publish(String(data='x' * 300))
    node.destroy_node()
    context.shutdown()
"""


def test_the_last_message_is_read_before_the_end_of_its_publisher_is_heard(world, tmp_path):
    """Through a port of its own, discovery was faster in one of six."""
    child = world.start('record_run', '/said', '-o', str(tmp_path / 'run'))
    child.until_says('recording to')
    assert forked.run(SEVERAL, timeout=60).returncode == 0
    child.signal(signal.SIGINT)
    assert child.exit() == 0
    assert len(read_bag(tmp_path / 'run')) == 50


NODE = """
import sys, time
from rclpy.node import Node
from std_msgs.msg import String
from diffdrive_jacobian.ros.fastdds_profiles import open_to_others
from diffdrive_jacobian.ros.runner import ros_context, running

open_to_others()
with ros_context(['ends']) as context, running(context, isolated=False) as runner:
    node = runner.add(lambda: Node('ends', context=context))
    publisher = node.create_publisher(String, 'said', 10)
    assert runner.spin(lambda: publisher.get_subscription_count() > 0, timeout=30.0)
    time.sleep(0.3)
    for number in range(10):
        publisher.publish(String(data=f'{number}' * 60_000))
"""


@pytest.mark.parametrize('number', range(3))
def test_a_node_of_ours_ends_when_its_last_messages_have_arrived(world, number):
    received = []
    take = received.append
    subscription = world.harness.peer.create_subscription(String, 'said', take, 100)
    process = forked.Popen(NODE)
    world.harness.until(lambda: process.poll() is not None, 'it ends', patience=40.0)
    assert process.wait() == 0
    world.harness.until(lambda: len(received) == 10, 'all has arrived')
    assert [one.data[0] for one in received] == [*'0123456789']
    world.harness.peer.destroy_subscription(subscription)
